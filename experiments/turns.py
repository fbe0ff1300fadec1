"""Loops that take turns, so that whatever slows the machine down for a while slows down all of them."""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np


class Loop(NamedTuple):
    """Something to measure: what it is called, what runs it once, and the ticks it then makes."""

    name: str
    run: Callable[[], Any]
    ticks: int


class Speeds(NamedTuple):
    """Ticks per second of one loop in each round, and the seconds of its first call, compilation included."""

    rounds: list[float]
    first_call: float

    @property
    def median(self) -> float:
        """The median of the rounds."""
        return statistics.median(self.rounds)

    def ratio(self, other: "Speeds") -> float:
        """Return the median over the rounds of how many times as fast as the other this is."""
        return statistics.median(np.divide(self.rounds, other.rounds))


def seconds(run: Callable[[], Any]) -> float:
    """Return the seconds that one call takes."""
    begun = time.perf_counter()
    run()
    return time.perf_counter() - begun


def take_turns(loops: Sequence[Loop], rounds: int) -> dict[str, Speeds]:
    """Call every loop once to compile it and to warm up, then once in each round, and return their speeds by name."""
    speeds = {loop.name: Speeds([], seconds(loop.run)) for loop in loops}
    for _ in range(rounds):
        for loop in loops:
            speeds[loop.name].rounds.append(loop.ticks / seconds(loop.run))
    return speeds
