"""Figure 8: options of Ant, as they are or fine-tuned, on its harder tasks, and the numbers of claim C3.

python -m taic_jax.experiments.figure8

Reads the table alone. Success is to be within 5 m of the goal at the last tick of an episode (HIRO's definition); a
seed's success is its share of evaluation episodes under its mean options.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy import stats

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
from taic_jax.experiments.figure7 import make_figure, with_interval
from taic_jax.experiments.table import TABLE, Runs
from taic_jax.statistics import probability_of_improvement

SEEDS = 10
COLOURS = {"open": ORANGE, "closed": RED, "tuned": PURPLE, "flat": BLACK, "transfer": BLUE}
BASELINES = ("flat", "transfer")
# Of the evaluation: name in the row, name in the table of numbers.
MEASURES = {"final/success": "success", "final/closest_approach": "closest_approach", "mean/upside_down": "upside_down"}
FIELDS = (
    "task", "method", "seeds", "ticks", "iqm", "low", "high", *MEASURES.values(), "seeds_at_goal", "success_per_seed",
    "improvement", "improvement_low", "improvement_high", "p_holm", "remarks",
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


def numbers(runs: Runs, methods: dict[str, Runs]) -> dict[str, Any]:
    """Return what the table of the figure says of one method; for options the worse of both comparisons."""
    last = runs.numbers["last"]
    row: dict[str, Any] = {"task": runs.task, "method": runs.method, "seeds": len(last), "ticks": runs.ticks}
    row |= with_interval(last)
    row |= {ours: float(np.mean(runs.numbers[name])) for name, ours in MEASURES.items() if name in runs.numbers}
    if "final/success" in runs.numbers:
        success = runs.numbers["final/success"]
        row |= {"seeds_at_goal": f"{(success >= 0.5).sum()}/{len(success)}"}
        row |= {"success_per_seed": " ".join(f"{x:.2g}" for x in success)}
    others = [methods[name] for name in BASELINES if name in methods]
    if runs.method not in BASELINES and others:
        compared = [(*probability_of_improvement(last, x.numbers["last"]), x) for x in others]
        p, interval, worse = min(compared, key=lambda c: c[0])
        row |= dict(zip(("improvement", "improvement_low", "improvement_high"), (p, *interval), strict=True))
        row["p"] = float(stats.mannwhitneyu(last, worse.numbers["last"], alternative="greater").pvalue)
    return row | {"remarks": "; ".join(runs.remarks)}


@styled
def draw(found: dict[str, tuple[dict[str, Runs], list[str]]], out: Path) -> None:
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
                    draw_end(axes, runs.grid[-1], runs.numbers["last"], COLOURS[method])
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
    main()
