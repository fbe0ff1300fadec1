"""Run flat PPO or closed-loop options of `taic export --format npz` in Gymnasium: python run_npz.py FOLDER [ENV]."""

import json
import sys
from pathlib import Path

import gymnasium
import numpy as np

folder, name = [*sys.argv[1:], "HalfCheetah-v5"][:2]
about = json.loads(Path(folder, "agent.json").read_text())
x = dict(np.load(Path(folder, "agent.npz")))
if about["decoder"] == "open" or about["termination"] == "predict":
    sys.exit("this runner has no LSTM: neither open-loop options nor termination predict")


def mlp(network, value):
    """Return the output of a network."""
    for i, layer in enumerate(about["layers"][network]):
        value = (np.tanh(value) if i else value) @ x[f"{layer}.kernel"] + x[f"{layer}.bias"]
    return value


env = gymnasium.wrappers.RescaleAction(gymnasium.make(name), *about["actions"])
for seed in range(10):
    obs, _ = env.reset(seed=seed)
    duration, logit, total, ended = about["length"], -1.0, 0.0, False
    while not ended:
        if duration == about["length"] or (about["termination"] == "output" and logit > 0):
            seen = (obs - x["obs_statistics.mean"]) / x["obs_statistics.std"]
            option, duration = mlp("actor", np.clip(seen, -about["clip"], about["clip"])), 0
        action = option
        if about["decoder"]:
            state = obs[: about["proprioceptive_size"]] - x["executor.model.state_scale.mean"]
            state = state / x["executor.model.state_scale.std"]
            *action, logit = mlp("decoder", np.concatenate([state, option, [duration / about["length"]]]))
        duration += 1
        obs, reward, terminated, truncated, _ = env.step(np.clip(action, -1, 1).astype(np.float32))
        total, ended = total + float(reward), terminated or truncated
    print(f"return {total:.3f}")
