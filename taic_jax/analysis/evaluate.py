"""Evaluation of an agent in whole episodes, and trajectories for videos."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Key

from taic_jax.envs.base import Env
from taic_jax.envs.wrappers import AutoReset
from taic_jax.rl.agent import Agent
from taic_jax.rl.rollout import Rollout, count_durations, rollout, start
from taic_jax.types import Scalar


def evaluate(env: Env, agent: Agent, key: Key[Array, ""], episodes: int, exploration: Scalar = 1.0) -> dict[str, Array]:
    """Return means over `episodes` whole episodes, one per environment, each from a fresh start.

    `env` is not wrapped to reset itself. `exploration` scales the policy's noise; 0 takes its mean options.

    Returns:
      Scalars: `return`, `length` in ticks, and of every metric of the task its mean over the ticks of an episode
      (`mean/NAME`) and its value at the last tick (`final/NAME`); and `durations` [L], the counts of options of
      1, 2, ... L ticks.
    """
    ticks = _run(env, agent, key, episodes, env.episode_length, exploration, lambda state: state.metrics)
    done = (ticks.terminated | ticks.truncated).astype(jnp.float32)
    first = (jnp.cumsum(done, axis=0) - done == 0).astype(jnp.float32)
    length = jnp.sum(first, axis=0)
    result = {"return": jnp.sum(first * ticks.reward, axis=0), "length": length}
    for name, values in ticks.extras.items():
        result[f"mean/{name}"] = jnp.sum(first * values, axis=0) / length
        result[f"final/{name}"] = jnp.sum(first * done * values, axis=0)
    durations = count_durations(ticks, agent.executor.length, first > 0)
    return jax.tree.map(jnp.mean, result) | {"durations": durations}


def record(env: Env, agent: Agent, key: Key[Array, ""], ticks: int) -> Any:
    """Return `ticks` ticks of physics [T, ...] of one environment under the mean options, for `env.render`."""
    return trace(env, agent, key, ticks, 0.0).extras


def trace(env: Env, agent: Agent, key: Key[Array, ""], ticks: int, exploration: Scalar = 1.0) -> Rollout:
    """Return `ticks` ticks [T, ...] of one environment, whose `extras` are the physics for `env.render`."""
    run = _run(env, agent, key, 1, ticks, exploration, lambda state: state.physics)
    return jax.tree.map(lambda x: x[:, 0], run)


def _run(
    env: Env, agent: Agent, key: Key[Array, ""], num_envs: int, ticks: int, exploration: Scalar, extras: Callable
) -> Rollout:
    key_start, key_rollout = jax.random.split(key)
    env = AutoReset(env.evaluated)
    running = start(env, agent.executor, num_envs, key_start)
    return rollout(env, agent.executor, agent.decide(exploration), running, key_rollout, ticks, extras)[1]
