"""The runs of a sweep: chunk by chunk, each a resumable run; then one table, the best point, and its neighbours."""

import dataclasses
import json
import shutil
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from taic_jax.analysis.statistics import bootstrap_interval, iqm
from taic_jax.artifacts.experience import EXPERIENCE
from taic_jax.config import Config, Track, replace
from taic_jax.config.files import to_yaml
from taic_jax.pipeline import run_pipeline
from taic_jax.runtime.files import save_json, save_table, save_text
from taic_jax.runtime.pbt import Population, schedule
from taic_jax.runtime.run_folder import LOCK, RunFolder, RunFolderError
from taic_jax.runtime.signals import DivergedError
from taic_jax.runtime.tracking import follow
from taic_jax.sweep.axes import Axis, Point, chunks, configs_of, show
from taic_jax.sweep.marginals import draw_marginals

PLAN, TABLE, BEST, MARGINALS = "plan.json", "table.csv", "best.yaml", "marginals.png"

TableRow = dict[str, Any]  # a point's index and values, seeds, ticks, and statistics of its returns over seeds


@dataclasses.dataclass
class Plan:
    """The axes and counts of a sweep, its points [G], and the chunks of their indices, each for one program."""

    axes: list[str]
    samples: int
    optuna: int
    size: int
    points: list[Point]  # Optuna's are added as it suggests them
    chunks: list[list[int]]
    trials: list[int] = dataclasses.field(default_factory=list)  # Optuna's numbers of the points
    pbt: int = 0

    def describe(self, config: Config) -> str:
        """Return the plan in a few lines."""
        count = self.optuna or len(self.points)
        programs = "as Optuna asks" if self.optuna else f"in {len(self.chunks)} programs"
        lines = [f"{count} points x {config.seeds} seeds, at most {self.size} points at once, {programs}"]
        return "\n".join(lines + [f"  {i:3} {show(point)}" for i, point in enumerate(self.points)])

    def save(self, run_dir: Path) -> None:
        """Write the plan to a sweep's folder."""
        save_json(run_dir / PLAN, dataclasses.asdict(self))


def run_sweep(
    config: Config,
    axes: list[Axis],
    plan: Plan,
    run_dir: Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    on_cluster: bool = False,
    track: Track = "none",
    **settings: Any,
) -> None:
    """Run the missing chunks; write the table after each, and at the end the best point and the marginal plots.

    Raise Interrupted at a signal, and RunFolderError as `RunFolder.prepare` and `RunFolder.claimed`.
    """
    config = sweep_config(config)
    if plan.pbt:
        settings["population"] = Population(plan.pbt, {axis.name: axis.bounds for axis in axes}, config.seeds)
    RunFolder(run_dir).prepare(config, resume=resume, overwrite=overwrite)
    with RunFolder(run_dir).claimed():
        plan = _resume(plan, run_dir) if resume else plan
        plan.save(run_dir)
        if resume and (run_dir / BEST).is_file():
            print(f"taic_jax: {run_dir} is finished: see {run_dir / TABLE}", file=sys.stderr)
            return
        table: list[TableRow] = []
        work = partial(run_chunk, config, plan, run_dir, track)
        for batch in _batches(config, axes, plan, run_dir, table):
            for rows in _on_cluster(work, settings, batch) if on_cluster else map(partial(work, settings), batch):
                table += rows
                _save_table(run_dir / TABLE, table)
        finished = [row for row in table if np.isfinite(row["iqm"])]
        if finished:
            header, point = _best_member(config, plan, run_dir) if plan.pbt else _best_point(plan, finished)
            save_text(run_dir / BEST, header + to_yaml(configs_of(config, [point])[0]))
        draw_marginals(run_dir / MARGINALS, axes, plan.points, {row["point"]: row["iqm"] for row in table})


def sweep_config(config: Config) -> Config:
    """Return the config of all points before their own fields: without videos."""
    return replace(config, "evaluate.video_ticks", 0)


def _best_point(plan: Plan, table: list[TableRow]) -> tuple[str, Point]:
    """Print and return the best point, with an empty header of its config."""
    best = max(table, key=lambda row: row["iqm"])
    point = plan.points[best["point"]]
    print(f"best: {show(point)}: {best['iqm']:.4g} ({best['low']:.4g} … {best['high']:.4g})")
    return "", point


def _best_member(config: Config, plan: Plan, run_dir: Path) -> tuple[str, Point]:
    """Print the best member of all populations; return its schedule, as comments, and its last point."""
    folder = RunFolder(run_dir / "chunk-000")
    returns = np.array(folder.summary()["methods"]["taic"]["return"]["per_seed"], float)
    best = int(np.nanargmax(returns))
    parts = schedule(folder.metrics("train"), list(plan.points[0]), best)
    last = parts[-1][1]
    print(f"best: {show(last)} at the end: {returns[best]:.4g}, point {plan.chunks[0][best // config.seeds]}")
    comments = ["What --pbt found; below, the last of it."] + [f"from tick {tick}: {show(p)}" for tick, p in parts]
    return "".join(f"# {comment}\n" for comment in comments), last


