"""Numbers over seeds as the figures and comparisons state them, and their tables on disk."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taic_jax.analysis.statistics import bootstrap_interval, iqm, probability_of_improvement
from taic_jax.runtime.files import save_table

DIGITS = 5  # Significant digits of every number in a table.
BOUNDS = ("", "_low", "_high")


def with_interval(values: np.ndarray, names: Sequence[str] = ("iqm", "low", "high")) -> dict[str, float]:
    """Return the interquartile mean of one number per seed, and its 95 % interval."""
    return dict(zip(names, (float(iqm(values)), *bootstrap_interval(values)), strict=True))


def with_improvement(name: str, values: np.ndarray, others: np.ndarray) -> dict[str, float]:
    """Return the probability that a seed is better than one of the others, and its 95 % interval."""
    p, interval = probability_of_improvement(values, others)
    return {f"{name}{bound}": value for bound, value in zip(BOUNDS, (p, *interval), strict=True)}


def write_numbers(rows: Sequence[dict[str, Any]], out: Path, fields: Sequence[str] = ()) -> None:
    """Write rows of numbers, which may lack some of the fields, as CSV, and print them; an array is one per seed."""
    texts = [dict.fromkeys(fields, "") | {name: _as_text(value) for name, value in row.items()} for row in rows]
    save_table(out, texts)
    for text in texts:
        print("  ".join(f"{name} {value}" for name, value in text.items() if value not in (None, "")))


def _as_text(value: Any) -> Any:
    """Return floats with the digits of the table, and other values unchanged."""
    if isinstance(value, np.ndarray):
        return " ".join(f"{x:.{DIGITS}g}" for x in value)
    return f"{value:.{DIGITS}g}" if isinstance(value, float) else value
