"""The table of finished runs, a line of JSON each: the only source of the figures.

A row is one method on one task for some seeds: config and its hash, versions, commit, a curve per seed on a common grid
of ticks, the numbers per seed before and after training, and of some an example to draw. Figures and comparisons state
these numbers over seeds, in tables of their own.
"""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taic_jax.analysis.statistics import bootstrap_interval, iqm, probability_of_improvement
from taic_jax.config import Config, walk
from taic_jax.experiments.evidence.measures import recovery_of
from taic_jax.runtime.files import json_safe, save_table, save_text
from taic_jax.runtime.run_folder import Row, RunFolder

RESULTS = Path("experiments/results")
TABLE = RESULTS / "evidence.jsonl"
DIGITS = 5  # Significant digits of every number in a table.
BOUNDS = ("", "_low", "_high")
GRID = 50  # Points of a curve, equally far apart; the last is the end of training.
EARLIER_DEFAULTS = {"collect.capacity": 1_000_000}  # Fields with another default today.
OWN = ("seed", "seeds")  # Fields of the seeds alone.


class TableError(ValueError):
    """The table cannot be used in this way."""


@dataclasses.dataclass(frozen=True)
class EvidenceRows:
    """One method on one task, all its seeds in the table."""

    task: str
    method: str
    seeds: tuple[int, ...]
    ticks: int
    pretraining: int
    grid: np.ndarray  # [G] ticks
    curves: dict[str, np.ndarray]  # [K, G] each
    numbers: dict[str, np.ndarray]  # [K] each; first, last, mean_option, duration, and the task's own
    remarks: tuple[str, ...]  # warnings for a figure


def difference(config: Config, run_dir: Path) -> dict[str, Any]:
    """Return the fields that are not at their default, without the seeds; other runs by their names in `run_dir`.

    A field that a later version adds is at its default, which leaves the hash of an earlier run the same; one whose
    default has changed is compared with the earlier one. Source runs of other seeds differ in the seed at the end of
    their name, which is left out.
    """
    default = dict(walk(Config())) | EARLIER_DEFAULTS
    fields = {name: value for name, value in walk(config) if name not in OWN and value != default[name]}

    def name_of(text: str) -> str:
        return text.removeprefix(f"{run_dir}/").removesuffix(f"-{config.seed}")

    if "options.experience" in fields:
        fields["options.experience"] = [name_of(text) for text in fields["options.experience"]]
    if "options.source" in fields:
        fields["options.source"] = name_of(fields["options.source"])
    return fields


def config_hash(config: Config, run_dir: Path) -> str:
    """Return twelve digits that identify a config without its seeds."""
    fields = difference(config, run_dir)
    return hashlib.sha256(json.dumps(fields, sort_keys=True, default=list).encode()).hexdigest()[:12]


def read_table(path: Path = TABLE) -> list[dict[str, Any]]:
    """Return the rows, none if there is no table; raise `TableError` at a line that is no row."""
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
    save_text(path, f"{lines}{json.dumps(json_safe(row, DIGITS), allow_nan=False, separators=(',', ':'))}\n")


