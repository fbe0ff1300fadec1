"""The contents of a run's folder, read without trust: config, rows, summary, and notes on their faults."""

import contextlib
import dataclasses
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from taic_jax.config import COLLECT, Config, ConfigError
from taic_jax.config.files import closest
from taic_jax.runtime.run_folder import Row, RunFolder


class ReportError(ValueError):
    """Input that cannot be reported on."""


@dataclasses.dataclass(frozen=True)
class LoadedRun:
    """One run, or one point of a sweep."""

    name: str  # unique in the report
    folder: Path
    fields: dict[str, Any]  # of config.yaml by their dotted names, as read
    config: Config | None  # None if it is of another version
    rows: list[Row]
    summary: dict[str, Any] | None  # None while the run is not finished
    clock: dict[str, Any]  # seconds, and ticks if any, so far
    notes: tuple[str, ...]  # for the reader: partial, stopped seeds, rows left out
    point: bool = False  # whether it is a point of a sweep

    @property
    def seeds(self) -> int:
        """The number of seeds in every row."""
        return int(self.fields["seeds"])

    @property
    def task(self) -> str:
        """The task of training."""
        return str(self.fields["env.name"])

    @property
    def methods(self) -> dict[str, Any]:
        """The evaluations of the summary by method; none while the run is not finished."""
        return (self.summary or {}).get("methods", {})

    def of_stage(self, stage: str) -> list[Row]:
        """Return the rows of one stage."""
        return [row for row in self.rows if row["stage"] == stage]

    def ticks(self, stage: str) -> int:
        """Return the interactions per seed (of `learn`, gradient steps) in a stage so far; 0 if it has not begun."""
        return max((int(row["ticks" if "ticks" in row else "steps"]) for row in self.of_stage(stage)), default=0)

    def stages(self) -> list[str]:
        """Return the stages that have curves, in the order they ran."""
        return [stage for stage in dict.fromkeys(row["stage"] for row in self.rows) if stage != "evaluate"]

    def trained_stages(self) -> list[str]:
        """Return the stages that trained a policy, in the order they ran."""
        return [stage for stage in self.stages() if stage != "learn"]

    def task_of(self, stage: str) -> str:
        """Return the task of a stage: experience may be collected in another."""
        return str(self.fields.get("collect.env") or self.task) if stage == COLLECT else self.task

    def flat_stage(self) -> str | None:
        """Return the stage of baseline `flat`: its own, or else collect, as in `config.collector_is_baseline`."""
        if self.of_stage("flat"):
            return "flat"
        # By the fields, which a config of another version has, too.
        same = self.fields.get("collect.ticks") == self.fields.get("train.ticks") and self.task_of(COLLECT) == self.task
        return COLLECT if same and self.of_stage(COLLECT) else None


def read_run(folder: Path, name: str = "") -> LoadedRun:
    """Read one run's folder, or raise ReportError if it is none, or has no finished iteration."""
    files = RunFolder(folder)
    if not files.begun:
        raise ReportError(f"{folder}: expected the folder of a run, with config.yaml in it{_nearest(folder)}")
    fields, config, notes = _read_config(files)
    rows, cut = _read_rows(files.metrics_path)
    if not rows:
        raise ReportError(f"{folder}: expected at least one finished iteration, got none in metrics.jsonl")
    notes += cut
    summary = _json_object(files.summary_path)
    if summary is not None and "methods" not in summary:
        raise ReportError(f"{files.summary_path}: expected the summary of a run, with its methods; got another")
    if summary is None and files.summary_path.exists():
        notes += ("summary.json cannot be read: shown as a run that is not finished",)
    clock = _json_object(files.clock_path) or {}
    run = LoadedRun(name or folder.name, folder, fields, config, rows, summary, clock, notes)
    return dataclasses.replace(run, notes=notes + _state(run) + _stopped(run))


def run_of(name: str) -> RunFolder:
    """Return the folder of a run, by its path or the path of an artifact in it."""
    path = Path(name)
    return next((run for run in map(RunFolder, [path, *path.parents][:3]) if run.begun), RunFolder(path.parent))


def check_seeds(run: LoadedRun) -> None:
    """Raise ReportError unless every row of a run has the config's number of seeds."""
    for row in run.rows:
        for name, value in row.items():
            if isinstance(value, list) and len(value) != run.seeds:
                why = "; a sweep's chunk is shown by its sweep's folder" if run.folder.name.startswith("chunk-") else ""
                expected = f"expected {run.seeds} seeds as in config.yaml, got {len(value)}{why}"
                raise ReportError(f"{RunFolder(run.folder).metrics_path}: {name}: {expected}")


