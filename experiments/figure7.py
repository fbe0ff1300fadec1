"""Figure 7: learning curves of options and of flat PPO on the robots, and the numbers of claim C2.

python -m taic_jax.experiments.figure7
python -m taic_jax.experiments.figure7 --methods strong long fixed-closed-both-tuned \
    --out experiments/results/returns.png

Reads the table alone. A method with fewer seeds than it needs is marked on its panel, as is what is missing.
"""

import csv
import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from scipy import stats

from taic_jax.analysis.statistics import bootstrap_interval, holm, iqm, probability_of_improvement
from taic_jax.command_line import tell
from taic_jax.experiments.cells import METHODS, ROBOTS
from taic_jax.experiments.drawing import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LEGEND,
    OLIVE,
    ORANGE,
    PINK,
    PURPLE,
    RED,
    RESULTS,
    SKY,
    draw_curves,
    draw_end,
    empty,
    interactions,
    mark,
    plt,
    save,
    styled,
)  # fmt: skip
from taic_jax.experiments.table import DIGITS, TABLE, EvidenceRows, TableError, read_table, select

COLOURS = dict(zip(METHODS, (BLACK, OLIVE, GREY, PINK, SKY, ORANGE, BLUE, GREEN, RED, PURPLE), strict=True))
BASELINE = "strong"
FIELDS = (
    "task", "method", "seeds", "ticks", "pretraining", "iqm", "low", "high", "auc", "auc_low", "auc_high",
    "jump_start", "jump_starts_positive", "ticks_to_threshold", "reached", "improvement", "improvement_low",
    "improvement_high", "p_holm", "improvement_on_weak", "improvement_at_same_total", "mean", "improvement_of_means",
    "improvement_of_means_low", "improvement_of_means_high", "improvement_of_means_at_same_total",
    "improvement_of_means_at_same_total_low", "improvement_of_means_at_same_total_high", "remarks",
)  # fmt: skip
BOUNDS = ("", "_low", "_high")


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Draw figure 7 and write its numbers."""

    table: Path = TABLE
    """The table of finished runs."""
    out: Path = RESULTS / "figure7.png"
    """The picture; its numbers are written beside it as CSV."""
    tasks: tuple[str, ...] = ROBOTS
    """Panels."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Curves."""


def read_methods(
    rows: Sequence[dict[str, Any]], task: str, methods: dict[str, tuple[str, int]]
) -> tuple[dict[str, EvidenceRows], list[str]]:
    """Return those of the methods, each with label and fewest seeds, that the table holds for a task, and remarks."""
    found, remarks = {}, []
    held = {row["method"] for row in rows if row["task"] == task}
    for method, (label, minimum) in methods.items():
        if method in held:
            found[method] = select(rows, task, method, minimum)
            remarks += [f"{label}: {remark}" for remark in found[method].remarks]
    missing = [label for method, (label, _) in methods.items() if method not in held]
    if missing:
        remarks.append("missing: " + ", ".join(missing))
    return found, remarks


def with_interval(values: np.ndarray, names: Sequence[str] = ("iqm", "low", "high")) -> dict[str, float]:
    """Return the interquartile mean of one number per seed, and its 95 % interval."""
    return dict(zip(names, (float(iqm(values)), *bootstrap_interval(values)), strict=True))


def numbers(runs: EvidenceRows, methods: dict[str, EvidenceRows]) -> list[dict[str, Any]]:
    """Return what the table of the figure says of one method, in one row, beside flat PPO on the same task."""
    last, curve = runs.numbers["last"], runs.curves["return"]
    area = np.nanmean(curve, axis=1)
    row = {"task": runs.task, "method": runs.method, "seeds": len(last), "ticks": runs.ticks}
    row |= {"pretraining": runs.pretraining, "remarks": "; ".join(runs.remarks)}
    row |= with_interval(last) | with_interval(area, ("auc", "auc_low", "auc_high"))
    row["mean"] = float(iqm(runs.numbers["mean_option"]))
    if BASELINE not in methods:
        return [row]
    flat = methods[BASELINE]
    # Half of what flat PPO ends with, or of what it gains where that is more.
    threshold = iqm(flat.numbers["last"]) / 2
    above = curve >= threshold
    first = np.where(above.any(axis=1), runs.grid[above.argmax(axis=1)], np.inf)
    row |= {"ticks_to_threshold": float(np.median(first)), "reached": f"{above.any(axis=1).sum()}/{len(last)}"}
    if runs.method != BASELINE:
        shared = [(runs.seeds.index(s), flat.seeds.index(s)) for s in runs.seeds if s in flat.seeds]
        i, j = np.array(shared, int).reshape(-1, 2).T
        jump = runs.numbers["first"][i] - flat.numbers["first"][j]
        row |= {"jump_start": float(np.mean(jump)), "jump_starts_positive": f"{(jump > 0).sum()}/{len(jump)}"}
        p, interval = probability_of_improvement(last, flat.numbers["last"])
        row |= dict(zip(("improvement", "improvement_low", "improvement_high"), (p, *interval), strict=True))
        means = [each.numbers["mean_option"] for each in (runs, flat)]
        p, interval = probability_of_improvement(*means)
        row |= {f"improvement_of_means{k}": v for k, v in zip(BOUNDS, (p, *interval), strict=True)}
        row["p"] = float(stats.mannwhitneyu(last, flat.numbers["last"], alternative="greater").pvalue)
    if "weak" in methods and runs.method not in (BASELINE, "weak"):
        row["improvement_on_weak"] = probability_of_improvement(last, methods["weak"].numbers["last"])[0]
    long = methods.get("long")
    if long is not None and runs.pretraining and runs.pretraining + runs.ticks == long.ticks:
        row["improvement_at_same_total"] = probability_of_improvement(last, long.numbers["last"])[0]
        means = [each.numbers["mean_option"] for each in (runs, long)]
        p, interval = probability_of_improvement(*means)
        row |= {f"improvement_of_means_at_same_total{k}": v for k, v in zip(BOUNDS, (p, *interval), strict=True)}
    return [row]


