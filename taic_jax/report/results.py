"""What each method reached: returns before and after training, durations, and what they cost."""

from typing import Any

import numpy as np

from taic_jax.analysis.statistics import summarize
from taic_jax.config import COLLECT
from taic_jax.report.curves import label_of, pretraining
from taic_jax.report.runs import UNTRAINED_STAGES, LoadedRun, per_seed

MODES = ("return", "return_mean_option")
"""Returns of the policy as it explores, and of its mean options."""


def methods_of(run: LoadedRun) -> list[dict[str, Any]]:
    """Return a row of the table per method, ready for JSON.

    A stage that is evaluated but in no summary (a collector on another task, a run that is not finished) is a row too,
    and so is one that has not come to its evaluation.
    """
    told = (run.summary or {}).get("methods", {})
    stages = {name: _stage_of(run, name) for name in told}
    rows = [_row(run, stage, _from_summary(told[name])) for name, stage in stages.items()]
    for stage in run.stages():
        if stage not in stages.values():
            rows.append(_row(run, stage, _from_evaluation(run, stage)))
    return rows


def _stage_of(run: LoadedRun, method: str) -> str:
    return "train" if method == "taic" else (run.flat_stage() or "flat") if method == "flat" else method


def _row(run: LoadedRun, stage: str, told: dict[str, Any]) -> dict[str, Any]:
    ticks, uncounted = pretraining(run, stage)
    return {
        "stage": stage, "label": label_of(run, stage), "task": run.task_of(stage), "evaluated": bool(told),
        "ticks": run.ticks(stage), "pretraining": ticks, "uncounted": uncounted, **told,
    }  # fmt: skip


def _from_summary(told: dict[str, Any]) -> dict[str, Any]:
    """Summarise the numbers per seed anew, in the one way that also serves a part of the seeds."""
    result = {}
    for mode in MODES:
        result[mode] = summarize(np.array(told[mode]["per_seed"], float))
        if "first_per_seed" in told[mode]:
            result[f"{mode}_untrained"] = summarize(np.array(told[mode]["first_per_seed"], float))
    if "duration" in told:
        result["duration"] = summarize(np.array(told["duration"]["per_seed"], float))
    return result


def _from_evaluation(run: LoadedRun, stage: str) -> dict[str, Any]:
    """Return what the rows of stage evaluate tell of a stage: no summary holds it."""
    result = {}
    for row in run.of_stage("evaluate"):
        for mode in MODES:
            values = per_seed(row, f"evaluate/{stage}/{mode}")
            if values is not None:
                result[mode] = summarize(values)
    return result


def histograms_of(run: LoadedRun) -> list[dict[str, Any]]:
    """Return for each method whose options may last longer than a tick the share of those that took 1..L ticks."""
    told = (run.summary or {}).get("methods", {})
    result = []
    for name, method in told.items():
        share = method.get("duration", {}).get("histogram", [])
        if len(share) > 1:
            stage = _stage_of(run, name)
            result.append({"label": label_of(run, stage), "share": share, "of": "evaluation after training"})
    if result:
        return result
    for stage in run.stages():
        counts = _last_counts(run, stage)
        if counts is not None:
            of = f"the iteration that ends at {run.ticks(stage):,} ticks of training"
            result.append({"label": label_of(run, stage), "share": (counts / counts.sum()).tolist(), "of": of})
    return result


def _last_counts(run: LoadedRun, stage: str) -> np.ndarray | None:
    """Return how many options took 1..L ticks in the newest iteration, over all seeds."""
    for row in reversed(run.of_stage(stage)):
        counts = row.get(f"{stage}/durations")
        if counts and isinstance(counts[0], list):
            total = np.nansum(np.array(counts, float), axis=0)
            return total if len(total) > 1 and total.sum() else None
    return None


def facts_of(run: LoadedRun) -> dict[str, Any]:
    """Return what was run, where and at what cost."""
    summary = run.summary or {}
    seconds = summary.get("seconds") or run.clock
    last = max((row["time"] for row in run.rows if "time" in row), default=None)
    return {
        "task": run.task, "tasks": sorted({run.task, *(run.task_of(stage) for stage in run.stages())}),
        "collects": run.task_of(COLLECT), "seeds": run.seeds, "seed": run.fields.get("seed"),
        "finished": run.summary is not None, "commit": summary.get("commit"), "versions": summary.get("versions") or {},
        "machine": summary.get("machine"), "ticks": summary.get("ticks") or run.clock.get("ticks"),
        "compile": seconds.get("compile"), "run": seconds.get("run"), "written": last,
        "iterations": sum(row["stage"] not in UNTRAINED_STAGES for row in run.rows),
    }  # fmt: skip
