"""Count the interactions that each method of a run takes to a threshold of its return in training.

python -m taic_jax.experiments.evidence.interactions RUN --threshold 0.9 [--out FILE]

A seed is there at the first log line from which on the mean of `--lines` lines is at least the threshold; a seed that
never is counts as having taken all interactions. Stage collect's are counted apart.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from taic_jax.analysis.statistics import probability_of_improvement
from taic_jax.command_line import tell
from taic_jax.config import COLLECT, TAIC
from taic_jax.experiments.evidence import table as evidence
from taic_jax.report.runs import LoadedRun, ReportError, read_run


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Count interactions to a threshold."""

    run: Annotated[Path, tyro.conf.Positional]
    """A finished run."""
    threshold: float = 0.9  # Return in training, of the last episode of each environment.
    lines: int = 5  # Log lines whose mean is compared.
    out: Path | None = None  # A table to write.


def interactions(run: LoadedRun, stage: str, threshold: float, lines: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the interactions [K] of a stage to the threshold, all of them if never reached; and whether it was."""
    rows = [row for row in run.of_stage(stage) if f"{stage}/return" in row]
    if len(rows) < lines:
        raise ReportError(f"--lines: expected at most the {len(rows)} log lines of {stage}, got {lines}")
    ticks = np.array([row["ticks"] for row in rows], float)
    returns = np.array([row[f"{stage}/return"] for row in rows], float)
    means = np.lib.stride_tricks.sliding_window_view(np.nan_to_num(returns, nan=-np.inf), lines, axis=0).mean(axis=-1)
    there = means >= threshold
    reached = there.any(axis=0)
    return np.where(reached, ticks[lines - 1 :][there.argmax(axis=0)], ticks[-1]), reached


def compare(run: LoadedRun, arguments: Arguments) -> list[dict[str, Any]]:
    """Return a line per method: interactions to the threshold, seeds there, and P that options take fewer."""
    stages = {"train" if method == TAIC else method: method for method in run.methods}
    taken = {
        method: interactions(run, stage, arguments.threshold, arguments.lines)
        for stage, method in stages.items()
        if run.of_stage(stage)
    }
    lines = []
    for method, (counts, there) in taken.items():
        better, (low, high) = probability_of_improvement(-taken[TAIC][0], -counts)
        line = {"method": method, "pre_training": run.ticks(COLLECT) if method == TAIC else 0}
        line |= evidence.with_interval(counts, ("interactions", "low", "high"))
        line |= {"there": int(there.sum()), "seeds": run.seeds, "p_options_first": better, "p_low": low, "p_high": high}
        lines.append(line | {"untrained": float(np.mean(run.methods[method]["return"]["first_per_seed"]))})
    return lines


def write_interactions(arguments: Arguments) -> None:
    """Write the lines, or print them."""
    lines = compare(read_run(arguments.run), arguments)
    if arguments.out:
        evidence.write_numbers(lines, arguments.out)
        return
    for line in lines:
        print(*(f"{name} {x:.4g} " if isinstance(x, float) else f"{name} {x} " for name, x in line.items()))


def main(args: Sequence[str] | None = None) -> int:
    """Count interactions, and return the exit code."""
    return tell(lambda: write_interactions(tyro.cli(Arguments, args=args)))


if __name__ == "__main__":
    sys.exit(main())
