"""Measure the time to a result: from the start of a process to a policy whose mean actions return enough.

python -m taic_jax.experiments.benchmark.result --tasks half_cheetah hopper --seeds 5

Libraries take turns, each alone on the machine. The time includes imports, compilation and training, and no evaluation.
Ours starts twice: cold, without compiled programs, and warm, with those of the first start.
"""

import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

from taic_jax.experiments.benchmark.climbs import EPISODES, TICKS
from taic_jax.experiments.benchmark.command import Command, Row, answer, show
from taic_jax.experiments.benchmark.processes import cache_in

THRESHOLDS = {"half_cheetah": 3000.0, "hopper": 2000.0, "walker2d": 2000.0, "ant": 1500.0}
Library = Literal["taic_jax", "stable_baselines3"]


@dataclass(frozen=True)
class Arguments(Command):
    """Measure the seconds to a policy that returns enough, library by library."""

    tasks: tuple[Literal["half_cheetah", "hopper", "walker2d", "ant"], ...] = ("half_cheetah",)  # Gymnasium's robots.
    libraries: tuple[Library, ...] = ("taic_jax", "stable_baselines3")  # Libraries (extra peers for others').
    seed: int = 0  # The first seed.
    seeds: int = 5  # Seeds of each library.


class Arrival(NamedTuple):
    """The seconds, less those of evaluation, and the ticks to the threshold; none if the budget ended before it."""

    seconds: float | None = None
    ticks: int | None = None


def arrival(library: Library, task: str, seed: int, cache: Path) -> Arrival:
    """Train one seed in a process until an evaluation passes the task's threshold; raise `RuntimeError` if it fails.

    Compiled programs are kept in the folder `cache`.
    """
    command = [sys.executable, "-m", "taic_jax.experiments.benchmark.climbs", library, task, str(seed)]
    begun = time.perf_counter()
    with subprocess.Popen(command, env=cache_in(cache), stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout
        for line in process.stdout:
            ticks, returned, evaluating = (float(text) for text in line.split())
            if returned >= THRESHOLDS[task]:
                process.kill()
                return Arrival(time.perf_counter() - begun - evaluating, int(ticks))
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)} failed with exit code {process.returncode}")
    return Arrival()


def row(task: str, name: str, arrivals: Sequence[Arrival]) -> Row:
    """Return a line of the table: medians and ranges over the seeds that arrived."""
    there = sorted(each.seconds for each in arrivals if each.seconds is not None)
    ticks = [each.ticks for each in arrivals if each.ticks is not None]
    return {
        "task and library": f"{task}, {name}",
        "seconds, median": statistics.median(there) if there else None,
        "least": there[0] if there else None,
        "most": there[-1] if there else None,
        "ticks, median": statistics.median(ticks) if ticks else None,
        "arrived": f"{len(there)} of {len(arrivals)}",
    }


def measure(arguments: Arguments) -> list[Row]:
    """Print and return a line for each task and library."""
    print(f"{TICKS:,} ticks at most; an evaluation has {EPISODES} episodes")
    rows: list[Row] = []
    for task in arguments.tasks:
        arrivals: dict[str, list[Arrival]] = {}
        for seed in range(arguments.seed, arguments.seed + arguments.seeds):
            for library in arguments.libraries:
                with tempfile.TemporaryDirectory() as cache:
                    for start in ("cold", "warm") if library == "taic_jax" else ("",):
                        name = f"{library} {start}".strip()
                        arrivals.setdefault(name, []).append(arrival(library, task, seed, Path(cache)))
        rows += show(row(task, name, each) for name, each in arrivals.items())
    return rows


def main(args: Sequence[str] | None = None) -> int:
    """Print the table and return the exit code."""
    return answer(Arguments, measure, args)


if __name__ == "__main__":
    sys.exit(main())
