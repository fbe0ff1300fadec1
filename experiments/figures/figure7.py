"""Figure 7: learning curves of options and of flat PPO on the robots, and the numbers of claim C2.

A panel names the methods with fewer seeds than planned, and the missing ones.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure as Picture
from scipy import stats

from taic_jax.analysis.statistics import iqm, probability_of_improvement
from taic_jax.experiments.evidence.plan import BASELINE, FLAT, METHODS, ROBOTS
from taic_jax.experiments.evidence.table import BOUNDS, EvidenceRows, TableError, with_improvement, with_interval
from taic_jax.experiments.figures import drawing
from taic_jax.experiments.figures.drawing import Figure, Methods, Rows, Strip, draw_panels, numbers_of, read_panels

COLOURS = dict(zip(METHODS, drawing.COLOURS, strict=True))


@dataclasses.dataclass(frozen=True)
class Figure7(Figure):
    """Draw figure 7, and write its numbers."""

    number = "7"
    fields = (
        "task", "method", "seeds", "ticks", "pretraining", "iqm", "low", "high", "auc", "auc_low", "auc_high",
        "jump_start", "jump_starts_positive", "ticks_to_threshold", "reached", "improvement", "improvement_low",
        "improvement_high", "p_holm", "improvement_on_weak", "improvement_at_same_total", "mean",
        *(f"improvement_of_means{name}{bound}" for name in ("", "_at_same_total") for bound in BOUNDS), "remarks",
    )  # fmt: skip

    tasks: tuple[str, ...] = ROBOTS  # Panels.
    methods: tuple[str, ...] = tuple(METHODS)  # Curves.

    def draw(self, rows: Rows) -> tuple[Picture, Rows]:
        if unknown := set(self.methods) - set(METHODS):
            raise TableError(f"--methods: expected some of {', '.join(METHODS)}, got {min(unknown)}")
        minima = {name: METHODS[name][1] for name in self.methods}
        panels = read_panels(self, rows, dict.fromkeys(self.tasks, minima))
        return picture(panels, self.methods), numbers_of(panels, numbers)


def numbers(runs: EvidenceRows, methods: Methods) -> Rows:
    """Return the numbers of one method, in one row, beside flat PPO on the same task."""
    last, means, curve = runs.numbers["last"], runs.numbers["mean_option"], runs.curves["return"]
    area = np.nanmean(curve, axis=1)
    row = {"task": runs.task, "method": runs.method, "seeds": len(last), "ticks": runs.ticks}
    row |= {"pretraining": runs.pretraining, "remarks": "; ".join(runs.remarks)}
    row |= with_interval(last) | with_interval(area, ("auc", "auc_low", "auc_high"))
    row["mean"] = float(iqm(means))
    if BASELINE not in methods:
        return [row]
    flat = methods[BASELINE]
    above = curve >= iqm(flat.numbers["last"]) / 2  # the threshold
    first = np.where(above.any(axis=1), runs.grid[above.argmax(axis=1)], np.inf)
    row |= {"ticks_to_threshold": float(np.median(first)), "reached": f"{above.any(axis=1).sum()}/{len(last)}"}
    if runs.method != BASELINE:
        shared = [(runs.seeds.index(s), flat.seeds.index(s)) for s in runs.seeds if s in flat.seeds]
        i, j = np.array(shared, int).reshape(-1, 2).T
        jump = runs.numbers["first"][i] - flat.numbers["first"][j]
        row |= {"jump_start": float(np.mean(jump)), "jump_starts_positive": f"{(jump > 0).sum()}/{len(jump)}"}
        row |= with_improvement("improvement", last, flat.numbers["last"])
        row |= with_improvement("improvement_of_means", means, flat.numbers["mean_option"])
        row["p"] = float(stats.mannwhitneyu(means, flat.numbers["mean_option"], alternative="greater").pvalue)
    if "weak" in methods and runs.method not in (BASELINE, "weak"):
        row["improvement_on_weak"] = probability_of_improvement(last, methods["weak"].numbers["last"])[0]
    long = methods.get("long")
    if long is not None and runs.pretraining and runs.pretraining + runs.ticks == long.ticks:
        row["improvement_at_same_total"] = probability_of_improvement(last, long.numbers["last"])[0]
        row |= with_improvement("improvement_of_means_at_same_total", means, long.numbers["mean_option"])
    return [row]


def picture(panels: dict[str, Methods], methods: Sequence[str]) -> Picture:
    """Draw a column per task: over the task's ticks alone, and over these and the ticks of pre-training."""
    styles = {name: (COLOURS[name], METHODS[name][0], name in FLAT) for name in methods}
    strips = (Strip(), Strip(pretrained=True))
    return draw_panels(panels, [strips] * len(panels), [styles] * len(panels), 7.6, len(panels))
