"""Kill runs at random moments, resume them, and compare each with an uninterrupted run, bit by bit.

python -m taic_jax.experiments.reliability.kills --kills 50

Each is killed once by SIGKILL, at a moment drawn uniformly over the length of a whole run with a whole sweep after it,
start and compilation included. Compiled programs are cached, so that most moments are within a stage.
"""

import contextlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from safetensors.numpy import load_file

from taic_jax.artifacts.models import ARRAYS
from taic_jax.command_line import tell
from taic_jax.config import CollectConfig, Config, EnvConfig, EvaluateConfig, OptionsConfig, PPOConfig, TrainConfig
from taic_jax.config.files import to_yaml
from taic_jax.runtime.checkpoint import load_arrays
from taic_jax.runtime.run_folder import RunFolder

POINTS = ("--axes", "train.ppo.learning_rate=3e-4,1e-3", "--chunk", "1")
"""Options of the sweep: two points, each a chunk of its own, which is a whole run."""
SMALL = PPOConfig(num_envs=4, rollout_length=64, epochs=2, minibatch_size=64, hidden_sizes=(16,))


@dataclass(frozen=True)
class Arguments:
    """Kill, resume, compare; exit code 1 if a resumed run differs."""

    kills: int = 50  # Runs to kill.
    env: str = "nav2d"  # Task of the runs.
    seeds: int = 2  # Seeds of each run.
    seed: int = 0  # Of the moments.
    iterations: int = 60  # Iterations of collect, and of train; hundreds of gradient steps of learn.
    jobs: int = 1  # Runs to kill side by side.


def config(arguments: Arguments) -> Config:
    """Return the config of the runs: every stage small, a checkpoint at nearly every iteration."""
    ticks = arguments.iterations * SMALL.num_envs * SMALL.rollout_length
    return Config(
        env=EnvConfig(name=arguments.env),
        collect=CollectConfig(ticks=ticks, capacity=ticks // 2, ppo=SMALL),
        options=OptionsConfig(hidden_size=16, mlp_sizes=(16,), steps=100 * arguments.iterations, batch_size=32),
        train=TrainConfig(ticks=ticks, ppo=SMALL),
        evaluate=EvaluateConfig(episodes=2, video_ticks=0),
        seeds=arguments.seeds,
    )


def execute(folder: Path, kind: str, source: str, seconds: float | None = None) -> None:
    """Execute a run or a sweep with the program cache beside its folder, and kill it after so many seconds; raise
    `RuntimeError` if it fails."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(folder.parent / "compiled")}
    cache |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, "-W", "ignore", "-m", f"taic_jax.{kind}", source, "--run-dir", str(folder)]
    command += ["--checkpoint-seconds", "0", *(POINTS if kind == "sweep" else ())]
    with contextlib.suppress(subprocess.TimeoutExpired):
        done = subprocess.run(command, env=os.environ | cache, capture_output=True, text=True, timeout=seconds)
        if done.returncode:
            raise RuntimeError(done.stderr)


def outcome(folder: Path) -> dict[str, Any]:
    """Return by name all results of a run or a sweep that must not depend on interruptions."""
    run = RunFolder(folder)
    if not run.finished:
        chunks = {f"{path.name}/{name}": x for path in folder.glob("chunk-*") for name, x in outcome(path).items()}
        return chunks | {name: (folder / name).read_bytes() for name in ("table.csv", "best.yaml", "plan.json")}
    summary = run.summary()
    rows = [{k: v for k, v in row.items() if k != "time"} for row in run.metrics()]
    rows.sort(key=lambda row: row["stage"])  # a resumed run repeats an evaluation at another place
    return {"methods": summary["methods"], "ticks": summary["ticks"], "rows": rows, **dict(_arrays(folder))}


def _arrays(folder: Path) -> Iterator[tuple[str, bytes]]:
    for path in folder.rglob("*"):
        arrays = load_arrays(path) if (path / "_CHECKPOINT_METADATA").is_file() else {}
        if path.suffix == ".npz":
            with np.load(path) as file:
                arrays = dict(file)
        elif path.name == ARRAYS:
            arrays = load_file(path)
        yield from ((f"{path.relative_to(folder)}/{name}", array.tobytes()) for name, array in arrays.items())


def differences(a: dict[str, Any], b: dict[str, Any]) -> list[str]:
    """Return the names under which two outcomes differ."""
    return sorted(name for name in {**a, **b} if a.get(name) != b.get(name))


def kill_one(folder: Path, kind: str, source: str, seconds: float) -> str:
    """Kill a run or a sweep after so many seconds, finish it, and return the stage in which it was killed."""
    execute(folder, kind, source, seconds)
    run = RunFolder(folder)
    rows = run.metrics()
    stage = "end" if run.finished else rows[-1]["stage"] if rows else "start"
    execute(folder, kind, "--resume" if run.begun else source)
    return "sweep" if kind == "sweep" else stage


def kill_all(arguments: Arguments, root: Path) -> Iterator[tuple[str, float, list[str]]]:
    """Yield for each run the stage and the seconds at which it was killed, and the differences from a whole run."""
    source = str(root / "config.yaml")
    Path(source).write_text(to_yaml(config(arguments)))
    execute(root / "warm", "run", source)  # fills the cache
    times = [time.perf_counter()]
    for kind in ("run", "sweep"):
        execute(root / kind, kind, source)
        times.append(time.perf_counter())
    expected = {kind: outcome(root / kind) for kind in ("run", "sweep")}
    run, sweep = np.diff(times)
    generator = random.Random(arguments.seed)
    moments = [generator.uniform(-run, sweep) for _ in range(arguments.kills)]
    kills = [("sweep", moment) if moment > 0 else ("run", moment + run) for moment in moments]
    folders = [root / str(i) for i in range(arguments.kills)]
    with ThreadPoolExecutor(arguments.jobs) as pool:
        stages = pool.map(lambda folder, kill: kill_one(folder, kill[0], source, kill[1]), folders, kills)
        for stage, (kind, seconds), folder in zip(stages, kills, folders, strict=True):
            yield stage, seconds, differences(expected[kind], outcome(folder))
            shutil.rmtree(folder)


def main() -> int:
    """Run the experiment; return 1 if any resumed run differs."""
    arguments, stages, bad = tyro.cli(Arguments), Counter(), 0
    with tempfile.TemporaryDirectory() as name:
        for i, (stage, seconds, names) in enumerate(kill_all(arguments, Path(name)), 1):
            stages[stage] += 1
            bad += bool(names)
            print(f"{i:3}  killed after {seconds:5.1f} s in {stage:8}", "differs:" if names else "identical",
                  *names[:3], flush=True)  # fmt: skip
    counts = ", ".join(f"{count} in {stage}" for stage, count in stages.items())
    print(f"{arguments.kills} runs killed ({counts}): {arguments.kills - bad} resumed runs identical, {bad} not")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(tell(main))
