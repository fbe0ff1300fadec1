"""Parts of all figures: colours, curves of many seeds, and remarks on missing data."""

import textwrap
from collections.abc import Iterable, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image

from taic_jax.analysis.statistics import iqm, stratified_interval

# Okabe and Ito's palette for the colour-blind, with an olive and a purple.
COLOURS = BLACK, OLIVE, GREY, PINK, SKY, ORANGE, BLUE, GREEN, RED, PURPLE = (
    "#000000", "#a89b00", "#8c8c8c", "#cc79a7", "#56b4e9", "#e69f00", "#0072b2", "#009e73", "#d55e00", "#6a1b9a",
)  # fmt: skip
WARNING = "#b00020"
LEGEND = "curves: while training, with its noise; dots: after training, mean actions or mean options, without noise"
"""Title of the legend of panels with curves."""

styled = plt.rc_context({
    "font.size": 10, "axes.titlesize": 11, "axes.spines.top": False, "axes.spines.right": False,
    "legend.frameon": False, "savefig.dpi": 110, "figure.constrained_layout.use": True,
})  # fmt: skip
"""The style of the functions that draw figures, for the time of a call."""


def draw_curves(
    axes: Axes, ticks: np.ndarray, values: np.ndarray, style: tuple[str, str, bool], ends: np.ndarray | None = None
) -> None:
    """Draw every seed [K, G] as a thin line, their interquartile mean as a thick one with its 95 % interval, and a dot
    at that of the returns `ends` [K] of mean actions or options; `style` is colour, label, and whether dashed."""
    colour, label, dashed = style
    axes.plot(ticks, values.T, color=colour, linewidth=0.5, alpha=0.3)
    mean, line = iqm(values, axis=0), "--" if dashed else "-"
    axes.plot(ticks, mean, line, color=colour, linewidth=2.2, label=label, zorder=3)
    if len(values) > 1:
        low, high = stratified_interval([values])
        axes.fill_between(ticks, low, high, color=colour, alpha=0.18, linewidth=0, zorder=2)
    if ends is not None:
        axes.plot(ticks[-1], iqm(ends), "o", color=colour, markeredgecolor="white", markersize=7, zorder=4)


def interactions(axes: Axes, label: str) -> None:
    """Label the x-axis, from 0, with interactions in millions or thousands."""
    axes.set_xlim(left=0)
    unit, letter = (1e6, "M") if axes.get_xlim()[1] > 1e6 else (1e3, "k")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / unit:g} {letter}")
    axes.set_xlabel(label)


def add_legend(figure: Figure, panels: Iterable[Axes], ncols: int) -> None:
    """Add a legend of the curves of all panels below them."""
    lines = {str(line.get_label()): line for axes in panels for line in axes.get_lines()}
    lines = {label: line for label, line in lines.items() if label[0] != "_"}
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=ncols, title=LEGEND)


def mark(axes: Axes, title: str, remarks: Sequence[str], width: int = 52) -> None:
    """Write the title of a panel, and remarks on missing or mixed data below the title."""
    lines = [line for remark in remarks for line in textwrap.wrap(remark, width, subsequent_indent="   ")]
    axes.set_title(title, loc="left", pad=6 + 9.5 * len(lines))
    if lines:
        text = "\n".join(lines)
        axes.text(0.0, 1.01, text, transform=axes.transAxes, va="bottom", fontsize=7.5, color=WARNING)


def empty(axes: Axes) -> None:
    """Mark a panel without data."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.text(0.5, 0.5, "no finished runs", transform=axes.transAxes, ha="center", color=WARNING)


def save(figure: Figure, path: Path) -> None:
    """Write a picture; a PNG in 256 colours, which look the same and take a third of the space."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    if path.suffix == ".png":
        Image.open(path).convert("RGB").quantize(256).save(path, optimize=True)
    print(path)