def unique_names(folders: Sequence[Path]) -> list[str]:
    """Return the shortest unique end of each folder's path, or raise ReportError if a folder is there twice."""
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
    """Return the end of a message that names a run in or beside a folder that is none."""
    pattern = f"*/{RunFolder(folder).config_path.name}"
    for parent, prefix in ((folder, "holds"), (folder.parent, "the nearest is")):
        names = sorted(path.parent.name for path in parent.glob(pattern)) if parent.is_dir() else []
        if names:
            return f"; {prefix} {parent / (closest(folder.name, names) or names[0])}"
    return ""


def _read_config(files: RunFolder) -> tuple[dict[str, Any], Config | None, tuple[str, ...]]:
    """Return the fields as they are, the config if it is of this version, and a note if not."""
    path = files.config_path
    try:
        fields = dict(_flatten(yaml.safe_load(path.read_text())))
    except (yaml.YAMLError, UnicodeDecodeError):
        raise ReportError(f"{path}: expected YAML, got another file") from None
    if "env.name" not in fields or not isinstance(fields.get("seeds"), int):
        raise ReportError(f"{path}: expected the resolved config of a run, got one without env.name or seeds")
    try:
        return fields, files.config(), ()
    except ConfigError as error:
        return fields, None, (f"config of another version, so its option space is not drawn: {error}",)


def _flatten(tree: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield (dotted name, value) of every leaf of nested mappings."""
    for name, value in tree.items() if isinstance(tree, dict) else ():
        if isinstance(value, dict):
            yield from _flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _read_rows(path: Path) -> tuple[list[Row], tuple[str, ...]]:
    """Return the rows, and a note if an incomplete last one is left out."""
    try:
        lines = path.read_text().splitlines(keepends=True) if path.exists() else []
    except UnicodeDecodeError:
        raise ReportError(f"{path}: expected rows of JSON, got what is not text") from None
    cut = bool(lines) and not lines[-1].endswith("\n")
    rows = []
    for number, line in enumerate(lines[: len(lines) - cut], 1):
        row = _json_object(line) or {}
        if "stage" not in row or not row.keys() & {"ticks", "steps"}:
            expected = "expected a row with stage and ticks or steps"
            raise ReportError(f"{path}: line {number}: {expected}, got {line.strip()[:40]!r}")
        rows.append(row)
    return rows, ("the last row of metrics.jsonl is half-written and left out",) if cut else ()


def _json_object(source: str | Path) -> dict[str, Any] | None:
    """Return the JSON object in a text or a file, or None without one."""
    with contextlib.suppress(OSError, ValueError):
        tree = json.loads(source if isinstance(source, str) else source.read_text())
        return tree if isinstance(tree, dict) else None
    return None


def _state(run: LoadedRun) -> tuple[str, ...]:
    """Return a note on the progress of a run without a summary."""
    if run.summary is not None:
        return ()
    stage = next((row["stage"] for row in reversed(run.rows) if row["stage"] != "evaluate"), "evaluate")
    planned = {"learn": "options.steps", COLLECT: "collect.ticks"}.get(stage, "train.ticks")
    of = f" of {run.fields[planned]:,}" if isinstance(run.fields.get(planned), int) and stage != "total" else ""
    unit = "gradient steps" if stage == "learn" else "ticks"
    return (f"not finished, or still going (no summary.json): stage {stage} is at {run.ticks(stage):,}{of} {unit}",)


def _stopped(run: LoadedRun) -> tuple[str, ...]:
    """Return notes on the seeds that diverged."""
    notes = [
        f"seed {seed} stopped in stage {stage} after {stop['after']:,}: {stop['quantity']} was not finite"
        for stage, seeds in ((run.summary or {}).get("stopped") or {}).items()
        for seed, stop in seeds.items()
    ]
    dumps = [path.name for path in sorted(run.folder.glob("dumps/*")) if path.is_dir()] if not notes else []
    return (*notes, *(f"a seed diverged: dumps/{name}" for name in dumps))


def per_seed(row: Row, name: str) -> np.ndarray | None:
    """Return a metric of a row as [K], NaN for numbers not finite; None for a missing metric, or one of counts."""
    value = row.get(name)
    if value is None or (isinstance(value, list) and any(isinstance(item, list) for item in value)):
        return None
    return np.array(value if isinstance(value, list) else [value], float)
