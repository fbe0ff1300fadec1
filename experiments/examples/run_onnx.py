"""Run an agent of `taic export --format onnx` in Gymnasium, without JAX: python run_onnx.py FOLDER [ENV]."""

import json
import sys
from pathlib import Path

import gymnasium
import numpy as np
import onnxruntime

folder, name = [*sys.argv[1:], "HalfCheetah-v5"][:2]
about = json.loads(Path(folder, "agent.json").read_text())
session = onnxruntime.InferenceSession(Path(folder, "agent.onnx"), providers=["CPUExecutionProvider"])
env = gymnasium.make(name)
if about["discrete"]:  # the action is one-hot
    env = gymnasium.wrappers.TransformAction(env, np.argmax, None)
else:
    env = gymnasium.wrappers.RescaleAction(env, *about["actions"])
for seed in range(10):
    obs, _ = env.reset(seed=seed)
    carry = {x["name"]: np.full(x["shape"], x["start"], x["dtype"]) for x in about["carry"]}
    total, ended = 0.0, False
    while not ended:
        action, *new = session.run(None, {"obs": obs.astype(np.float32), **carry})
        carry = dict(zip(carry, new, strict=True))
        obs, reward, terminated, truncated, _ = env.step(action)
        total, ended = total + float(reward), terminated or truncated
    print(f"return {total:.3f}")
