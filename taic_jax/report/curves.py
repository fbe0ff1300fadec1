"""Curves of a run: every metric of every stage over interactions, per seed and over seeds."""

from pathlib import Path
from typing import Any

import numpy as np

from taic_jax.analysis.statistics import bootstrap_interval, iqm
from taic_jax.config import COLLECT, METHOD_LABELS
from taic_jax.report.runs import LoadedRun, ReportError, per_seed, read_run

DIGITS = 5
"""Significant digits of what is drawn."""
LABELS = METHOD_LABELS | {"train": METHOD_LABELS["taic"], "learn": "learning of options"}


def label_of(run: LoadedRun, stage: str) -> str:
    """Return what a stage trains, in words."""
    if stage == COLLECT:
        return LABELS["flat"] if run.flat_stage() == COLLECT else "flat PPO (collector)"
    return LABELS.get(stage, stage)


def stage_curves(run: LoadedRun, stage: str, points: int) -> dict[str, Any]:
    """Return all curves of one stage, ready for JSON.

    Args:
      run: of which.
      stage: of which.
      points: at most so many iterations are kept, evenly spaced, the first and the last among them.
    """
    rows = run.of_stage(stage)
    kept = [rows[i] for i in thinned(len(rows), points)]
    unit = "ticks" if "ticks" in kept[0] else "steps"
    names = sorted({name for row in kept for name in row if name.startswith(f"{stage}/")})
    metrics = {name.partition("/")[2]: _over_seeds([per_seed(row, name) for row in kept], run) for name in names}
    ticks, missing = pretraining(run, stage)
    return {
        "stage": stage, "label": label_of(run, stage), "task": run.task_of(stage), "unit": unit,
        "iterations": len(rows), "x": [row[unit] for row in kept], "pretraining": ticks, "uncounted": missing,
        "metrics": {name: curve for name, curve in metrics.items() if curve is not None},
    }  # fmt: skip


def thinned(count: int, points: int) -> list[int]:
    """Return at most `points` of `count` indices, evenly spaced, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, points)).round().astype(int)).tolist()


def pretraining(run: LoadedRun, stage: str, above: tuple[str, ...] = ()) -> tuple[int, list[str]]:
    """Return the interactions per seed spent before a stage on what it builds on, and what could not be counted.

    Options build on the experience they were learnt from; baseline `transfer` on the source run's policy.

    Args:
      run: of which.
      stage: of which.
      above: names of the runs that led here, none of which is counted again.
    """
    source = str(run.fields.get("options.source") or "")
    if stage == "transfer":
        return _spent_in(source, COLLECT, above)
    if stage not in ("train", "learn"):
        return 0, []
    if source:
        return _spent_in(source, "train", above)
    total, missing = 0, []
    for name in run.fields.get("options.experience") or [COLLECT]:
        ticks, unknown = (run.ticks(COLLECT), []) if name == COLLECT else _spent_in(str(name), COLLECT, above)
        total, missing = total + ticks, missing + unknown
    return total, missing


def _spent_in(name: str, stage: str, above: tuple[str, ...]) -> tuple[int, list[str]]:
    """Return the ticks another run spent in stage collect, or before stage train; its name if that is not known."""
    path = Path(name)
    try:
        other = read_run(path if (path / "config.yaml").is_file() else path.parent)
    except ReportError:
        return 0, [name]
    if stage == "train" and name not in above:
        return pretraining(other, stage, (*above, name))
    return (other.ticks(COLLECT), []) if stage == COLLECT and other.of_stage(COLLECT) else (0, [name])


def _over_seeds(values: list[np.ndarray | None], run: LoadedRun) -> dict[str, Any] | None:
    """Return every seed's curve, the interquartile mean and its 95 % interval; None where nothing is a number.

    As in the summary, there are no statistics over the other seeds where one has no number.
    """
    width = max((len(value) for value in values if value is not None), default=0)
    if not width:
        return None
    table = np.array([np.full(width, np.nan) if value is None else value for value in values])
    if not np.isfinite(table).any():
        return None
    low, high = np.array([_interval(row) for row in table]).T
    curve = {"iqm": iqm(table), "low": low, "high": high}
    return {name: rounded(x) for name, x in curve.items()} | {"seeds": [rounded(seed) for seed in table.T]}


def _interval(values: np.ndarray) -> tuple[float, float]:
    if not np.isfinite(values).all():
        return float("nan"), float("nan")
    if len(values) > 1 and (values == values[0]).all():  # what does not vary, and there is much of it
        return float(values[0]), float(values[0])
    return bootstrap_interval(values)


def rounded(values: np.ndarray, digits: int = DIGITS) -> list[float | None]:
    """Return numbers to so many significant digits, for JSON; what is not finite becomes None."""
    return [float(f"{x:.{digits}g}") if np.isfinite(x) else None for x in values]
