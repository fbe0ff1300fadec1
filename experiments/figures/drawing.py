"""The frame of all figures: arguments, files, rows of each panel, colours, curves, and remarks on missing data."""

import dataclasses
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture
from matplotlib.ticker import MaxNLocator
from PIL import Image

from taic_jax.analysis.statistics import holm, iqm, stratified_interval
from taic_jax.experiments.evidence import table as evidence
from taic_jax.experiments.evidence.table import EvidenceRows

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

Rows = list[dict[str, Any]]  # Rows of the table of finished runs, or of the numbers of a figure.
Methods = dict[str, EvidenceRows]  # The rows of one task by method.
Style = tuple[str, str, bool]  # Colour and label of a method, and whether its line is dashed.


@dataclasses.dataclass(frozen=True)
class Figure:
    """A figure: its arguments and its picture."""

    number: ClassVar[str]
    fields: ClassVar[tuple[str, ...]] = ()

    table: Path = evidence.TABLE  # The table of finished runs.
    out: Path | None = None
    """The picture, by default experiments/results/figureN.png; its numbers are written beside it as CSV."""

    def draw(self, rows: Rows) -> tuple[Picture, Rows]:
        """Return the picture of the table's rows, and its numbers; raise `TableError` if rows are missing or mixed."""
        raise NotImplementedError

    @styled
    def make(self) -> None:
        """Draw the figure, write it, a PNG in 256 colours, which take a third of the space, and write its numbers."""
        picture, numbers = self.draw(evidence.read_table(self.table))
        out = self.out or evidence.RESULTS / f"figure{self.number}.png"
        out.parent.mkdir(parents=True, exist_ok=True)
        picture.savefig(out)
        if out.suffix == ".png":
            Image.open(out).convert("RGB").quantize(256).save(out, optimize=True)
        print(out)
        evidence.write_numbers(numbers, out.with_suffix(".csv"), self.fields)

    def no_row(self, remedy: str) -> evidence.TableError:
        """Return the error for a table without a row of this figure; `remedy` says which command makes them."""
        return evidence.TableError(f"{self.table}: no row of figure {self.number}; {remedy} makes them")


def read_methods(rows: Rows, task: str, minima: Mapping[str, int]) -> Methods:
    """Return those of the methods, each with its fewest seeds, that have rows of a task."""
    present = {row["method"] for row in rows if row["task"] == task}
    return {name: evidence.select(rows, task, name, seeds) for name, seeds in minima.items() if name in present}


def read_panels(figure: Figure, rows: Rows, minima: Mapping[str, Mapping[str, int]]) -> dict[str, Methods]:
    """Return the methods of each task, each with its fewest seeds; raise `TableError` if there are none."""
    panels = {task: read_methods(rows, task, methods) for task, methods in minima.items()}
    if not any(panels.values()):
        raise figure.no_row("python -m taic_jax.experiments.evidence")
    return panels


def numbers_of(panels: dict[str, Methods], numbers: Callable[[EvidenceRows, Methods], Rows]) -> Rows:
    """Return the rows of `numbers` for each method, beside the others on its task, p-values adjusted."""
    rows = [row for methods in panels.values() for runs in methods.values() for row in numbers(runs, methods)]
    adjust(rows)
    return rows


def adjust(rows: Rows) -> None:
    """Replace `p` by `p_holm`, adjusted over the tasks of each method (Holm)."""
    for method in {row["method"] for row in rows}:
        tested = [row for row in rows if row["method"] == method and "p" in row]
        for row, p in zip(tested, holm([row.pop("p") for row in tested]), strict=True):
            row["p_holm"] = float(p)


class Strip(NamedTuple):
    """A panel: its curve, the number whose interquartile mean is a dot at the end, the label of its axis, and whether
    the ticks of pre-training count."""

    curve: str = "return"
    end: str = "mean_option"
    label: str = "return of an episode"
    pretrained: bool = False


