"""Where the time of an iteration goes, and how the time of a tick grows with what may grow by a factor of 16."""

import itertools
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from taic_jax import envs
from taic_jax.config import PPOConfig
from taic_jax.experiments.loops import (
    Training,
    bare_engine,
    has_engine,
    learnt_executor,
    options_config,
    stepping,
    untrained_rollout,
    untrained_ticks,
)
from taic_jax.experiments.turns import Loop, take_turns
from taic_jax.options.execution import IdentityExecutor
from taic_jax.runtime.checkpoint import Checkpoints

FACTORS = (1, 4, 16)
SMALLEST = {"environments": 16, "seeds": 1, "option length": 2, "observation size": 8}


def shares(env: envs.Env, config: PPOConfig, rounds: int) -> dict[str, float]:
    """Return which share of an iteration of flat training each part takes.

    Loops are nested, and each part is what the next loop takes beyond the one before: the engine alone; the task in
    jit, which hands arrays to the engine and adds rewards and resets; the rollout, which adds the policy; the
    iteration, which adds advantages and updates. All make the same number of ticks, the first three the very same ones.
    """
    compiled, begin = untrained_rollout(env, config.num_envs, config.rollout_length)
    actions = compiled(begin)[1].action
    training, ticks = Training(env, IdentityExecutor(env.action_size), config), actions[..., 0].size
    loops = [Loop("physics", bare_engine(env, actions), ticks)] if has_engine(env) else []
    loops.append(Loop("transfer" if loops else "physics", stepping(env, actions), ticks))
    loops.append(Loop("policy", lambda: jax.block_until_ready(compiled(begin)), ticks))
    loops.append(Loop("update", training, ticks))
    speeds = take_turns(loops, rounds)
    taken, before = {}, 0.0
    for name, speed in speeds.items():
        taken[name], before = 1.0 / speed.median - before, 1.0 / speed.median
    return {name: value / before for name, value in taken.items()}


class Saved:
    """Iterations of training with a checkpoint after each, written while the next is computed, as a run has them.

    Args:
      training: makes the iterations.
      folder: takes the checkpoints; without one, none are made.
    """

    ITERATIONS = 10
    """A call's; the last checkpoint is waited for."""

    def __init__(self, training: Training, folder: Path | None = None):
        self.ticks = self.ITERATIONS * training.ticks
        self._training, self._count = training, itertools.count(1)
        self._checkpoints = Checkpoints(folder) if folder else None

    def __call__(self) -> None:
        """Train for ten iterations more than before."""
        for _ in range(self.ITERATIONS):
            self._training()
            if self._checkpoints:
                self._checkpoints.save(next(self._count), self._training.state)
        if self._checkpoints:
            self._checkpoints.wait()


def saving(env: envs.Env, config: PPOConfig, counts: Sequence[int], rounds: int) -> dict[int, float]:
    """Return, by the number of seeds, which share of the time without checkpoints one after each iteration adds."""
    shares = {}
    for seeds in counts:
        training = Training(env, IdentityExecutor(env.action_size), config, seeds)
        with tempfile.TemporaryDirectory() as folder:
            loops = {"without": Saved(training), "with": Saved(training, Path(folder))}
            speeds = take_turns([Loop(name, loop, loop.ticks) for name, loop in loops.items()], rounds)
        shares[seeds] = speeds["without"].ratio(speeds["with"]) - 1.0
    return shares


class Widened(envs.Wrapper):
    """A task whose observation is followed by functions of it, up to a given size.

    Args:
      env: the task, of S entries.
      size: of the observation, at least S.
    """

    def __init__(self, env: envs.Env, size: int):
        super().__init__(env)
        self.observation_size = size

    def reset(self, key: Key[Array, ""]) -> envs.State:
        """Reset and widen the observation."""
        return self._widen(self.env.reset(key))

    def restart(self, key: Key[Array, ""], ended: Any) -> envs.State:
        """Restart and widen the observation."""
        return self._widen(self.env.restart(key, ended))

    def step(self, state: envs.State, action: Float[Array, " A"]) -> envs.State:
        """Step and widen the observation."""
        return self._widen(self.env.step(state, action))

    def _widen(self, state: envs.State) -> envs.State:
        more = self.observation_size - state.obs.shape[0]
        entries = jnp.sin(jnp.arange(1, more + 1, dtype=jnp.float32) * jnp.sum(state.obs))
        return state.replace(obs=jnp.concatenate([state.obs, entries]))


@dataclass(frozen=True)
class Cost:
    """What a tick takes at one value of an axis, and the whole relative to growing in proportion from the first."""

    axis: str
    value: int
    microseconds: float
    of_linear: float


def scaling(env: envs.Env, config: PPOConfig, steps: int, rounds: int) -> Iterator[Cost]:
    """Yield what a tick of training costs along each axis, the others fixed; `of_linear` above 1 is worse than linear.

    More environments or seeds make more ticks, so growing in proportion leaves the time of a tick as it is; longer
    options and wider observations make the same ticks, which then take longer in proportion.
    """
    for axis, first in SMALLEST.items():
        values = [first * factor for factor in FACTORS]
        loops = [_at(env, config, steps, axis, value) for value in values]
        speeds = take_turns(
            [Loop(str(value), loop, loop.ticks) for value, loop in zip(values, loops, strict=True)], rounds
        )
        for value in values:
            allowed = 1 if axis in ("environments", "seeds") else value / first
            ratio = speeds[str(first)].ratio(speeds[str(value)])
            yield Cost(axis, value, 1e6 / speeds[str(value)].median, ratio / allowed)


def _at(env: envs.Env, config: PPOConfig, steps: int, axis: str, value: int) -> Training:
    """Return the training loop with one axis at a value; all but the option length are measured on flat training."""
    flat = IdentityExecutor(env.action_size)
    if axis == "environments":
        return Training(env, flat, replace(config, num_envs=value))
    if axis == "seeds":
        return Training(env, flat, config, value)
    if axis == "observation size":
        return Training(Widened(env, max(value, env.observation_size)), flat, config)
    options = options_config("fixed", "open", steps, length=value)
    return Training(env, learnt_executor(env, untrained_ticks(env), options), config)
