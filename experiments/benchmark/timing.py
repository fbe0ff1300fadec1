"""Interleaved timing: loops take turns, so that a slow spell of the machine slows down all of them."""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np


@runtime_checkable
class Ticking(Protocol):
    """A loop to measure: a call runs it once, and makes `ticks` ticks."""

    @property
    def ticks(self) -> int: ...

    def __call__(self) -> Any: ...


class Loop(NamedTuple):
    """A function to measure, and the ticks that it makes."""

    run: Callable[[], Any]
    ticks: int

    def __call__(self) -> None:
        """Run the function, and wait for its arrays."""
        jax.block_until_ready(self.run())


class Speeds(NamedTuple):
    """Ticks per second of one loop in each round, and the seconds of its first call, compilation included."""

    rounds: list[float]
    first_call: float | None

    @property
    def median(self) -> float:
        """The median of the rounds."""
        return statistics.median(self.rounds)

    def ratio(self, other: "Speeds") -> float:
        """Return this speed over the other: the median over rounds, or of medians where their numbers differ."""
        if len(self.rounds) != len(other.rounds):
            return self.median / other.median
        return statistics.median(np.divide(self.rounds, other.rounds))


def seconds(run: Callable[[], Any]) -> float:
    """Return the seconds that one call takes."""
    begun = time.perf_counter()
    run()
    return time.perf_counter() - begun


def interleave(loops: Mapping[str, Ticking], rounds: int) -> dict[str, Speeds]:
    """Call every loop once to compile it, then once in each round, and return the speeds by name."""
    speeds = {name: Speeds([], seconds(loop)) for name, loop in loops.items()}
    for _ in range(rounds):
        for name, loop in loops.items():
            speeds[name].rounds.append(loop.ticks / seconds(loop))
    return speeds
