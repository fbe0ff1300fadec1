"""Run an agent of `taic export --format npz` in Gymnasium with NumPy alone: python run_npz.py FOLDER [ENV]."""

import json
import sys
from pathlib import Path

import gymnasium
import numpy as np

folder, name = [*sys.argv[1:], "HalfCheetah-v5"][:2]
about = json.loads(Path(folder, "agent.json").read_text())
x = dict(np.load(Path(folder, "agent.npz")))
D, E = (f"executor.model.params.{network}.params." for network in ("decoder", "encoder"))


def dense(layer, value):
    """Return the output of a linear layer."""
    return value @ x[f"{layer}.kernel"] + x[f"{layer}.bias"]


def mlp(network, *values):
    """Return the output of linear layers with tanh between them."""
    first, *layers = about["layers"][network]
    value = dense(first, np.concatenate(values))
    for layer in layers:
        value = dense(layer, np.tanh(value))
    return value


def values(value):
    """Return the values of DQN, by layers with rectifiers, and perhaps layer norms, between them."""
    names = about["layers"]["values"]
    first, *layers = (name for name in names if f"{name}.kernel" in x)
    value = dense(first, value)
    for i, layer in enumerate(layers):
        if norms := [name for name in names if name.endswith(f"LayerNorm_{i}")]:
            value = (value - value.mean()) / np.sqrt(value.var() + 1e-6)
            value = value * x[f"{norms[0]}.scale"] + x[f"{norms[0]}.bias"]
        value = dense(layer, np.maximum(value, 0))
    return value


def one_hot(scores):
    """Return 1 at the greatest of the scores and 0 elsewhere."""
    return np.eye(len(scores))[np.argmax(scores)]


def lstm(cell, carry, value):
    """Return the next carry of an LSTM, memory and output."""
    i, f, g, o = (value @ x[f"{cell}.i{gate}.kernel"] + dense(f"{cell}.h{gate}", carry[1]) for gate in "ifgo")
    i, f, o = (1 / (1 + np.exp(-gate)) for gate in (i, f, o))
    memory = f * carry[0] + i * np.tanh(g)
    return memory, o * np.tanh(memory)


def scaled(scale, value):
    """Return a value in standard deviations from the mean."""
    return (value - x[f"{scale}.mean"]) / x[f"{scale}.std"]


def ended():
    """Return whether the option ends by its rule: D's end signal, or P surprised by the state, given E's code."""
    if about["termination"] == "predict":
        code = dense(E + "head", read[1])[: len(option)]
        change = mlp("predictor", scaled("executor.model.state_scale", first), code)
        error = np.mean((change - scaled("executor.model.change_scale", state - first)) ** 2)
        return error >= x["executor.model.delta"]
    return about["termination"] == "output" and logit > 0


env = gymnasium.make(name)
if about["discrete"]:  # the action is one-hot
    env = gymnasium.wrappers.TransformAction(env, np.argmax, None)
else:
    env = gymnasium.wrappers.RescaleAction(env, *about["actions"])
for seed in range(10):
    obs, _ = env.reset(seed=seed)
    duration, total, done = 0, 0.0, False
    while not done:
        state = obs[: about["proprioceptive_size"]]
        if duration in (0, about["length"]) or ended():
            seen = np.clip(scaled("obs_statistics", obs), -about["clip"], about["clip"])
            option = values(seen) if about["layers"]["values"] else mlp("actor", seen)
            duration, first = 0, state
            if about["bound"]:  # of SAC: the mean is squashed, and the other half of the outputs is its deviation
                option = about["bound"] * np.tanh(np.split(option, 2)[0])
            if about["one_hot"]:
                option = one_hot(option) @ x.get("executor.model.book", np.eye(len(option)))
            if about["decoder"] == "open":
                carry = np.split(np.tanh(dense(D + "first", option)), 2)
            if about["termination"] == "predict":
                read = np.zeros((2, *x[E + "cell.hf.bias"].shape))
        action = option
        if about["decoder"] == "open":
            carry = lstm(D + "cell", carry, option)
            *action, logit = dense(D + "head", carry[1])
        elif about["decoder"] == "closed":
            share = [duration / about["length"]]
            *action, logit = mlp("decoder", scaled("executor.model.state_scale", state), option, share)
        action = one_hot(action) if about["discrete"] else np.clip(action, -1, 1).astype(np.float32)
        if about["termination"] == "predict":
            read = lstm(E + "cell", read, action)
        duration += 1
        obs, reward, terminated, truncated, _ = env.step(action)
        total, done = total + float(reward), terminated or truncated
    print(f"return {total:.3f}")
