"""Results of each method: returns before and after training, durations, and cost."""

from typing import Any

import numpy as np

from taic_jax.analysis.statistics import summarize
from taic_jax.report.curves import label_of, pretraining
from taic_jax.report.runs import LoadedRun, per_seed

MODES = ("return", "return_mean_option")  # of the policy as it explores, and of its mean options


def methods_of(run: LoadedRun) -> list[dict[str, Any]]:
    """Return a row of the table per method, ready for JSON, and per stage that trained but is in no summary."""
    results = {_stage_of(run, name): _from_summary(method) for name, method in run.methods.items()}
    for stage in run.trained_stages():
        if stage not in results:
            returns = {mode: f"evaluate/{stage}/{mode}" for mode in MODES}
            values = ((mode, per_seed(row, name)) for row in run.of_stage("evaluate") for mode, name in returns.items())
            results[stage] = {mode: summarize(x) for mode, x in values if x is not None}
    rows = []
    for stage, statistics in results.items():
        ticks, uncounted = pretraining(run, stage)
        rows.append({
            "stage": stage, "label": label_of(run, stage), "task": run.task_of(stage), "evaluated": bool(statistics),
            "ticks": run.ticks(stage), "pretraining": ticks, "uncounted": uncounted, **statistics,
        })  # fmt: skip
    return rows


def _stage_of(run: LoadedRun, method: str) -> str:
    return "train" if method == "taic" else (run.flat_stage() or "flat") if method == "flat" else method


def _from_summary(method: dict[str, Any]) -> dict[str, Any]:
    """Summarise the numbers per seed anew, which also serves a part of the seeds."""
    result = {mode: summarize(method[mode]["per_seed"]) for mode in (*MODES, "duration") if mode in method}
    if "first_per_seed" in method["return"]:
        result["return_untrained"] = summarize(method["return"]["first_per_seed"])
    return result


def histograms_of(run: LoadedRun) -> list[dict[str, Any]]:
    """Return the shares of options of 1..L ticks for each method whose options may last longer than a tick."""
    shares = {_stage_of(run, name): x.get("duration", {}).get("histogram", []) for name, x in run.methods.items()}
    result = [(stage, share, "evaluation after training") for stage, share in shares.items() if len(share) > 1]
    if not result:
        for stage in run.trained_stages():
            rows = (row.get(f"{stage}/durations") for row in reversed(run.of_stage(stage)))
            last = next((x for x in rows if x and isinstance(x[0], list)), [[]])
            counts = np.nansum(np.array(last, float), axis=0)  # over all seeds
            of = f"the iteration that ends at {run.ticks(stage):,} ticks of training"
            if len(counts) > 1 and counts.sum():
                result.append((stage, (counts / counts.sum()).tolist(), of))
    return [{"label": label_of(run, stage), "share": share, "of": of} for stage, share, of in result]


def facts_of(run: LoadedRun) -> dict[str, Any]:
    """Return the task, the versions, the machine and the cost of a run."""
    summary = run.summary or {}
    seconds = summary.get("seconds") or run.clock
    return {
        "task": run.task, "tasks": sorted({run.task, *(run.task_of(stage) for stage in run.trained_stages())}),
        "seeds": run.seeds, "finished": run.summary is not None, "commit": summary.get("commit"),
        "versions": summary.get("versions") or {}, "machine": summary.get("machine"),
        "ticks": summary.get("ticks") or run.clock.get("ticks"), "compile": seconds.get("compile"),
        "run": seconds.get("run"), "written": max((row["time"] for row in run.rows if "time" in row), default=None),
    }  # fmt: skip