def row_of(folder: Path, run_dir: Path, method: str, stage: str) -> dict[str, Any]:
    """Return the row of one method of a finished run in a folder of `run_dir`, trained in `stage`."""
    run = RunFolder(folder)
    config, summary = run.config(), run.summary()
    evaluated = summary["methods"]["taic" if stage == "train" else stage]
    ticks = {"collect": config.collect.ticks, "total": config.collect.ticks + config.train.ticks}
    ticks = ticks.get(stage, config.train.ticks)
    grid = np.arange(1, GRID + 1) * (ticks // GRID)
    logged = run.metrics(stage)
    curves, numbers = curves_of(logged, stage, grid), {}
    if config.env.change_after:
        shares, numbers = recovery_of(logged, stage)
        curves["success"] = on_grid(logged, shares, grid).tolist()
    row: dict[str, Any] = {"task": config.env.name, "method": method, "seed": config.seed, "seeds": config.seeds}
    row |= {"ticks": ticks, "pretraining": pretraining_of(config) if stage in ("train", "transfer") else 0}
    row |= {"config": config_hash(config, run_dir), "fields": difference(config, run_dir)}
    row |= {"versions": summary["versions"], "commit": summary["commit"], "seconds": round(summary["seconds"]["run"])}
    row |= {"stopped": summary["stopped"].get(stage, {}), "grid": grid.tolist(), "curves": curves}
    row["numbers"] = {
        "first": evaluated["return"]["first_per_seed"],
        "last": evaluated["return"]["per_seed"],
        "mean_option": evaluated["return_mean_option"]["per_seed"],
        "duration": evaluated["duration"]["per_seed"],
        **{name: value["per_seed"] for name, value in evaluated["metrics"].items()},
        **numbers,
    }
    return row


def pretraining_of(config: Config) -> int:
    """Return the interactions of the experience, the practice or the policy that a run starts from."""
    if config.options.source:
        return pretraining_of(RunFolder(Path(config.options.source)).config())
    experience = next(iter(config.options.experience), "")
    collected = RunFolder(Path(experience)).config() if experience else config
    return collected.collect.ticks + config.practise.ticks


def curves_of(rows: Sequence[Row], stage: str, grid: np.ndarray) -> dict[str, list]:
    """Return the curves of training [K, G]: the return, and the share of ticks at the goal.

    That share is a mean over iterations: they are parts of episodes that begin together and reach the goal late.
    """
    names = [name for name in (f"{stage}/return", f"{stage}/mean/success") if name in rows[0]]
    values = {name: np.array([row[name] for row in rows], float).T for name in names}
    on = {name: mean_on_grid if "mean" in name else on_grid for name in names}
    return {name.removeprefix(f"{stage}/"): on[name](rows, values[name], grid).tolist() for name in names}


def mean_on_grid(rows: Sequence[Row], values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return at each point of the grid the mean of the values [K, I] of the log's rows in the last two steps of the
    grid, or the latest where there is none: [K, G]."""
    ticks, means = np.array([row["ticks"] for row in rows]), on_grid(rows, values, grid)
    for g, end in enumerate(grid):
        recent = (ticks <= end) & (ticks > end - 2 * grid[0])
        if recent.any():
            means[:, g] = values[:, recent].mean(axis=1)
    return means


def on_grid(rows: Sequence[Row], values: np.ndarray, grid: np.ndarray) -> np.ndarray:
    """Return at each point of the grid the latest of the values [K, I] of the log's rows: [K, G]."""
    latest = np.searchsorted([row["ticks"] for row in rows], grid, side="right") - 1
    return np.where(latest >= 0, values[:, np.maximum(latest, 0)], np.nan)


def select(rows: Sequence[dict[str, Any]], task: str, method: str, minimum: int = 1) -> EvidenceRows:
    """Return the rows of one method on one task as one; raise `TableError` if there are none, several configs, or one
    seed twice."""
    name = f"{task}/{method}"
    matches = [row for row in rows if (row["task"], row["method"]) == (task, method)]
    if not matches:
        raise TableError(f"{name}: no row; python -m taic_jax.experiments.evidence --only {name} makes it")
    hashes = {row["config"] for row in matches}
    if len(hashes) > 1:
        raise TableError(f"{name}: rows of {len(hashes)} configs under one name: {', '.join(sorted(hashes))}")
    seeds = [row["seed"] + k for row in matches for k in range(row["seeds"])]
    if len(set(seeds)) < len(seeds):
        raise TableError(f"{name}: seed {max(seeds, key=seeds.count)} stands in several rows")
    remarks = []
    if len(seeds) < minimum:
        remarks.append(f"{len(seeds)} of {minimum} seeds")
    differing = {k for row in matches for k, v in row["versions"].items() if v != matches[0]["versions"][k]}
    if differing - {"taic_jax"}:
        remarks.append(f"mixed versions of {', '.join(sorted(differing))}")
    if stopped := sum(len(row["stopped"]) for row in matches):
        remarks.append(f"{stopped} diverged")
    return EvidenceRows(
        task, method, tuple(seeds), matches[0]["ticks"], matches[0]["pretraining"], np.array(matches[0]["grid"]),
        {k: np.array([c for row in matches for c in row["curves"][k]], float) for k in matches[0]["curves"]},
        {k: np.array([x for row in matches for x in row["numbers"][k]], float) for k in matches[0]["numbers"]},
        tuple(remarks),
    )  # fmt: skip


def with_interval(values: np.ndarray, names: Sequence[str] = ("iqm", "low", "high")) -> dict[str, float]:
    """Return the interquartile mean of one number per seed, and its 95 % interval."""
    return dict(zip(names, (float(iqm(values)), *bootstrap_interval(values)), strict=True))


def with_improvement(name: str, values: np.ndarray, others: np.ndarray) -> dict[str, float]:
    """Return the probability that a seed is better than one of the others, and its 95 % interval."""
    p, interval = probability_of_improvement(values, others)
    return {f"{name}{bound}": value for bound, value in zip(BOUNDS, (p, *interval), strict=True)}


def write_numbers(rows: Sequence[dict[str, Any]], out: Path, fields: Sequence[str] = ()) -> None:
    """Write rows of numbers, which may lack some of the fields, as CSV, and print them; an array is one per seed."""
    texts = [dict.fromkeys(fields, "") | {name: _as_text(value) for name, value in row.items()} for row in rows]
    save_table(out, texts)
    for text in texts:
        print("  ".join(f"{name} {value}" for name, value in text.items() if value not in (None, "")))


def _as_text(value: Any) -> Any:
    """Return floats with the digits of the table, and other values unchanged."""
    if isinstance(value, np.ndarray):
        return " ".join(f"{x:.{DIGITS}g}" for x in value)
    return f"{value:.{DIGITS}g}" if isinstance(value, float) else value