def adjust(rows: list[dict[str, Any]]) -> None:
    """Adjust the p-values of each method over the tasks (Holm)."""
    for method in {row["method"] for row in rows}:
        tested = [row for row in rows if row["method"] == method and "p" in row]
        for row, p in zip(tested, holm([row.pop("p") for row in tested]), strict=True):
            row["p_holm"] = float(p)


@styled
def draw(found: dict[str, tuple[dict[str, EvidenceRows], list[str]]], out: Path) -> None:
    """Draw a column per task: over task ticks alone, and with the ticks that options were learnt from counted in."""
    figure, panels = plt.subplots(2, len(found), figsize=(4.1 * len(found) + 0.4, 7.6), squeeze=False)
    for column, (task, (methods, remarks)) in enumerate(found.items()):
        for row, axes in enumerate(panels[:, column]):
            for method, runs in methods.items():
                shift = runs.pretraining if row else 0
                flat = "-" not in method
                draw_curves(axes, runs.grid + shift, runs.curves["return"], COLOURS[method], METHODS[method][0], flat)
                draw_end(axes, runs.grid[-1] + shift, runs.numbers["mean_option"], COLOURS[method])
            if not methods:
                empty(axes)
                continue
            axes.set_xlim(left=0)
            interactions(axes, "interactions, pre-training counted in" if row else "interactions with the task")
        mark(panels[0, column], task, remarks)
    for axes in panels[:, 0]:
        axes.set_ylabel("return of an episode")
    lines = {line.get_label(): line for axes in panels[0] for line in axes.get_lines() if line.get_label()[0] != "_"}
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=len(found), title=LEGEND)
    save(figure, out)


def as_text(value: Any) -> Any:
    """Return floats with the digits that rows have, and leave the rest as it is."""
    if isinstance(value, np.ndarray):
        return " ".join(f"{x:.{DIGITS}g}" for x in value)
    return f"{value:.{DIGITS}g}" if isinstance(value, float) else value


def write_numbers(rows: list[dict[str, Any]], fields: Sequence[str], out: Path) -> None:
    """Write and print the numbers; an array is one per seed."""
    texts = [{name: as_text(value) for name, value in row.items()} for row in rows]
    with out.open("w", newline="") as file:
        writer = csv.DictWriter(file, fields)
        writer.writeheader()
        writer.writerows(texts)
    for row in texts:
        print("  ".join(f"{name} {row[name]}" for name in fields if row.get(name) not in (None, "")))


def make_figure(
    figure: str,
    arguments: Any,
    methods: dict[str, tuple[str, int]],
    draw: Callable[[dict[str, tuple[dict[str, EvidenceRows], list[str]]], Path], None],
    numbers: Callable[[EvidenceRows, dict[str, EvidenceRows]], list[dict[str, Any]]],
    fields: Sequence[str],
) -> None:
    """Draw a figure of several tasks and write its numbers.

    Args:
        figure: its number.
        arguments: `table`, `out` and `tasks`.
        methods: of each task, with label and fewest seeds.
        draw: the picture, from what `read_methods` gives for each task.
        numbers: rows of one method beside the others on its task.
        fields: of the table of numbers.
    """
    try:
        table = read_table(arguments.table)
        found = {task: read_methods(table, task, methods) for task in arguments.tasks}
        if not any(held for held, _ in found.values()):
            expected = f"{arguments.table}: no row of figure {figure}"
            raise TableError(f"{expected}; python -m taic_jax.experiments.evidence makes them")
    except TableError as error:
        print(f"figure{figure}: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    draw(found, arguments.out)
    rows = [row for held, _ in found.values() for runs in held.values() for row in numbers(runs, held)]
    adjust(rows)
    write_numbers(rows, fields, arguments.out.with_suffix(".csv"))


def main(args: Sequence[str] | None = None) -> None:
    """Draw figure 7 and write its numbers."""
    arguments = tyro.cli(Arguments, args=args)
    if unknown := set(arguments.methods) - set(METHODS):
        raise TableError(f"--methods: expected some of {', '.join(METHODS)}, got {min(unknown)}")
    make_figure("7", arguments, {name: METHODS[name] for name in arguments.methods}, draw, numbers, FIELDS)


if __name__ == "__main__":
    sys.exit(tell(main))
