"""Run an agent of `taic export` in Gymnasium with JAX, without taic_jax: python run_stablehlo.py FOLDER [ENV]."""

import json
import sys
from pathlib import Path

import gymnasium
import jax.export
import numpy as np

folder, name = [*sys.argv[1:], "HalfCheetah-v5"][:2]
about = json.loads(Path(folder, "agent.json").read_text())
tick = jax.jit(jax.export.deserialize(bytearray(Path(folder, "agent.stablehlo").read_bytes())).call)
env = gymnasium.make(name)
if about["discrete"]:  # the action is one-hot
    env = gymnasium.wrappers.TransformAction(env, np.argmax, None)
else:
    env = gymnasium.wrappers.RescaleAction(env, *about["actions"])
for seed in range(10):
    obs, _ = env.reset(seed=seed)
    carry = [np.full(x["shape"], x["start"], x["dtype"]) for x in about["carry"]]
    total, ended = 0.0, False
    while not ended:
        action, *carry = tick(obs.astype(np.float32), *carry)
        obs, reward, terminated, truncated, _ = env.step(np.asarray(action))
        total, ended = total + float(reward), terminated or truncated
    print(f"return {total:.3f}")
