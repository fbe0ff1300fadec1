"""Figures 5a and 5b: interpolation between two options of the room, and one dimension of an option at a time.

The numbers are interquartile means over option models with 95 % bootstrap intervals: the straightness of interpolated
codes, beside codes of other windows between the same ends, and the effect of each dimension on the end point.
"""

from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture

from taic_jax.experiments.evidence.measures import SWEEP
from taic_jax.experiments.evidence.numbers import with_interval
from taic_jax.experiments.evidence.plan import PATHS, RECOVERY
from taic_jax.experiments.evidence.table import select
from taic_jax.experiments.figures import drawing
from taic_jax.experiments.figures.frame import Figure, Rows

MODELS = 10


class Figure5ab(Figure):
    """Draw figures 5a and 5b, and write their numbers."""

    number = "5ab"

    def draw(self, rows: Rows) -> tuple[Picture, Rows]:
        runs = select(rows, RECOVERY, PATHS, MODELS)
        example = next(row["example"] for row in rows if (row["task"], row["method"]) == (RECOVERY, PATHS))
        numbers, remarks = [], {"remarks": "; ".join(runs.remarks)}
        for name, values in runs.numbers.items():
            numbers.append({"measure": name, "models": len(values)} | with_interval(values) | remarks)
        return picture(example, numbers, runs.remarks), numbers


def draw_paths(axes: Axes, paths: np.ndarray, originals: np.ndarray, values: np.ndarray) -> None:
    """Draw decoded paths [I, L, 2] in the colours of their values [I], and original ones as red dashes."""
    for path, value in zip(paths, (values - values.min()) / np.ptp(values), strict=True):
        axes.plot(*path.T, color=plt.colormaps["viridis"](0.9 * value), linewidth=1.6)
    for path in originals:
        axes.plot(*path.T, "--", color=drawing.RED, linewidth=1.6)
    axes.plot(0, 0, "o", color="black", markersize=3)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x in m")


def picture(example: dict[str, Any], rows: Rows, remarks: Sequence[str]) -> Picture:
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
