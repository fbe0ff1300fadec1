"""Run an agent of a finished run in Gymnasium, to compare with its exports: python run_agent.py RUN [ENV [METHOD]]."""

import sys

import gymnasium
import numpy as np

import taic_jax as taic

run, name, method = sys.argv[1:] + ["HalfCheetah-v5", "taic"][len(sys.argv) - 2 :]
agent = taic.load(run).agents[method][0]
env = gymnasium.make(name)
if isinstance(env.action_space, gymnasium.spaces.Discrete):  # the action is one-hot
    env = gymnasium.wrappers.TransformAction(env, np.argmax, None)
else:
    env = gymnasium.wrappers.RescaleAction(env, -1, 1)
for seed in range(10):
    obs, _ = env.reset(seed=seed)
    carry, total, ended = agent.start(obs), 0.0, False
    while not ended:
        carry, action, _ = agent.act(carry, obs)
        obs, reward, terminated, truncated, _ = env.step(np.asarray(action))
        total, ended = total + float(reward), terminated or truncated
    print(f"return {total:.3f}")
