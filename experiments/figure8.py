"""Figure 8: options of Ant, as they are or fine-tuned, on its harder tasks, and the numbers of claim C3.

python -m taic_jax.experiments.figure8

Reads the table alone, and writes a line of numbers for every measure of every method. Success is to be within 5 m of
the goal at the last tick of an episode (HIRO's definition); a seed's success is its share of evaluation episodes under
its mean options. `training/success` is a share of ticks. An improvement is the probability that a seed does better than
one of a baseline, or of options in open loop.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy import stats

from taic_jax.analysis.statistics import probability_of_improvement
from taic_jax.command_line import tell
from taic_jax.experiments.cells import TRANSFERRED, TRANSFERS
from taic_jax.experiments.drawing import (
    BLACK,
    BLUE,
    LEGEND,
    ORANGE,
    PURPLE,
    RED,
    RESULTS,
    draw_curves,
    draw_end,
    empty,
    interactions,
    mark,
    plt,
    save,
    styled,
)
from taic_jax.experiments.figure7 import BOUNDS, make_figure, with_interval
from taic_jax.experiments.table import TABLE, EvidenceRows

SEEDS = 10
COLOURS = {"open": ORANGE, "closed": RED, "tuned": PURPLE, "flat": BLACK, "transfer": BLUE}
BASELINES = ("flat", "transfer")
MEASURES = ("first", "last", "mean_option", "final/success", "final/closest_approach", "final/upside_down")
LATE = 5
"""Points of a curve, the last ones, whose mean is a measure of training."""
CURVES = {"return": "training/return", "mean/success": "training/success"}
LOWER = ("final/closest_approach", "final/upside_down")
"""Measures of which less is better."""
COMPARED = (*BASELINES, "open")

FIELDS = (
    "task", "method", "measure", "seeds", "ticks", "iqm", "low", "high", "mean",
    *(f"improvement_on_{name}{bound}" for name in COMPARED for bound in BOUNDS),
    "p_holm", "seeds_at_goal", "per_seed", "remarks",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Draw figure 8 and write its numbers."""

    table: Path = TABLE
    """The table of finished runs."""
    out: Path = RESULTS / "figure8.png"
    """The picture; its numbers are written beside it as CSV."""
    tasks: tuple[str, ...] = TRANSFERS
    """Panels."""


def measured(runs: EvidenceRows) -> dict[str, np.ndarray]:
    """Return the measures [K] of one method: those of evaluation, and the end of each curve of training."""
    ends = {ours: runs.curves[name][:, -LATE:] for name, ours in CURVES.items() if name in runs.curves}
    late = {name: np.nanmean(end, axis=1) for name, end in ends.items()}
    return {name: runs.numbers[name] for name in MEASURES if name in runs.numbers} | late


def at_goal(runs: EvidenceRows, measure: str) -> dict[str, str]:
    """Return how many seeds are at the goal: in half of the evaluation, or at any time in training."""
    if measure == "final/success":
        there = runs.numbers[measure] >= 0.5
    elif measure == "training/success":
        there = (np.nan_to_num(runs.curves["mean/success"]) > 0).any(axis=1)
    else:
        return {}
    return {"seeds_at_goal": f"{there.sum()}/{len(there)}"}


def numbers(runs: EvidenceRows, methods: dict[str, EvidenceRows]) -> list[dict[str, Any]]:
    """Return what the table of the figure says of one method, a row per measure; p is of the worse comparison."""
    rows, others = [], {name: measured(methods[name]) for name in COMPARED if name in methods}
    for measure, values in measured(runs).items():
        row: dict[str, Any] = {"task": runs.task, "method": runs.method, "measure": measure, "seeds": len(values)}
        row |= {"ticks": runs.ticks, **with_interval(values), "mean": float(np.mean(values)), **at_goal(runs, measure)}
        row |= {"per_seed": values, "remarks": "; ".join(runs.remarks)}
        sign = -1 if measure in LOWER else 1
        for name, other in others.items():
            if name != runs.method:
                p, interval = probability_of_improvement(sign * values, sign * other[measure])
                row |= {f"improvement_on_{name}{k}": v for k, v in zip(BOUNDS, (p, *interval), strict=True)}
        baselines = [others[name][measure] for name in BASELINES if name in others]
        if measure == "last" and runs.method not in BASELINES and baselines:
            row["p"] = max(stats.mannwhitneyu(values, x, alternative="greater").pvalue for x in baselines)
        rows.append(row)
    return rows


@styled
def draw(found: dict[str, tuple[dict[str, EvidenceRows], list[str]]], out: Path) -> None:
    """Draw a column per task: the return, and where there is a goal the share of ticks spent at it."""
    goals = any("mean/success" in runs.curves for methods, _ in found.values() for runs in methods.values())
    names = ("return", "mean/success")[: 1 + goals]
    size = 4.1 * len(found) + 0.4, 3.0 * len(names) + 1.0
    figure, panels = plt.subplots(len(names), len(found), figsize=size, squeeze=False)
    for column, (task, (methods, remarks)) in enumerate(found.items()):
        for axes, name in zip(panels[:, column], names, strict=True):
            held = {method: runs for method, runs in methods.items() if name in runs.curves}
            for method, runs in held.items():
                draw_curves(
                    axes, runs.grid, runs.curves[name], COLOURS[method], TRANSFERRED[method][0], method in BASELINES
                )
                if name == "return":
                    draw_end(axes, runs.grid[-1], runs.numbers["mean_option"], COLOURS[method])
            if held:
                axes.set_xlim(left=0)
                interactions(axes, "interactions with the task")
            elif methods:
                axes.set_axis_off()
            else:
                empty(axes)
        mark(panels[0, column], task, remarks)
    panels[0, 0].set_ylabel("return of an episode")
    if goals:
        panels[1, 1 % len(found)].set_ylabel("share of ticks within 5 m of the goal")
    lines = {line.get_label(): line for line in panels[0, 0].get_lines() if str(line.get_label())[0] != "_"}
    figure.legend(
        lines.values(), lines.keys(), loc="outside lower center", ncols=min(3, 2 * len(found) - 1), title=LEGEND
    )
    save(figure, out)


def main(args: Sequence[str] | None = None) -> None:
    """Draw figure 8 and write its numbers."""
    methods = {name: (label, SEEDS) for name, (label, _) in TRANSFERRED.items()}
    make_figure("8", tyro.cli(Arguments, args=args), methods, draw, numbers, FIELDS)


if __name__ == "__main__":
    sys.exit(tell(main))
