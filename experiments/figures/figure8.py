"""Figure 8: options of Ant on its harder tasks, and the numbers of claim C3.

A row of numbers is of one measure of one method. Success is a place within 5 m of the goal at the last tick of an
episode (HIRO's definition); a seed's success is its share of evaluation episodes under its mean options.
`training/success` is a share of ticks. An improvement is the probability that a seed is better than one of a baseline,
or of options in open loop.
"""

import dataclasses
from typing import Any

import numpy as np
from matplotlib.figure import Figure as Picture
from scipy import stats

from taic_jax.experiments.evidence.plan import ARENAS, CARRIED, TRANSFERRED, TURN
from taic_jax.experiments.evidence.table import BOUNDS, EvidenceRows, with_improvement, with_interval
from taic_jax.experiments.figures import drawing
from taic_jax.experiments.figures.drawing import Figure, Methods, Rows, Strip, draw_panels, numbers_of, read_panels

SEEDS = 10
COLOURS = {"open": drawing.ORANGE, "closed": drawing.RED, "tuned": drawing.PURPLE, "flat": drawing.BLACK,
           "transfer": drawing.BLUE, "steering": drawing.GREEN, "total": drawing.BLACK,
           "walker": drawing.BLUE}  # fmt: skip
METHODS = {TURN: TRANSFERRED} | dict.fromkeys(ARENAS, CARRIED)
BASELINES = ("flat", "transfer", "total", "walker")
MEASURES = ("first", "last", "mean_option", "final/success", "final/closest_approach", "final/upside_down")
LATE = 5  # Last points of a curve whose mean is a measure of training.
CURVES = {"return": "training/return", "mean/success": "training/success"}
LOWER = ("final/closest_approach", "final/upside_down")  # Measures whose lower values are better.
COMPARED = (*BASELINES, "open")


@dataclasses.dataclass(frozen=True)
class Figure8(Figure):
    """Draw figure 8, and write its numbers."""

    number = "8"
    fields = (
        "task", "method", "measure", "seeds", "ticks", "iqm", "low", "high", "mean",
        *(f"improvement_on_{name}{bound}" for name in COMPARED for bound in BOUNDS),
        "p_holm", "seeds_at_goal", "per_seed", "remarks",
    )  # fmt: skip

    tasks: tuple[str, ...] = (TURN, *ARENAS)  # Panels.

    def draw(self, rows: Rows) -> tuple[Picture, Rows]:
        panels = read_panels(self, rows, {task: dict.fromkeys(METHODS[task], SEEDS) for task in self.tasks})
        return picture(panels), numbers_of(panels, numbers)


def measured(runs: EvidenceRows) -> dict[str, np.ndarray]:
    """Return the measures [K] of one method: those of evaluation, and the end of each curve of training."""
    ends = {ours: runs.curves[name][:, -LATE:] for name, ours in CURVES.items() if name in runs.curves}
    late = {name: np.nanmean(end, axis=1) for name, end in ends.items()}
    return {name: runs.numbers[name] for name in MEASURES if name in runs.numbers} | late


def at_goal(runs: EvidenceRows, measure: str) -> dict[str, str]:
    """Return the number of seeds at the goal: in half of the evaluation, or at any time in training."""
    if measure == "final/success":
        there = runs.numbers[measure] >= 0.5
    elif measure == "training/success":
        there = (np.nan_to_num(runs.curves["mean/success"]) > 0).any(axis=1)
    else:
        return {}
    return {"seeds_at_goal": f"{there.sum()}/{there.size}"}


def numbers(runs: EvidenceRows, methods: Methods) -> Rows:
    """Return the numbers of one method, a row per measure; p is of the worse comparison."""
    rows, others = [], {name: measured(methods[name]) for name in COMPARED if name in methods}
    for measure, values in measured(runs).items():
        row: dict[str, Any] = {"task": runs.task, "method": runs.method, "measure": measure, "seeds": len(values)}
        row |= {"ticks": runs.ticks, **with_interval(values), "mean": float(np.mean(values)), **at_goal(runs, measure)}
        row |= {"per_seed": values, "remarks": "; ".join(runs.remarks)}
        sign = -1 if measure in LOWER else 1
        for name, other in others.items():
            if name != runs.method:
                row |= with_improvement(f"improvement_on_{name}", sign * values, sign * other[measure])
        baselines = [others[name][measure] for name in BASELINES if name in others]
        if measure == "mean_option" and runs.method not in BASELINES and baselines:
            row["p"] = max(stats.mannwhitneyu(values, x, alternative="greater").pvalue for x in baselines)
        rows.append(row)
    return rows


def picture(panels: dict[str, Methods]) -> Picture:
    """Draw a column per task: the share at the goal, or the return where there is none.

    Returns of training in an arena say little: an episode that is cut, since the ant lies on its back, adds up less.
    """
    there = "share at the goal"
    strips = [(Strip("mean/success", "final/success", there) if task in ARENAS else Strip(),) for task in panels]
    styles = [
        {name: (COLOURS[name], label, name in BASELINES) for name, (label, _) in METHODS[task].items()}
        for task in panels
    ]
    return draw_panels(panels, strips, styles, 4.4, min(3, 2 * len(panels) - 1))
