"""Figure 5, the room: interpolation between two options, one dimension of an option at a time, and recovery (C4).

The numbers of 5a and 5b are interquartile means over option models with 95 % bootstrap intervals: the straightness of
interpolated codes, beside codes of other windows between the same ends, and the effect of each dimension on the end
point. In 5c a seed has recovered from a sudden change of the room if at least 90 % of the last 100 training episodes
within 200 000 ticks after it reach the goal; see `evidence.measures.recovery_of`.
"""

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture
from scipy import stats

from taic_jax.analysis.statistics import exact_interval
from taic_jax.experiments.evidence.measures import AFTER, SWEEP, is_reliable
from taic_jax.experiments.evidence.plan import PATHS, RECOVERING, RECOVERY
from taic_jax.experiments.evidence.table import EvidenceRows, select, with_interval
from taic_jax.experiments.figures import drawing
from taic_jax.experiments.figures.drawing import Figure, Rows

MODELS = 10
SEEDS = 50
BEFORE = 80_000  # Ticks before the change that are drawn.
COLOURS = {"options": drawing.RED, "flat": drawing.BLACK}


class Figure5ab(Figure):
    """Draw figures 5a and 5b, and write their numbers."""

    number = "5ab"

    def draw(self, rows: Rows) -> tuple[Picture, Rows]:
        runs = select(rows, RECOVERY, PATHS, MODELS)
        example = next(row["example"] for row in rows if (row["task"], row["method"]) == (RECOVERY, PATHS))
        numbers, remarks = [], {"remarks": "; ".join(runs.remarks)}
        for name, values in runs.numbers.items():
            numbers.append({"measure": name, "models": len(values)} | with_interval(values) | remarks)
        return draw_options(example, numbers, runs.remarks), numbers


def draw_paths(axes: Axes, paths: np.ndarray, originals: np.ndarray, values: np.ndarray) -> None:
    """Draw decoded paths [I, L, 2] in the colours of their values [I], and original ones as red dashes."""
    for path, value in zip(paths, (values - values.min()) / np.ptp(values), strict=True):
        axes.plot(*path.T, color=plt.colormaps["viridis"](0.9 * value), linewidth=1.6)
    for path in originals:
        axes.plot(*path.T, "--", color=drawing.RED, linewidth=1.6)
    axes.plot(0, 0, "o", color="black", markersize=3)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x in m")


def draw_options(example: dict[str, Any], rows: Rows, remarks: Sequence[str]) -> Picture:
    """Draw the interpolation, the effect of each dimension, and the numbers."""
    between, paths, swept = (np.array(example[name]) for name in ("between", "interpolated", "swept"))
    size, columns = len(swept), (len(swept) + 1) // 2
    figure = plt.figure(figsize=(12.5, 6.6))
    grid = figure.add_gridspec(2, 2 + columns, width_ratios=[1.7, 0.8] + [1] * columns)
    left = figure.add_subplot(grid[:, 0])
    draw_paths(left, paths, between, np.arange(len(paths)))
    left.set_ylabel("y in m")
    left.plot([], [], "--", color=drawing.RED, label="windows of the experience")
    left.legend(loc="upper left")
    drawing.mark(left, "a) between two options", remarks)
    for d in range(size):
        axes = figure.add_subplot(grid[d // columns, 2 + d % columns])
        draw_paths(axes, swept[d], between[:1], SWEEP)
        axes.set_title(f"b) dimension {d + 1}" if d == 0 else f"dimension {d + 1}", loc="left")
    numbers = {row["measure"]: row for row in rows}
    groups = (("straightness", ("smoothness", "shuffled"), ("interpolated", "other windows")),
              ("end point, m", [f"effect/{d}" for d in range(size)], [str(d + 1) for d in range(size)]))  # fmt: skip
    for i, (label, names, ticks) in enumerate(groups):
        axes = figure.add_subplot(grid[i, 1])
        values = np.array([[numbers[name][key] for key in ("iqm", "low", "high")] for name in names])
        errors = np.abs(values[:, 1:].T - values[:, 0])
        colours = [drawing.BLUE, drawing.GREY] if i == 0 else drawing.BLUE
        axes.bar(range(len(names)), values[:, 0], yerr=np.nan_to_num(errors), color=colours, capsize=3)
        axes.set_xticks(range(len(names)), ticks, rotation=30 if i == 0 else 0, ha="right" if i == 0 else "center")
        axes.set_ylabel(label)
        if i:
            axes.set_xlabel("dimension")
    return figure


class Figure5c(Figure):
    """Draw figure 5c, and write its numbers."""

    number = "5c"
    fields = (
        "method", "seeds", "changed", "learnt_before", "recovered", "low", "high", "recovered_of_learnt", "fisher_p",
        "remarks",
    )  # fmt: skip

    def draw(self, rows: Rows) -> tuple[Picture, Rows]:
        methods = {method: select(rows, RECOVERY, method, SEEDS) for method in RECOVERING}
        lines = [count_recovered(runs) for runs in methods.values()]
        counts = [(line["recovered"], line["seeds"] - line["recovered"]) for line in lines]
        for line in lines:
            line["fisher_p"] = float(stats.fisher_exact(counts).pvalue)
        return draw_recovery(methods, lines), lines


def count_recovered(runs: EvidenceRows) -> dict[str, Any]:
    """Return the numbers of one method."""
    back, learnt = (is_reliable(runs.numbers[f"success_{when}"]) for when in ("after", "before"))
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


def draw_recovery(methods: dict[str, EvidenceRows], rows: Rows) -> Picture:
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
