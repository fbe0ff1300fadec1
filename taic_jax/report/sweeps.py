"""A sweep's folder: its table, and each of its points as the run it would be alone."""

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

from taic_jax.config import Config
from taic_jax.config_io import load_config
from taic_jax.report.runs import LoadedRun, ReportError, read_run
from taic_jax.sweep.axes import configs_of, show
from taic_jax.sweep.runs import PLAN, TABLE, Plan

PER_SEED = ("per_seed", "first_per_seed")


@dataclasses.dataclass(frozen=True)
class SweepData:
    """The table of a sweep as it stands, with the names of its axes, and what is missing."""

    name: str
    axes: list[str]
    points: int
    table: list[dict[str, str]]
    notes: tuple[str, ...]


def is_sweep(folder: Path) -> bool:
    """Tell a sweep's folder from a run's."""
    return (folder / PLAN).is_file()


def read_sweep(folder: Path, name: str) -> tuple[SweepData, list[LoadedRun]]:
    """Return the table of a sweep, and its begun points as runs.

    Raises:
      ReportError: its plan cannot be read, or no point of it has finished an iteration.
      ConfigError: its config is of another version.
    """
    try:
        plan = Plan(**json.loads((folder / PLAN).read_text()))
    except (OSError, ValueError, TypeError):
        raise ReportError(f"{folder / PLAN}: expected the plan of a sweep, got another file") from None
    config, runs, missing = load_config(folder / "config.yaml"), [], []
    for number, which in enumerate(plan.chunks):
        try:
            chunk = read_run(folder / f"chunk-{number:03d}")
        except ReportError:
            missing += which
            continue
        runs += [_point(chunk, config, plan.points[i], i, place, name) for place, i in enumerate(which)]
    if not runs:
        raise ReportError(f"{folder}: expected at least one finished iteration of a sweep, got none in its chunks")
    table = _read_table(folder / TABLE)
    notes = (f"points not begun: {', '.join(map(str, missing))}",) if missing else ()
    if len(table) < len(plan.points):
        notes += (f"{len(table)} of {plan.optuna or len(plan.points)} points are finished",)
    axes = [text.partition("=")[0] for text in plan.axes]
    return SweepData(name, axes, plan.optuna or len(plan.points), table, notes), runs


def _point(chunk: LoadedRun, config: Config, values: dict[str, Any], index: int, place: int, sweep: str) -> LoadedRun:
    """Return the part of a chunk that is one point: K of its G K seeds."""
    seeds = slice(place * config.seeds, (place + 1) * config.seeds)
    summary = None if chunk.summary is None else {
        **{key: chunk.summary[key] for key in ("versions", "commit", "machine") if key in chunk.summary},
        "methods": _of_seeds(chunk.summary["methods"], seeds),
    }  # fmt: skip
    rows = [
        {key: value[seeds] if isinstance(value, list) else value for key, value in row.items()} for row in chunk.rows
    ]
    (own,) = configs_of(config, [values])
    return dataclasses.replace(
        chunk, name=f"{sweep} #{index}: {show(values)}", rows=rows, summary=summary, clock={}, point=True, config=own,
        fields=chunk.fields | values, notes=tuple(note for note in chunk.notes if not note.startswith("seed ")),
    )  # fmt: skip


def _of_seeds(tree: Any, seeds: slice) -> Any:
    """Keep what is per seed, of these seeds; statistics over all seeds of a chunk mix its points."""
    if not isinstance(tree, dict):
        return tree
    return {
        name: value[seeds] if name in PER_SEED else _of_seeds(value, seeds)
        for name, value in tree.items()
        if name in PER_SEED or isinstance(value, dict)
    }


def _read_table(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))
