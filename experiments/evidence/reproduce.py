"""Compare reproduced rows with those of the table.

python -m taic_jax.experiments.evidence --only walker2d/fixed-open-both --table again.jsonl --run-dir runs/again
python -m taic_jax.experiments.evidence.reproduce again.jsonl

The same seeds on another machine differ in the last bit, and after some steps in everything: a row is reproduced if its
interquartile mean is within the interval of the committed row.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from scipy import stats

from taic_jax.analysis.statistics import exact_interval
from taic_jax.command_line import tell
from taic_jax.experiments.evidence import table as evidence
from taic_jax.experiments.evidence.measures import PREFIX, is_reliable
from taic_jax.experiments.evidence.table import EvidenceRows, TableError

# Heading, and the number per seed, of each measure in the figures.
MEASURES = {
    "untrained": "first",
    "return": "last",
    "distance correlation": f"{PREFIX}prior/one/distance_correlation",
    "closest approach": "final/closest_approach",
    "smoothness": "smoothness",
    "effect of dimension 0": "effect/0",
    "effect of dimension 1": "effect/1",
}
OURS, THEIRS = ("again", "again_low", "again_high"), ("value", "low", "high")


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Compare reproduced rows with those of the table."""

    again: Annotated[Path, tyro.conf.Positional]
    """The table of the reproduced rows, by `evidence --table`."""
    table: Path = evidence.TABLE  # The table to compare with.
    out: Path = evidence.RESULTS / "again.csv"  # The comparison.


def counterpart(row: dict[str, Any], rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the row of the same task, method, seeds and config; raise `TableError` if there is none."""
    name = f"{row['task']}/{row['method']}"
    for other in rows:
        if all(row[key] == other[key] for key in ("task", "method", "seed", "seeds")):
            if row["config"] != other["config"]:
                raise TableError(f"{name}: made with config {row['config']}, but the table has {other['config']}")
            return other
    raise TableError(f"{name}: the table has no row of {row['seeds']} seeds from {row['seed']}")


def compare(ours: EvidenceRows, theirs: EvidenceRows) -> list[dict[str, Any]]:
    """Return a line per measure: the table's value, the reproduced one, and whether it is within the interval."""
    lines = []
    for measure, name in MEASURES.items():
        if name in theirs.numbers:
            values, fresh = theirs.numbers[name], ours.numbers[name]
            p = float(stats.mannwhitneyu(values, fresh).pvalue)
            lines.append((measure, evidence.with_interval(values, THEIRS) | evidence.with_interval(fresh, OURS), p))
    if "success_after" in theirs.numbers:
        lines.append(("recovered", share(theirs, THEIRS) | share(ours, OURS), ""))
    name = {"task": theirs.task, "method": theirs.method, "seeds": len(theirs.seeds)}
    return [
        name | {"measure": measure} | line | {"within": line["low"] <= line["again"] <= line["high"], "p": p}
        for measure, line, p in lines
    ]


def share(runs: EvidenceRows, names: Sequence[str]) -> dict[str, float]:
    """Return the share of seeds that recovered, and its exact 95 % interval."""
    back = is_reliable(runs.numbers["success_after"])
    return dict(zip(names, (float(np.mean(back)), *exact_interval(int(back.sum()), len(back))), strict=True))


def write_comparison(arguments: Arguments) -> None:
    """Write the comparison, and print how much of it was reproduced."""
    committed, fresh = evidence.read_table(arguments.table), evidence.read_table(arguments.again)
    if not fresh:
        raise TableError(f"{arguments.again}: no rows; python -m taic_jax.experiments.evidence --table makes them")
    pairs = [(row, counterpart(row, committed)) for row in fresh]
    lines = [line for pair in pairs for line in compare(*(evidence.select([x], x["task"], x["method"]) for x in pair))]
    evidence.write_numbers(lines, arguments.out)
    print(f"{sum(line['within'] for line in lines)} of {len(lines)} within the interval")


def main(args: Sequence[str] | None = None) -> int:
    """Compare two tables, and return the exit code."""
    return tell(lambda: write_comparison(tyro.cli(Arguments, args=args)))


if __name__ == "__main__":
    sys.exit(main())
