"""What all figures share: colours, curves of many seeds, and marks for what is missing."""

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

# Okabe and Ito's palette, which readers who confuse colours can tell apart, with an olive and a purple.
COLOURS = BLACK, OLIVE, GREY, PINK, SKY, ORANGE, BLUE, GREEN, RED, PURPLE = (
    "#000000", "#a89b00", "#8c8c8c", "#cc79a7", "#56b4e9", "#e69f00", "#0072b2", "#009e73", "#d55e00", "#6a1b9a",
)  # fmt: skip
WARNING = "#b00020"
LEGEND = "curves: while training, with its noise; dots: after training, mean actions or mean options, without noise"
"""Title of the legend where `draw_curves` and `draw_end` draw."""

styled = plt.rc_context({
    "font.size": 10, "axes.titlesize": 11, "axes.spines.top": False, "axes.spines.right": False,
    "legend.frameon": False, "savefig.dpi": 110, "figure.constrained_layout.use": True,
})  # fmt: skip
"""Of every function that draws a figure: its style, which to import it gives to no other's."""


def draw_curves(
    axes: Axes, ticks: np.ndarray, values: np.ndarray, colour: str, label: str, dashed: bool = False
) -> None:
    """Draw every seed [K, G] as a thin line, their interquartile mean as a thick one, and its 95 % interval."""
    axes.plot(ticks, values.T, color=colour, linewidth=0.5, alpha=0.3)
    style = "--" if dashed else "-"
    axes.plot(ticks, iqm(values, axis=0), style, color=colour, linewidth=2.2, label=label, zorder=3)
    if len(values) > 1:
        low, high = stratified_interval([values])
        axes.fill_between(ticks, low, high, color=colour, alpha=0.18, linewidth=0, zorder=2)


def draw_end(axes: Axes, tick: int | np.integer, values: np.ndarray, colour: str) -> None:
    """Draw a dot at the interquartile mean of what the mean actions or mean options of each seed [K] return."""
    axes.plot(tick, iqm(values), "o", color=colour, markeredgecolor="white", markersize=7, zorder=4)


def interactions(axes: Axes, label: str) -> None:
    """Write interactions in millions or thousands on the x-axis."""
    top = axes.get_xlim()[1]
    unit, letter = (1e6, "M") if top > 1e6 else (1e3, "k")
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / unit:g} {letter}")
    axes.set_xlabel(label)


def add_legend(figure: Figure, panels: Iterable[Axes], ncols: int) -> None:
    """Explain below all panels the curves that stand in some of them."""
    lines = {str(line.get_label()): line for axes in panels for line in axes.get_lines()}
    lines = {label: line for label, line in lines.items() if label[0] != "_"}
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=ncols, title=LEGEND)


def mark(axes: Axes, title: str, remarks: Sequence[str], width: int = 52) -> None:
    """Title a panel, and write above it what is missing or mixed in it."""
    axes.set_title(title, loc="left")
    lines = [line for remark in remarks for line in textwrap.wrap(remark, width, subsequent_indent="   ")]
    if lines:
        text = "\n".join(lines)
        axes.text(0.0, 1.01, text, transform=axes.transAxes, va="bottom", fontsize=7.5, color=WARNING)
        axes.set_title(title, loc="left", pad=6 + 9.5 * len(lines))


def empty(axes: Axes) -> None:
    """Say that a panel has nothing to show."""
    axes.set_xticks([])
    axes.set_yticks([])
    axes.text(0.5, 0.5, "no finished runs", transform=axes.transAxes, ha="center", color=WARNING)


def save(figure: Figure, path: Path) -> None:
    """Write a picture, a PNG in 256 colours: hundreds of thin lines take a third of the space so, and look the same."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    if path.suffix == ".png":
        Image.open(path).convert("RGB").quantize(256).save(path, optimize=True)
    print(path)