def run_chunk(
    config: Config, plan: Plan, run_dir: Path, track: Track, settings: dict[str, Any], chunk: int
) -> list[TableRow]:
    """Run one chunk, unless it is finished, track its points, each as a run, and return a row per point."""
    folder, indices = RunFolder(run_dir / f"chunk-{chunk:03d}"), plan.chunks[chunk]
    points = configs_of(config, [plan.points[i] for i in indices])
    if not folder.finished:
        try:
            run_pipeline(points[0], folder.path, points=points, resume=folder.begun, **settings)
        except DivergedError as error:
            print(f"taic_jax: {error}", file=sys.stderr)
            save_json(folder.summary_path, {"methods": {}})
    for i, index in enumerate(indices):
        part = slice(i * config.seeds, (i + 1) * config.seeds)
        with follow(track, folder, points[i], f"{run_dir.name}-{index}", part):
            pass  # the rows are there
    for name in (EXPERIENCE, "checkpoints"):  # only a resume needs them; a sweep killed here leaves some
        shutil.rmtree(folder.path / name, ignore_errors=True)
    if methods := folder.summary()["methods"]:
        returns = methods["taic"]["return"]
        both = np.array([returns["per_seed"], returns["first_per_seed"]], float)
    else:  # every seed diverged
        both = np.full((2, len(indices) * config.seeds), np.nan)
    last, first = both.reshape(2, len(indices), config.seeds)
    return [_row(config, plan, i, *pair) for i, *pair in zip(indices, last, first, strict=True)]


def _row(config: Config, plan: Plan, i: int, returns: np.ndarray, first: np.ndarray) -> TableRow:
    low, high = bootstrap_interval(returns)
    return {
        "point": i, **plan.points[i], "seeds": config.seeds, "ticks": config.train.ticks,
        "iqm": float(iqm(returns)), "low": low, "high": high, "mean": float(returns.mean()),
        "diverged": int(np.isnan(returns).sum()), "untrained": float(first.mean()),
        "per_seed": " ".join(f"{x:.5g}" for x in returns),
    }  # fmt: skip


def _on_cluster(work: partial, settings: dict[str, Any], batch: Sequence[int]) -> Iterator[list[TableRow]]:
    """Run the chunks of a batch as tasks of the connected cluster."""
    from taic_jax.sweep.ray_tasks import run_tasks

    remote = {name: value for name, value in settings.items() if name != "signals"}  # signals are this process's
    return run_tasks(work, [(remote, chunk) for chunk in batch], settings.get("signals"))


def _batches(
    config: Config, axes: list[Axis], plan: Plan, run_dir: Path, table: list[TableRow]
) -> Iterator[Sequence[int]]:
    """Yield batches of chunks to run in any order; with Optuna, report each batch's table before the next."""
    yield range(len(plan.chunks))
    if not plan.optuna:
        return
    from taic_jax.sweep.optuna_study import Study

    study, reported = Study(axes, run_dir, config.seed), 0
    while True:
        for row in table[reported:]:
            study.tell(plan.trials[row["point"]], row["iqm"])
        reported, first, chunk = len(table), len(plan.points), len(plan.chunks)
        count = min(plan.size, plan.optuna - first)
        if count <= 0:
            return
        trials, points = study.ask(count)
        configs_of(config, points)
        plan.trials += trials
        plan.points += points
        plan.chunks += [[first + i for i in group] for group in chunks(points, plan.size)]
        plan.save(run_dir)
        yield range(chunk, len(plan.chunks))


def _resume(plan: Plan, run_dir: Path) -> Plan:
    """Return the folder's plan, or the new one if a sweep was killed before it wrote any, or raise RunFolderError."""
    if {path.name for path in run_dir.iterdir()} == {RunFolder(run_dir).config_path.name, LOCK}:
        return plan
    try:
        saved = Plan(**json.loads((run_dir / PLAN).read_text()))
    except (OSError, ValueError, TypeError):
        raise RunFolderError(f"{run_dir} holds no sweep to resume: no {PLAN} in it") from None
    for name in ("axes", "samples", "optuna", "pbt"):
        old, new = getattr(saved, name), getattr(plan, name)
        if old != new:
            raise RunFolderError(f"{run_dir} was run with other points: --{name} was {old}, got {new}")
    return saved


def _save_table(path: Path, table: list[TableRow]) -> None:
    rows = sorted(table, key=lambda row: row["point"])
    save_table(path, [{name: f"{x:.5g}" if isinstance(x, float) else x for name, x in row.items()} for row in rows])
