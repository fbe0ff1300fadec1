# On an NVIDIA GPU with the driver for CUDA 12, and the container toolkit:
#     docker build -f docker/cuda.Dockerfile -t taic-cuda . && docker run --rm --gpus all -v "$PWD/runs:/work/runs" taic-cuda run nav2d
FROM python:3.11-slim
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY taic_jax taic_jax
COPY envs envs
COPY experiments experiments
RUN pip install --no-cache-dir -c constraints.txt '.[gym,data,viz,cuda12]'
# Films are drawn without a display.
RUN apt-get update && apt-get install -y --no-install-recommends libegl1 libgl1 && rm -rf /var/lib/apt/lists/*
WORKDIR /work
ENTRYPOINT ["taic"]
