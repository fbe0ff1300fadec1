"""The table of finished runs, a line of JSON each: what figures are drawn from, and nothing else.

A row is one method on one task for some seeds: what the run was (config and its hash, versions, commit), a curve per
seed on a common grid of ticks, and the numbers per seed before and after training; of some an example that is drawn.
"""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taic_jax.config import Config, walk
from taic_jax.config_io import load_config
from taic_jax.experiments.recovery import recovery_of
from taic_jax.runtime.files import save_text
from taic_jax.runtime.run_folder import RunFolder

TABLE = Path("experiments/results/evidence.jsonl")
GRID = 50
"""Points of a curve, equally far apart; the last is the end of training."""
DIGITS = 5
EARLIER_DEFAULTS = {"collect.capacity": 1_000_000}
"""Of fields whose default has changed since the first row."""
OWN = ("seed", "seeds")
"""Fields that say which seeds a run has, and not what is run."""


class TableError(ValueError):
    """The table cannot be used as asked."""


@dataclasses.dataclass(frozen=True)
class EvidenceRows:
    """One method on one task, of all seeds that the table holds."""

    task: str
    method: str
    seeds: tuple[int, ...]
    ticks: int
    pretraining: int
    grid: np.ndarray  # [G] ticks
    curves: dict[str, np.ndarray]  # [K, G] each
    numbers: dict[str, np.ndarray]  # [K] each; first, last, mean_option, duration, and the task's own
    remarks: tuple[str, ...]  # what a figure must say of them


def difference(config: Config, run_dir: Path) -> dict[str, Any]:
    """Return the fields that are not the default, without the seeds; what is taken from others is named in `run_dir`.

    A field that a later version adds is at its default, and so leaves the hash of an earlier run as it was; one whose
    default was changed is compared with the earlier one. The runs
    of other seeds take theirs from the runs of those seeds: their names differ in the seed alone, which is left out.
    """
    default = dict(walk(Config())) | EARLIER_DEFAULTS
    fields = {name: value for name, value in walk(config) if name not in OWN and value != default[name]}

    def named(text: str) -> str:
        return text.removeprefix(f"{run_dir}/").removesuffix(f"-{config.seed}")

    if "options.experience" in fields:
        fields["options.experience"] = [named(text) for text in fields["options.experience"]]
    if "options.source" in fields:
        fields["options.source"] = named(fields["options.source"])
    return fields


def config_hash(fields: dict[str, Any]) -> str:
    """Return twelve digits that tell one config from another."""
    return hashlib.sha256(json.dumps(fields, sort_keys=True, default=list).encode()).hexdigest()[:12]


def read_table(path: Path = TABLE) -> list[dict[str, Any]]:
    """Return the rows; none where there is no table yet.

    Raises:
        TableError: a line is no row.
    """
    if not path.exists():
        return []
    rows = []
    for number, line in enumerate(path.read_text().splitlines(), 1):
        try:
            row = json.loads(line)
            assert isinstance(row, dict) and {"task", "method", "seed", "seeds", "config"} <= row.keys()
        except (ValueError, AssertionError):
            raise TableError(f"{path}: line {number} is no row of a finished run; cut it and run again") from None
        rows.append(row)
    return rows