def draw_panels(
    panels: dict[str, Methods],
    strips: Sequence[Sequence[Strip]],
    styles: Sequence[Mapping[str, Style]],
    height: float,
    ncols: int,
) -> Picture:
    """Draw a column per task and a row per strip above a legend of `ncols` columns.

    `strips` and `styles` are those of each task, the latter by method. Remarks on missing or mixed rows stand below a
    task's name.
    """
    figure, grid = plt.subplots(len(strips[0]), len(panels), figsize=(4.1 * len(panels) + 0.4, height), squeeze=False)
    for column, (task, methods) in enumerate(panels.items()):
        own = styles[column]
        for axes, strip in zip(grid[:, column], strips[column], strict=True):
            draw_strip(axes, strip, methods, own)
            if not column or strip.label != strips[column - 1][0].label:
                axes.set_ylabel(strip.label)
        remarks = [f"{own[name][1]}: {remark}" for name, runs in methods.items() for remark in runs.remarks]
        missing = [label for name, (_, label, _) in own.items() if name not in methods]
        mark(grid[0, column], task, remarks + (["missing: " + ", ".join(missing)] if missing else []))
    curves = {x: y for axes in grid[0] for y, x in zip(*axes.get_legend_handles_labels(), strict=True)}
    figure.legend(curves.values(), curves.keys(), loc="outside lower center", ncols=ncols, title=LEGEND)
    return figure


def draw_strip(axes: Axes, strip: Strip, methods: Methods, styles: Mapping[str, Style]) -> None:
    """Draw the curves of one task, over interactions in millions or thousands."""
    curves = {name: runs for name, runs in methods.items() if strip.curve in runs.curves}
    for name, runs in curves.items():
        ticks = runs.grid + (runs.pretraining if strip.pretrained else 0)
        draw_curves(axes, ticks, runs.curves[strip.curve], styles[name], runs.numbers[strip.end])
    if curves:
        axes.set_xlim(left=0)
        unit, letter = (1e6, "M") if axes.get_xlim()[1] > 1e6 else (1e3, "k")
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.xaxis.set_major_formatter(lambda value, _: f"{value / unit:g} {letter}")
        axes.set_xlabel("interactions, pre-training counted in" if strip.pretrained else "interactions with the task")
    elif methods:
        axes.set_axis_off()
    else:
        axes.set_xticks([])
        axes.set_yticks([])
        axes.text(0.5, 0.5, "no finished runs", transform=axes.transAxes, ha="center", color=WARNING)


def draw_curves(axes: Axes, ticks: np.ndarray, values: np.ndarray, style: Style, ends: np.ndarray) -> None:
    """Draw every seed [K, G] as a thin line, their interquartile mean as a thick one with its 95 % interval, and a dot
    at that of the numbers `ends` [K]."""
    colour, label, dashed = style
    axes.plot(ticks, values.T, color=colour, linewidth=0.5, alpha=0.3)
    mean, line = iqm(values, axis=0), "--" if dashed else "-"
    axes.plot(ticks, mean, line, color=colour, linewidth=2.2, label=label, zorder=3)
    if len(values) > 1:
        low, high = stratified_interval([values])
        axes.fill_between(ticks, low, high, color=colour, alpha=0.18, linewidth=0, zorder=2)
    axes.plot(ticks[-1], iqm(ends), "o", color=colour, markeredgecolor="white", markersize=7, zorder=4)


def mark(axes: Axes, title: str, remarks: Sequence[str], width: int = 52) -> None:
    """Write the title of a panel, and remarks on missing or mixed data below the title."""
    lines = [line for remark in remarks for line in textwrap.wrap(remark, width, subsequent_indent="   ")]
    axes.set_title(title, loc="left", pad=6 + 9.5 * len(lines))
    if lines:
        text = "\n".join(lines)
        axes.text(0.0, 1.01, text, transform=axes.transAxes, va="bottom", fontsize=7.5, color=WARNING)
