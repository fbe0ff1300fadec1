"""Curves of a run: every metric of every stage over interactions, per seed and over seeds."""

from typing import Any

import numpy as np

from taic_jax.analysis.statistics import bootstrap_interval, iqm
from taic_jax.config import COLLECT, PRACTISE, TAIC, method_label
from taic_jax.report.runs import LoadedRun, ReportError, per_seed, read_run, run_of
from taic_jax.runtime.files import json_safe

DIGITS = 5  # significant, of curves
STAGES = {"train": TAIC, "learn": "learning of options", PRACTISE: "practice of options"}


def label_of(run: LoadedRun, stage: str) -> str:
    """Return the name of a stage's method in words."""
    learner = str(run.fields.get("collect.learner", "ppo"))
    if stage == COLLECT:
        return method_label("flat", learner) + ("" if run.flat_stage() == COLLECT else " (collector)")
    return method_label(STAGES.get(stage, stage), learner)


def stage_curves(run: LoadedRun, stage: str, points: int) -> dict[str, Any]:
    """Return all curves of one stage, ready for JSON, at the iterations that `thinned` chooses."""
    rows = run.of_stage(stage)
    drawn = [rows[i] for i in thinned(len(rows), points)]
    unit = "ticks" if "ticks" in drawn[0] else "steps"
    names = sorted({name for row in drawn for name in row if name.startswith(f"{stage}/")})
    curves = {name.partition("/")[2]: _over_seeds([per_seed(row, name) for row in drawn]) for name in names}
    ticks, uncounted = pretraining(run, stage)
    return {
        "stage": stage, "label": label_of(run, stage), "task": run.task_of(stage), "unit": unit,
        "iterations": len(rows), "x": [row[unit] for row in drawn], "pretraining": ticks, "uncounted": uncounted,
        "metrics": {name: curve for name, curve in curves.items() if curve is not None},
    }  # fmt: skip


def thinned(count: int, points: int) -> list[int]:
    """Return at most `points` of `count` indices, evenly spaced, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, points)).round().astype(int)).tolist()


def pretraining(run: LoadedRun, stage: str, above: tuple[str, ...] = ()) -> tuple[int, list[str]]:
    """Return the interactions per seed of the runs that a stage builds on but those `above`, and unreadable runs.

    Options build on the experience for learning them; baseline `transfer` on the source run's policy.
    """
    source = str(run.fields.get("options.source") or "")
    if stage == "transfer":
        return _spent_in(source, COLLECT, above)
    if stage not in ("train", "learn"):
        return 0, []
    practised = run.ticks(PRACTISE) if stage == "train" else 0
    if source:
        spent, unreadable = _spent_in(source, "train", above)
        return practised + spent, unreadable
    experience = [str(name) for name in run.fields.get("options.experience") or [COLLECT]]
    spent = [(run.ticks(name), []) if name == COLLECT else _spent_in(name, COLLECT, above) for name in experience]
    return practised + sum(ticks for ticks, _ in spent), [name for _, names in spent for name in names]


def _spent_in(name: str, stage: str, above: tuple[str, ...]) -> tuple[int, list[str]]:
    """Return the ticks of another run in stage collect, or before stage train, or 0 and its name if unreadable."""
    try:
        other = read_run(run_of(name).path)
    except ReportError:
        return 0, [name]
    if stage == "train" and name not in above:
        return pretraining(other, stage, (*above, name))
    return (other.ticks(COLLECT), []) if stage == COLLECT and other.of_stage(COLLECT) else (0, [name])


def _over_seeds(values: list[np.ndarray | None]) -> dict[str, Any] | None:
    """Return every seed's curve, and iqm and 95 % interval of iterations where all seeds have one; None without any."""
    width = max((len(value) for value in values if value is not None), default=0)
    table = np.array([np.full(width, np.nan) if value is None else value for value in values])
    if not np.isfinite(table).any():
        return None
    low, high = np.array([_interval(row) for row in table]).T
    return json_safe({"iqm": iqm(table), "low": low, "high": high, "seeds": table.T}, DIGITS)


def _interval(values: np.ndarray) -> tuple[float, float]:
    """Return the bootstrap interval, at once for equal values, as of many metrics."""
    if len(values) > 1 and (values == values[0]).all():
        return values[0], values[0]
    return bootstrap_interval(values)
