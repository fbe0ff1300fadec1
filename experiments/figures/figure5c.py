"""Figure 5c: recovery from a sudden change of the room, and the numbers of claim C4.

A seed has recovered if at least 90 % of the last 100 training episodes within 200 000 ticks after the change reach
the goal; see `evidence.measures.recovery_of`.
"""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure as Picture
from scipy import stats

from taic_jax.analysis.statistics import exact_interval
from taic_jax.experiments.evidence.measures import AFTER, has_learnt, has_recovered
from taic_jax.experiments.evidence.plan import RECOVERING, RECOVERY
from taic_jax.experiments.evidence.table import EvidenceRows, select
from taic_jax.experiments.figures import drawing
from taic_jax.experiments.figures.frame import Figure, Rows

SEEDS = 50
BEFORE = 80_000  # Ticks before the change that are drawn.
COLOURS = {"options": drawing.RED, "flat": drawing.BLACK}


class Figure5c(Figure):
    """Draw figure 5c, and write its numbers."""

    number = "5c"
    fields = (
        "method", "seeds", "changed", "learnt_before", "recovered", "low", "high", "recovered_of_learnt", "fisher_p",
        "remarks",
    )  # fmt: skip

    def draw(self, rows: Rows) -> tuple[Picture, Rows]:
        methods = {method: select(rows, RECOVERY, method, SEEDS) for method in RECOVERING}
        lines = [numbers(runs) for runs in methods.values()]
        counts = [(line["recovered"], line["seeds"] - line["recovered"]) for line in lines]
        for line in lines:
            line["fisher_p"] = float(stats.fisher_exact(counts).pvalue)
        return picture(methods, lines), lines


def numbers(runs: EvidenceRows) -> dict[str, Any]:
    """Return the numbers of one method."""
    back, learnt = has_recovered(runs.numbers), has_learnt(runs.numbers)
    count, total = int(back.sum()), len(back)
    low, high = exact_interval(count, total)
    short = int((runs.numbers["ticks_after"] < AFTER).sum())
    remarks = [*runs.remarks] + ([f"{short} had fewer than {AFTER:,} ticks after the change"] if short else [])
    return {
        "method": runs.method, "seeds": total, "changed": int(np.isfinite(runs.numbers["changed_at"]).sum()),
        "learnt_before": int(learnt.sum()), "recovered": count, "low": low, "high": high,
        "recovered_of_learnt": f"{int((back & learnt).sum())}/{int(learnt.sum())}", "remarks": "; ".join(remarks),
    }  # fmt: skip


def around_the_change(runs: EvidenceRows, grid: np.ndarray) -> np.ndarray:
    """Return the share of successes [K, G] at ticks from each seed's own change, without the seeds that had none."""
    rows = []
    for curve, at in zip(runs.curves["success"], runs.numbers["changed_at"], strict=True):
        finite = np.isfinite(curve)
        if np.isfinite(at) and finite.any():
            rows.append(np.interp(grid, runs.grid[finite] - at, curve[finite], left=np.nan, right=np.nan))
    return np.array(rows)


def picture(methods: dict[str, EvidenceRows], rows: Rows) -> Picture:
    """Draw the share of successes around the change, and the share of seeds that recovered."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.8), width_ratios=(3, 1))
    grid = np.linspace(-BEFORE, AFTER, 71)
    for method, runs in methods.items():
        values = around_the_change(runs, grid)
        label, colour = RECOVERING[method][0], COLOURS[method]
        left.plot(grid, values.T, color=colour, linewidth=0.4, alpha=0.18)
        count = np.isfinite(values).sum(axis=0)
        mean = np.divide(np.nansum(values, axis=0), count, out=np.full(len(grid), np.nan), where=count > 0)
        left.plot(grid, mean, color=colour, linewidth=2.4, label=f"{label}, mean", zorder=3)
    left.axvline(0, color="#555555", linewidth=1, linestyle=":")
    left.set_xlabel("interactions after the trap appeared")
    left.xaxis.set_major_formatter(lambda value, _: f"{value / 1e3:g} k")
    left.set_ylabel("share of episodes at the goal")
    figure.legend(loc="outside lower left", ncols=2)
    share = np.array([row["recovered"] / row["seeds"] for row in rows])
    errors = np.abs(np.array([[row["low"], row["high"]] for row in rows]).T - share)
    colours = [COLOURS[row["method"]] for row in rows]
    right.bar(range(len(rows)), share, yerr=errors, color=colours, alpha=0.85, capsize=5)
    names = [f"{RECOVERING[row['method']][0]}\n{row['recovered']} of {row['seeds']}" for row in rows]
    right.set_xticks(range(len(rows)), names)
    right.set_ylabel("share of seeds recovered")
    right.set_ylim(0, 1)
    remarks = [f"{row['method']}: {row['remarks']}" for row in rows if row["remarks"]]
    drawing.mark(left, "a trap appears after 1000 episodes", remarks)
    right.set_title(f"Fisher's exact p = {rows[0]['fisher_p']:.1g}", loc="left")
    return figure