def append_row(path: Path, row: dict[str, Any]) -> None:
    """Add a row; a process that is killed leaves the table with it or without it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = path.read_text() if path.exists() else ""
    save_text(path, f"{lines}{json.dumps(_rounded(row), allow_nan=False, separators=(',', ':'))}\n")


def row_of(folder: Path, run_dir: Path, method: str, stage: str) -> dict[str, Any]:
    """Return the row of one method of a finished run.

    Args:
        folder: of the run.
        run_dir: the folder that it and what it takes from other runs are in.
        method: its name in the table.
        stage: the stage that trained it.
    """
    config = load_config(str(folder / "config.yaml"))
    fields = difference(config, run_dir)
    summary = json.loads((folder / "summary.json").read_text())
    told = summary["methods"]["taic" if stage == "train" else stage]
    ticks = {"collect": config.collect.ticks, "total": config.collect.ticks + config.train.ticks}
    ticks = ticks.get(stage, config.train.ticks)
    grid = np.arange(1, GRID + 1) * (ticks // GRID)
    logged = RunFolder(folder).metrics(stage)
    curves, numbers = curves_of(logged, stage, grid), {}
    if config.env.change_after:
        shares, numbers = recovery_of(logged, stage)
        curves["success"] = on_grid(logged, shares, grid).tolist()
    return {
        "task": config.env.name,
        "method": method,
        "seed": config.seed,
        "seeds": config.seeds,
        "ticks": ticks,
        "pretraining": pretraining_of(config) if stage in ("train", "transfer") else 0,
        "config": config_hash(fields),
        "fields": fields,
        "versions": summary["versions"],
        "commit": summary["commit"],
        "seconds": round(summary["seconds"]["run"]),
        "stopped": summary["stopped"].get(stage, {}),
        "grid": grid.tolist(),
        "curves": curves,
        "numbers": {
            "first": told["return"]["first_per_seed"],
            "last": told["return"]["per_seed"],
            "mean_option": told["return_mean_option"]["per_seed"],
            "duration": told["duration"]["per_seed"],
            **{name: value["per_seed"] for name, value in told["metrics"].items()},
            **numbers,
        },
    }


def pretraining_of(config: Config) -> int:
    """Return the interactions that were spent on what a run takes from others, or on its own experience."""
    source = config.options.source or next(iter(config.options.experience), "")
    return load_config(str(Path(source) / "config.yaml")).collect.ticks if source else config.collect.ticks


def curves_of(rows: Sequence[dict[str, Any]], stage: str, grid: np.ndarray) -> dict[str, list]:
    """Return what figures draw of the training [K, G]: the return, and the share of ticks at the goal.

    The environments of a run begin their episodes together, and most are at the goal late in them: an iteration is a
    part of an episode, so the share is a mean over several.
    """
    names = [name for name in (f"{stage}/return", f"{stage}/mean/success") if name in rows[0]]
    values = {name: np.array([row[name] for row in rows], float).T for name in names}
    return {
        name.removeprefix(f"{stage}/"): (mean_on_grid if "mean" in name else on_grid)(rows, value, grid).tolist()
        for name, value in values.items()
    }


def mean_on_grid(rows: Sequence[dict[str, Any]], values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return values [K, G]: at each point of the grid the mean of those [K, I] of the log's rows in the last two
    steps of the grid, or the latest where there is none.
    """
    ticks, means = np.array([row["ticks"] for row in rows]), on_grid(rows, values, grid)
    for g, end in enumerate(grid):
        recent = (ticks <= end) & (ticks > end - 2 * grid[0])
        if recent.any():
            means[:, g] = values[:, recent].mean(axis=1)
    return means


def on_grid(rows: Sequence[dict[str, Any]], values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return values [K, G]: at each point of the grid the latest of those [K, I] of the log's rows."""
    latest = np.searchsorted([row["ticks"] for row in rows], grid, side="right") - 1
    return np.where(latest >= 0, values[:, np.maximum(latest, 0)], np.nan)


def select(rows: Sequence[dict[str, Any]], task: str, method: str, minimum: int = 1) -> EvidenceRows:
    """Return what the table holds of one method on one task.

    Raises:
        TableError: nothing, rows of different configs, or one seed twice: what may not be averaged.
    """
    name = f"{task}/{method}"
    found = [row for row in rows if (row["task"], row["method"]) == (task, method)]
    if not found:
        raise TableError(f"{name}: no row; python -m taic_jax.experiments.evidence --only {name} makes it")
    hashes = {row["config"] for row in found}
    if len(hashes) > 1:
        raise TableError(f"{name}: rows of {len(hashes)} configs under one name: {', '.join(sorted(hashes))}")
    seeds = [row["seed"] + k for row in found for k in range(row["seeds"])]
    if len(set(seeds)) < len(seeds):
        raise TableError(f"{name}: seed {max(seeds, key=seeds.count)} stands in several rows")
    remarks = []
    if len(seeds) < minimum:
        remarks.append(f"{len(seeds)} of {minimum} seeds")
    differing = {k for row in found for k, v in row["versions"].items() if v != found[0]["versions"][k]}
    if differing - {"taic_jax"}:
        remarks.append(f"mixed versions of {', '.join(sorted(differing))}")
    if stopped := sum(len(row["stopped"]) for row in found):
        remarks.append(f"{stopped} diverged")
    return EvidenceRows(
        task, method, tuple(seeds), found[0]["ticks"], found[0]["pretraining"], np.array(found[0]["grid"]),
        {k: np.array([c for row in found for c in row["curves"][k]], float) for k in found[0]["curves"]},
        {k: np.array([x for row in found for x in row["numbers"][k]], float) for k in found[0]["numbers"]},
        tuple(remarks),
    )  # fmt: skip


def _rounded(value: Any) -> Any:
    """Round every float to a few digits, as a row is kept for good; what is not finite becomes None."""
    if isinstance(value, dict):
        return {name: _rounded(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else None
    return value
