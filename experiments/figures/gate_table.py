"""The table of the gate: how far a navigator gets over options that steer, and over those without a part of them."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from taic_jax.experiments.evidence.plan import ARENAS, FRESH_SEEDS, GATES, LEFT_OUT_SEEDS
from taic_jax.experiments.evidence.table import (
    RESULTS,
    TABLE,
    EvidenceRows,
    TableError,
    read_table,
    with_interval,
    write_numbers,
)
from taic_jax.experiments.figures.drawing import Rows, read_methods

MINIMA = {"gate": FRESH_SEEDS} | {f"without-{part}": LEFT_OUT_SEEDS for part in GATES}
MEASURES = (
    "codes/speed",
    "codes/agreement",
    "codes/order_one",
    "codes/order_many",
    *(f"{name}/{m}" for m in ("success", "overturned_per_1000") for name in ARENAS),
)
PASSED, OVERTURNED = 0.8, 0.2  # Least success in each arena, and most overturned in 1000 ticks, of options that pass.
FIELDS = ("options", "seeds", "measure", "iqm", "low", "high", "per_seed", "remarks")


@dataclasses.dataclass(frozen=True)
class GateTable:
    """Write the table of the gate."""

    table: Path = TABLE  # The table of finished runs.
    out: Path = RESULTS / "gate.csv"  # The file.

    def make(self) -> None:
        """Write the table."""
        methods = read_methods(read_table(self.table), "ant", MINIMA)
        if not methods:
            remedy = "python -m taic_jax.experiments.evidence --only ant/steering"
            raise TableError(f"{self.table}: no row of the gate; {remedy} makes them")
        write_numbers([row for runs in methods.values() for row in lines(runs)], self.out, FIELDS)


def lines(runs: EvidenceRows) -> Rows:
    """Return a row per measure of one kind of options, and one of the shares that pass."""
    start: dict[str, Any] = {"options": runs.method, "seeds": len(runs.seeds), "remarks": "; ".join(runs.remarks)}
    rows = [start | {"measure": name} | with_interval(runs.numbers[name]) for name in MEASURES]
    for row in rows:
        row["per_seed"] = runs.numbers[row["measure"]]
    reached = np.min([runs.numbers[f"{name}/success"] for name in ARENAS], axis=0)
    upright = np.max([runs.numbers[f"{name}/overturned_per_1000"] for name in ARENAS], axis=0)
    for measure, passed in {"reach": reached >= PASSED, "pass": (reached >= PASSED) & (upright <= OVERTURNED)}.items():
        rows.append(start | {"measure": measure, "iqm": float(passed.mean()), "per_seed": passed.astype(float)})
    return rows
