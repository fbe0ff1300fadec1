"""Measure environments of Gymnasium beside its own vector environments, which NumPy steps.

python -m taic_jax.experiments.benchmark.vectors --ids HalfCheetah-v5 Pendulum-v1 --json vectors.json
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from taic_jax import envs
from taic_jax.envs.adapters.gymnasium import GYMNASIUM_PREFIX, find_spec
from taic_jax.experiments.benchmark.command import Command, Row, answer, show
from taic_jax.experiments.benchmark.loops import random_actions, stepping
from taic_jax.experiments.benchmark.timing import Loop, interleave


@dataclass(frozen=True)
class Arguments(Command):
    """Measure ticks per second under random actions, in loops that take turns."""

    ids: tuple[str, ...] = ("HalfCheetah-v5",)  # Environments, as ID or MODULE:ID.
    num_envs: int = 64  # Copies of each.
    length: int = 64  # Ticks of each copy in a round.
    rounds: int = 7  # Rounds in which each loop runs once; the table has medians.


def vector_loops(arguments: Arguments, name: str) -> dict[str, Loop]:
    """Return loops of Gymnasium's vector environments: copies in one process each (`async`), or in this (`sync`)."""
    import gymnasium

    loops, shape = {}, (arguments.length, arguments.num_envs)
    for mode in ("async", "sync"):
        vector = gymnasium.make_vec(find_spec(name), arguments.num_envs, mode)
        vector.reset(seed=0)
        actions = [vector.action_space.sample() for _ in range(arguments.length)]
        loops[mode] = Loop(
            lambda vector=vector, actions=actions: [vector.step(each) for each in actions], np.prod(shape)
        )
    return loops


def going_on(loop: Loop) -> Loop:
    """Return a loop that goes on with the state in which its last call ended, as vector environments do."""
    run: Any = loop.run
    states = list(run.args)

    def advance() -> Any:
        states[0], read = run.func(*states)
        return read

    return Loop(advance, loop.ticks)


def measure(arguments: Arguments) -> list[Row]:
    """Print and return a row for each environment: ticks per second, and the median over rounds of the ratios."""
    theirs = {name: vector_loops(arguments, name) for name in arguments.ids}  # forked before JAX has threads
    rows = []
    for name, loops in theirs.items():
        env = envs.make_env(GYMNASIUM_PREFIX + name)
        ours = going_on(stepping(env, random_actions(env, arguments.num_envs, arguments.length)))
        speeds = interleave(loops | {"ours": ours}, arguments.rounds)
        ratios = {f"ours / {mode}": speeds["ours"].ratio(speeds[mode]) for mode in loops}
        rows += show([{"environment": name} | {loop: speed.median for loop, speed in speeds.items()} | ratios])
    return rows


def main(args: Sequence[str] | None = None) -> int:
    """Print the table and return the exit code."""
    return answer(Arguments, measure, args)


if __name__ == "__main__":
    sys.exit(main())
