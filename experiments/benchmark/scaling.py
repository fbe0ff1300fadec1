"""The parts of an iteration's time, and the growth of a tick's time along four axes, each over a factor of 16."""

import itertools
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from taic_jax import envs
from taic_jax.config import PPOConfig
from taic_jax.experiments.benchmark import loops
from taic_jax.experiments.benchmark.command import Row
from taic_jax.experiments.benchmark.loops import Training
from taic_jax.experiments.benchmark.timing import Loop, interleave
from taic_jax.options.execution import IdentityExecutor
from taic_jax.runtime.checkpoint import Checkpoints

FACTORS = (1, 4, 16)
SMALLEST = {"environments": 16, "seeds": 1, "option length": 2, "observation size": 8}
SAVED = 10  # Iterations in a call of `saving_loop`.


def shares(env: envs.Env, config: PPOConfig, rounds: int) -> dict[str, float]:
    """Return the share of each part in an iteration of flat training.

    Loops are nested, and a part is the difference of two: the engine alone; the task in jit, which hands arrays to the
    engine and adds rewards and resets; the rollout, which adds the policy; the iteration, which adds advantages and
    updates. All make the same number of ticks, the first three under the same actions.
    """
    policy = loops.untrained_rollout(env, config.num_envs, config.rollout_length)
    actions, training = policy.run()[1].action, Training(env, IdentityExecutor(env.action_size), config)
    engine = {"physics": loops.bare_engine(env, actions)} if loops.has_engine(env) else {}
    task = {"transfer" if engine else "physics": loops.stepping(env, actions)}
    speeds = interleave(engine | task | {"policy": policy, "update": training}, rounds)
    times = [0.0, *(1.0 / speed.median for speed in speeds.values())]
    return {name: (b - a) / times[-1] for name, (a, b) in zip(speeds, itertools.pairwise(times), strict=True)}


def saving_loop(training: Training, checkpoints: Checkpoints | None = None) -> Loop:
    """Return ten iterations with a checkpoint, if any, after each, written while the next is computed, as in a run."""
    steps = itertools.count(1)

    def run() -> None:
        for step in itertools.islice(steps, SAVED):
            training()
            if checkpoints:
                checkpoints.save(step, training.state)
        if checkpoints:
            checkpoints.wait()

    return Loop(run, SAVED * training.ticks)


def saving(env: envs.Env, config: PPOConfig, counts: Sequence[int], rounds: int) -> dict[int, float]:
    """Return by the number of seeds the time that a checkpoint after each iteration adds, as a share."""
    shares = {}
    for seeds in counts:
        training = Training(env, IdentityExecutor(env.action_size), config, seeds)
        with tempfile.TemporaryDirectory() as folder:
            pair = {"without": saving_loop(training), "with": saving_loop(training, Checkpoints(Path(folder)))}
            speeds = interleave(pair, rounds)
        shares[seeds] = speeds["without"].ratio(speeds["with"]) - 1.0
    return shares


class Widened(envs.Wrapper):
    """A task whose observation is extended to `size` by functions of it."""

    def __init__(self, env: envs.Env, size: int):
        super().__init__(env)
        self.observation_size = size

    def reset(self, key: Key[Array, ""]) -> envs.State:
        return self._widen(self.env.reset(key))

    def restart(self, key: Key[Array, ""], ended: Any) -> envs.State:
        return self._widen(self.env.restart(key, ended))

    def step(self, state: envs.State, action: Float[Array, " A"]) -> envs.State:
        return self._widen(self.env.step(state, action))

    def _widen(self, state: envs.State) -> envs.State:
        more = self.observation_size - state.obs.shape[0]
        entries = jnp.sin(jnp.arange(1, more + 1, dtype=jnp.float32) * jnp.sum(state.obs))
        return state.replace(obs=jnp.concatenate([state.obs, entries]))


def scaling(env: envs.Env, config: PPOConfig, steps: int, rounds: int) -> Iterator[Row]:
    """Yield the cost of a tick of training along each axis, the others fixed; `of_linear` above 1 is worse than linear.

    More environments or seeds make more ticks: linear is a constant time of a tick. Longer options and wider
    observations make as many ticks: linear is a time in proportion.
    """
    for axis, first in SMALLEST.items():
        values = [first * factor for factor in FACTORS]
        speeds = interleave({str(value): _at(env, config, steps, axis, value) for value in values}, rounds)
        for value, speed in zip(values, speeds.values(), strict=True):
            linear = 1 if axis in ("environments", "seeds") else value / first
            of_linear = speeds[str(first)].ratio(speed) / linear
            yield {"axis": axis, "value": value, "microseconds": 1e6 / speed.median, "of_linear": of_linear}


def _at(env: envs.Env, config: PPOConfig, steps: int, axis: str, value: int) -> Training:
    """Return the training loop with one axis at a value, of flat training but for the option length."""
    if axis == "option length":
        options = loops.options_config("fixed", "open", steps, length=value)
        return Training(env, loops.executor_of(env, options), config)
    if axis == "observation size":
        env = Widened(env, max(value, env.observation_size))
    config = replace(config, num_envs=value) if axis == "environments" else config
    return Training(env, IdentityExecutor(env.action_size), config, value if axis == "seeds" else 1)
