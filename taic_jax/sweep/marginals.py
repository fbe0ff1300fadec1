"""A picture of a sweep: for each axis, the score of every point over its value."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taic_jax.runtime.files import atomic_file
from taic_jax.sweep.axes import Axis, Point


def draw_marginals(path: Path, axes: Sequence[Axis], points: Sequence[Point], scores: Mapping[int, float]) -> None:
    """Draw one panel per axis: a dot per point, and a line of medians if the axis has a list of values."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.2 * len(axes), 3.0), layout="constrained")
    panels = figure.subplots(1, len(axes), sharey=True, squeeze=False)[0]
    y = np.array(list(scores.values()), float)
    for panel, axis in zip(panels, axes, strict=True):
        values = [points[i][axis.name] for i in scores]
        numeric = all(isinstance(value, int | float) for value in values)
        x: Any = np.array(values if numeric else [str(value) for value in values])
        panel.plot(x, y, "o", color="0.4", markersize=4)
        if not axis.is_range:
            candidates = [value if numeric else str(value) for value in axis.values]
            run = [value for value in candidates if np.isfinite(y[x == value]).any()]
            panel.plot(run, [np.nanmedian(y[x == value]) for value in run], "-", color="C0")
        if numeric and x.min() > 0 and (axis.logarithmic or x.max() / x.min() >= 10):
            panel.set_xscale("log")
        panel.set_xlabel(axis.name)
    panels[0].set_ylabel("return, interquartile mean")
    with atomic_file(path) as file:
        figure.savefig(file, format="png", dpi=120)
