"""What a run's folder holds, read without trust: config, rows, summary, and what is wrong with them."""

import contextlib
import dataclasses
import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from taic_jax.config import COLLECT, Config, ConfigError, walk
from taic_jax.config_io import closest, load_config
from taic_jax.runtime.logging import Row

UNTRAINED_STAGES = ("evaluate", "learn")
"""Stages of metrics.jsonl in which no policy is trained."""


class ReportError(ValueError):
    """What is given cannot be reported on."""


@dataclasses.dataclass(frozen=True)
class LoadedRun:
    """One run, or one point of a sweep.

    Attributes:
      name: unique in the report.
      folder: of the run.
      fields: dotted name -> value of everything in its config.yaml, as read.
      config: the same, or None where it is of another version.
      rows: of metrics.jsonl.
      summary: None while the run is not finished.
      clock: ticks and seconds so far.
      notes: what the reader must know: partial, stopped seeds, lines left out.
      point: whether it is a point of a sweep.
    """

    name: str
    folder: Path
    fields: dict[str, Any]
    config: Config | None
    rows: list[Row]
    summary: dict[str, Any] | None
    clock: dict[str, Any]
    notes: tuple[str, ...]
    point: bool = False

    @property
    def seeds(self) -> int:
        """How many seeds every row holds."""
        return int(self.fields["seeds"])

    @property
    def task(self) -> str:
        """The task that is trained on."""
        return str(self.fields["env.name"])

    def of_stage(self, stage: str) -> list[Row]:
        """Return the rows of one stage."""
        return [row for row in self.rows if row["stage"] == stage]

    def ticks(self, stage: str) -> int:
        """Return the interactions per seed made in a stage so far; 0 if it has not begun."""
        return max((int(row["ticks"]) for row in self.of_stage(stage)), default=0)

    def stages(self) -> list[str]:
        """Return the stages that trained a policy, in the order they ran."""
        return [stage for stage in dict.fromkeys(row["stage"] for row in self.rows) if stage not in UNTRAINED_STAGES]

    def task_of(self, stage: str) -> str:
        """Return the task of a stage: experience may be collected in another."""
        return str(self.fields.get("collect.env") or self.task) if stage == COLLECT else self.task

    def flat_stage(self) -> str | None:
        """Return the stage that is baseline `flat`: its own, or stage collect on the same task for as many ticks."""
        if self.of_stage("flat"):
            return "flat"
        same = self.fields.get("collect.ticks") == self.fields.get("train.ticks") and self.task_of(COLLECT) == self.task
        return COLLECT if same and self.of_stage(COLLECT) else None


def read_run(folder: Path, name: str = "") -> LoadedRun:
    """Read one run's folder.

    Raises:
      ReportError: it is none, no iteration is finished in it, or its rows are of another run than its config.
    """
    if not (folder / "config.yaml").is_file():
        raise ReportError(f"{folder}: expected the folder of a run, with config.yaml in it{_nearest(folder)}")
    fields, config, notes = _read_config(folder / "config.yaml")
    rows, cut = _read_rows(folder / "metrics.jsonl")
    if not rows:
        raise ReportError(f"{folder}: expected at least one finished iteration, got none in metrics.jsonl")
    notes += cut
    clock = _read_json(folder / "clock.json") or {}
    summary = _read_json(folder / "summary.json")
    if summary is not None and "methods" not in summary:
        raise ReportError(f"{folder / 'summary.json'}: expected the summary of a run, with its methods; got another")
    if summary is None and (folder / "summary.json").exists():
        notes += ("summary.json cannot be read: shown as a run that is not finished",)
    run = LoadedRun(name or folder.name, folder, fields, config, rows, summary, clock, notes)
    return dataclasses.replace(run, notes=notes + _state(run) + _stopped(run))


def check_seeds(run: LoadedRun) -> None:
    """Raise ReportError unless every row of a run holds as many seeds as its config says."""
    for row in run.rows:
        for name, value in row.items():
            if isinstance(value, list) and len(value) != run.seeds:
                why = "; a sweep's chunk is shown by its sweep's folder" if run.folder.name.startswith("chunk-") else ""
                raise ReportError(
                    f"{run.folder / 'metrics.jsonl'}: {name}: expected {run.seeds} seeds as in config.yaml, "
                    f"got {len(value)}{why}"
                )


