"""Figure 6: the likeness of options with like effects. HalfCheetah, without and with the constraints.

Needs scikit-learn (extra `viz`). As in the paper, a point is an option executed from one state; its place is t-SNE of
the state after the option, its colour t-SNE of the option. t-SNE depends on its perplexity, hence three of them; the
measures of the option spaces, over all option models, are beside it.
"""

import dataclasses
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Picture

from taic_jax.experiments.evidence.measures import PREFIX
from taic_jax.experiments.evidence.plan import METHODS, OTHERS, SPACES
from taic_jax.experiments.evidence.table import EvidenceRows, TableError, with_interval
from taic_jax.experiments.figures import drawing
from taic_jax.experiments.figures.drawing import Figure, Rows, read_methods

PERPLEXITIES = (10, 30, 90)
MODELS = 10
MEASURES = {
    "prior/one/distance_correlation": "distance correlation of\noption and state change",
    "window/mlp_r2/change": "R² of the state change\nfrom the code",
    "window/mlp_r2/start": "R² of the first state\nfrom the code",
}
CORNERS = np.array([[[0.90, 0.10, 0.20], [0.95, 0.75, 0.10]], [[0.20, 0.25, 0.80], [0.10, 0.75, 0.45]]])
"""Colours of the four corners of a square."""


@dataclasses.dataclass(frozen=True)
class Figure6(Figure):
    """Draw figure 6, and write its numbers."""

    number = "6"
    task: str = "half_cheetah"  # The robot.

    def draw(self, rows: Rows) -> tuple[Picture, Rows]:
        rows = [row for row in rows if row["task"] == self.task]
        methods = read_methods(rows, self.task, dict.fromkeys(METHODS | OTHERS, MODELS))
        lines = [line for runs in methods.values() for line in numbers(runs)]
        if not lines:
            raise self.no_row(f"python -m taic_jax.experiments.evidence --only {self.task}")
        examples = {row["method"]: row["example"] for row in rows if row["method"] in SPACES and row.get("example")}
        remarks = {name: methods[name].remarks if name in methods else ("missing",) for name in SPACES}
        return picture(examples, lines, remarks), lines


def as_colours(points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """Return a colour for each point, by its ranks along both axes: near points look alike, and all colours occur."""
    x, y = points.argsort(axis=0).argsort(axis=0).T[..., None] / max(len(points) - 1, 1)
    low, high = ((1 - y) * CORNERS[i, 0] + y * CORNERS[i, 1] for i in range(2))
    return (1 - x) * low + x * high


def embed(points: Any, perplexity: int) -> Float[np.ndarray, "N 2"]:
    """Return t-SNE of points [N, D] (van der Maaten & Hinton, 2008), begun at their principal components; raise
    `TableError` if scikit-learn is not installed."""
    try:
        from sklearn.manifold import TSNE
    except ImportError:
        raise TableError("t-SNE needs scikit-learn: pip install 'taic-jax[viz]'") from None
    return TSNE(perplexity=perplexity, init="pca", random_state=0).fit_transform(np.asarray(points, np.float32))


def numbers(runs: EvidenceRows) -> Rows:
    """Return a row per measure of one kind of options: its mean over option models, with a 95 % interval."""
    rows = []
    for name, values in runs.numbers.items():
        if name.startswith(PREFIX):
            row = {"task": runs.task, "method": runs.method, "models": len(values), "measure": name[len(PREFIX) :]}
            rows.append(row | with_interval(values) | {"remarks": "; ".join(runs.remarks)})
    return rows


def draw_measure(axes: Axes, name: str, rows: Rows) -> None:
    """Draw one measure of every kind of options, those with the constraints in blue."""
    lines = [row for row in rows if row["measure"] == name][::-1]
    for y, row in enumerate(lines):
        colour = drawing.GREY if row["method"].endswith("none") else drawing.BLUE
        axes.plot([row["low"], row["high"]], [y, y], color=colour, linewidth=2)
        axes.plot(row["iqm"], y, "o", color=colour)
    axes.set_yticks(range(len(lines)), [row["method"].replace("-", ", ") for row in lines], fontsize=7.5)
    axes.set_xlabel(MEASURES[name])


def picture(examples: dict[str, dict[str, Any]], rows: Rows, remarks: dict[str, tuple[str, ...]]) -> Picture:
    """Draw a column of t-SNE for each of the paper's panels, a row for each perplexity, and the measures beside."""
    widths = [1.0] * len(SPACES) + [1.2]
    figure, panels = plt.subplots(len(PERPLEXITIES), len(widths), figsize=(13.5, 9.6), width_ratios=widths)
    for line, perplexity in zip(panels, PERPLEXITIES, strict=True):
        for axes, (method, label) in zip(line[:-1], SPACES.items(), strict=True):
            axes.set_xticks([])
            axes.set_yticks([])
            if method in examples:
                colours = as_colours(embed(examples[method]["options"], perplexity))
                axes.scatter(*embed(examples[method]["ends"], perplexity).T, c=colours, s=12)
            if perplexity == PERPLEXITIES[0]:
                drawing.mark(axes, label, remarks[method], width=36)
        line[0].set_ylabel(f"perplexity {perplexity}")
    for axes, name in zip(panels[:, -1], MEASURES, strict=True):
        draw_measure(axes, name, rows)
    figure.suptitle("place: t-SNE of the state an option led to; colour: t-SNE of the option", x=0.01, ha="left")
    return figure
