"""Measure ticks per second side by side: the C engine alone, rollout in jit, flat training.

python -m taic_jax.experiments.throughput --task half_cheetah --json throughput.json
"""

import dataclasses
import json
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import mujoco.batch
import numpy as np
import tyro

from taic_jax import config, envs
from taic_jax.envs.physics.mujoco import num_physical_cores
from taic_jax.options.execution import IdentityExecutor
from taic_jax.rl import ppo
from taic_jax.rl.rollout import rollout, start
from taic_jax.types import as_arrays

ROUNDS = 5


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure ticks per second on one task."""

    task: str = "half_cheetah"
    """A task whose physics is MuJoCo's."""
    num_envs: int = 256
    """Environments of the engine and of the rollout."""
    rollout_length: int = 128
    """Ticks per environment and measurement."""
    json: Path | None = None
    """Also write the table to this file."""


def engine(env: envs.Env, num_envs: int, length: int) -> Callable[[], Any]:
    """Return a loop over `mujoco.batch` from NumPy with random controls, on as many threads as the backend uses."""
    batch = mujoco.batch.Batch(env.model, num_envs, num_physical_cores())
    ctrl, random = batch.bind("ctrl"), np.random.default_rng(0)
    noise = random.uniform(-1, 1, (length, *ctrl.shape))

    def run() -> None:
        batch.reset()
        for row in noise:
            ctrl[:] = row
            batch.step(nstep=env.physics.substeps)

    return run


def rollout_in_jit(env: envs.Env, num_envs: int, length: int) -> Callable[[], Any]:
    """Return a compiled rollout with a 64x64 policy."""
    executor, key = IdentityExecutor(env.action_size), jax.random.key(0)
    settings = as_arrays(config.PPOConfig(num_envs=num_envs, rollout_length=length))
    state = ppo.init(settings, env, executor, key)
    decide = ppo.as_agent(settings, executor, state).decide()
    running = start(envs.AutoReset(env), executor, num_envs, key)
    compiled = jax.jit(lambda running: rollout(envs.AutoReset(env), executor, decide, running, key, length))
    return lambda: jax.block_until_ready(compiled(running))


def flat_training(env: envs.Env, settings: config.PPOConfig) -> Callable[[], Any]:
    """Return a compiled iteration of flat PPO: rollout, advantages and all updates."""
    executor = IdentityExecutor(env.action_size)
    settings = as_arrays(settings)
    state = ppo.init(settings, env, executor, jax.random.key(0))
    compiled = jax.jit(partial(ppo.iterate, settings, env, executor, 100))
    return lambda: jax.block_until_ready(compiled(state))


def measure(arguments: Arguments) -> dict[str, dict[str, float]]:
    """Return median ticks per second of each part and its ratio to the engine, round by round."""
    env = envs.make_env(arguments.task)
    size = (arguments.num_envs, arguments.rollout_length)
    settings = config.PPOConfig()
    parts = {
        "engine": (engine(env, *size), size[0] * size[1]),
        "rollout": (rollout_in_jit(env, *size), size[0] * size[1]),
        "flat_training": (flat_training(env, settings), settings.num_envs * settings.rollout_length),
    }
    speeds: dict[str, list[float]] = {name: [] for name in parts}
    for run, _ in parts.values():
        run()  # compile and warm up
    for _ in range(ROUNDS):
        for name, (run, ticks) in parts.items():
            begun = time.perf_counter()
            run()
            speeds[name].append(ticks / (time.perf_counter() - begun))
    return {
        name: {
            "ticks_per_second": statistics.median(values),
            "ratio_to_engine": statistics.median(np.divide(values, speeds["engine"])),
        }
        for name, values in speeds.items()
    }


def main() -> None:
    """Print the table."""
    arguments = tyro.cli(Arguments)
    table = measure(arguments)
    for name, row in table.items():
        print(f"{name:15} {row['ticks_per_second']:12,.0f} ticks/s   {row['ratio_to_engine']:5.2f} x engine")
    if arguments.json:
        arguments.json.write_text(json.dumps(table, indent=2) + "\n")


if __name__ == "__main__":
    main()