def unique_names(folders: Sequence[Path]) -> list[str]:
    """Return for each folder the shortest end of its path that tells it from the others.

    Raises:
      ReportError: a folder is given twice.
    """
    paths = [folder.resolve() for folder in folders]
    for path, count in Counter(paths).items():
        if count > 1:
            raise ReportError(f"{folders[paths.index(path)]}: expected every run once, got it {count} times")
    names = []
    for path in paths:
        depth = 1
        while sum(other.parts[-depth:] == path.parts[-depth:] for other in paths) > 1:
            depth += 1
        names.append("/".join(path.parts[-depth:]))
    return names


def _nearest(folder: Path) -> str:
    """Tell of a run in or beside a folder that is none."""
    for parent, prefix in ((folder, "holds"), (folder.parent, "the nearest is")):
        runs = [path.parent.name for path in parent.glob("*/config.yaml")] if parent.is_dir() else []
        if runs:
            return f"; {prefix} {parent / (closest(folder.name, runs) or sorted(runs)[0])}"
    return ""


def _read_config(path: Path) -> tuple[dict[str, Any], Config | None, tuple[str, ...]]:
    """Return the fields as they are, and the config where it is of this version."""
    try:
        fields = dict(_flatten(yaml.safe_load(path.read_text())))
    except (yaml.YAMLError, UnicodeDecodeError):
        raise ReportError(f"{path}: expected YAML, got another file") from None
    if "env.name" not in fields or not isinstance(fields.get("seeds"), int):
        raise ReportError(f"{path}: expected the resolved config of a run, got one without env.name or seeds")
    try:
        return fields, load_config(path), ()
    except ConfigError as error:
        return fields, None, (f"config of another version, so its option space is not drawn: {error}",)


def _flatten(tree: Any, prefix: str = "") -> Any:
    """Yield (dotted name, value) of every leaf of nested mappings."""
    for name, value in (tree or {}).items() if isinstance(tree, dict) else ():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _read_rows(path: Path) -> tuple[list[Row], tuple[str, ...]]:
    """Return the rows; a half-written last one is left out, and told."""
    try:
        lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    except UnicodeDecodeError:
        raise ReportError(f"{path}: expected rows of JSON, got what is not text") from None
    cut = bool(lines) and not lines[-1].endswith("\n")
    rows = []
    for number, line in enumerate(lines[: len(lines) - cut], 1):
        with contextlib.suppress(ValueError):
            row = json.loads(line)
            if isinstance(row, dict) and "stage" in row and ("ticks" in row or "steps" in row):
                rows.append(row)
                continue
        raise ReportError(
            f"{path}: line {number}: expected a row with stage and ticks or steps, got {line.strip()[:40]!r}"
        )
    return rows, ("the last row of metrics.jsonl is half-written and left out",) if cut else ()


def _read_json(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _state(run: LoadedRun) -> tuple[str, ...]:
    """Tell how far a run is that left no summary."""
    if run.summary is not None:
        return ()
    stage = next((row["stage"] for row in reversed(run.rows) if row["stage"] != "evaluate"), "evaluate")
    planned = {"learn": "options.steps", COLLECT: "collect.ticks"}.get(stage, "train.ticks")
    done = max((int(row["ticks" if "ticks" in row else "steps"]) for row in run.of_stage(stage)), default=0)
    of = f" of {run.fields[planned]:,}" if isinstance(run.fields.get(planned), int) and stage != "total" else ""
    unit = "gradient steps" if stage == "learn" else "ticks"
    return (f"not finished, or still going (no summary.json): stage {stage} is at {done:,}{of} {unit}",)


def _stopped(run: LoadedRun) -> tuple[str, ...]:
    """Tell which seeds diverged."""
    told = (run.summary or {}).get("stopped") or {}
    notes = [
        f"seed {seed} stopped in stage {stage} after {stop['after']:,}: {stop['quantity']} was not finite"
        for stage, seeds in told.items()
        for seed, stop in seeds.items()
    ]
    dumps = [path.name for path in sorted(run.folder.glob("dumps/*")) if path.is_dir()] if not notes else []
    return (*notes, *(f"a seed diverged: dumps/{name}" for name in dumps))


def default_fields() -> dict[str, Any]:
    """Return the defaults of every field of the config."""
    return {name: list(value) if isinstance(value, tuple) else value for name, value in walk(Config())}


def per_seed(row: Row, name: str) -> np.ndarray | None:
    """Return a metric of a row as [K], NaN where it was not finite; None if it is missing or counts."""
    value = row.get(name)
    if value is None or (isinstance(value, list) and any(isinstance(item, list) for item in value)):
        return None
    return np.array(value if isinstance(value, list) else [value], float)
