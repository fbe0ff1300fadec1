"""A sweep's folder: its table, and each of its points as the run it would be alone."""

import csv
import dataclasses
import io
import json
from pathlib import Path
from typing import Any

from taic_jax.config import Config
from taic_jax.report.runs import LoadedRun, ReportError, read_run
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.sweep.axes import configs_of, show
from taic_jax.sweep.runs import PLAN, TABLE, Plan

PER_SEED = ("per_seed", "first_per_seed")


def read_sweep(folder: Path, name: str) -> tuple[dict[str, Any], list[LoadedRun]]:
    """Return a sweep's table and notes, ready for JSON, and its points as runs, or raise ReportError or ConfigError."""
    try:
        plan = Plan(**json.loads((folder / PLAN).read_text()))
    except (OSError, ValueError, TypeError):
        raise ReportError(f"{folder / PLAN}: expected the plan of a sweep, got another file") from None
    config, runs, missing = RunFolder(folder).config(), [], []
    for number, indices in enumerate(plan.chunks):
        try:
            chunk = read_run(folder / f"chunk-{number:03d}")
        except ReportError:
            missing += indices
            continue
        runs += [_point(chunk, config, plan.points[i], place, f"{name} #{i}") for place, i in enumerate(indices)]
    if not runs:
        raise ReportError(f"{folder}: expected at least one finished iteration of a sweep, got none in its chunks")
    text = (folder / TABLE).read_text() if (folder / TABLE).is_file() else ""
    table, count = list(csv.DictReader(io.StringIO(text))), plan.optuna or len(plan.points)
    notes = [f"points not begun: {', '.join(map(str, missing))}"] if missing else []
    if len(table) < len(plan.points):
        notes.append(f"{len(table)} of {count} points are finished")
    axes = [axis.partition("=")[0] for axis in plan.axes]
    return {"name": name, "axes": axes, "points": count, "table": table, "notes": notes}, runs


def _point(chunk: LoadedRun, config: Config, values: dict[str, Any], place: int, name: str) -> LoadedRun:
    """Return one point of a chunk: K of its G K seeds."""
    seeds = slice(place * config.seeds, (place + 1) * config.seeds)
    summary = chunk.summary and {
        **{key: chunk.summary[key] for key in ("versions", "commit", "machine") if key in chunk.summary},
        "methods": _of_seeds(chunk.methods, seeds),
    }
    rows = [{name: x[seeds] if isinstance(x, list) else x for name, x in row.items()} for row in chunk.rows]
    (own,) = configs_of(config, [values])
    return dataclasses.replace(
        chunk, name=f"{name}: {show(values)}", rows=rows, summary=summary, clock={}, point=True, config=own,
        fields=chunk.fields | values, notes=tuple(note for note in chunk.notes if not note.startswith("seed ")),
    )  # fmt: skip


def _of_seeds(tree: dict[str, Any], seeds: slice) -> dict[str, Any]:
    """Return the parts per seed, of these seeds; statistics over all seeds of a chunk mix its points."""
    return {
        name: value[seeds] if name in PER_SEED else _of_seeds(value, seeds)
        for name, value in tree.items()
        if name in PER_SEED or isinstance(value, dict)
    }
