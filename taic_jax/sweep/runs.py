"""The runs of a sweep: chunk by chunk, each a resumable run; then one table, the best point, and its neighbours."""

import csv
import dataclasses
import io
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
from taic_jax.config import Config, replace
from taic_jax.config_io import to_yaml
from taic_jax.pipeline import run_pipeline
from taic_jax.runtime.files import save_text
from taic_jax.runtime.pbt import Population, schedule
from taic_jax.runtime.run_folder import LOCK, RunFolder, RunFolderError
from taic_jax.runtime.signals import DivergedError
from taic_jax.sweep.axes import Axis, chunks, configs_of, show
from taic_jax.sweep.marginals import draw_marginals

PLAN, TABLE, BEST, MARGINALS = "plan.json", "table.csv", "best.yaml", "marginals.png"


@dataclasses.dataclass
class Plan:
    """What is asked for, the points [G], and the chunks of their indices that run in one program each.

    Points that Optuna asks for are added as it asks; `trials` are its numbers of them.
    """

    axes: list[str]
    samples: int
    optuna: int
    size: int
    points: list[dict[str, Any]]
    chunks: list[list[int]]
    trials: list[int] = dataclasses.field(default_factory=list)
    pbt: int = 0

    def tell(self, config: Config) -> str:
        """Return the plan in a few lines."""
        count = self.optuna or len(self.points)
        programs = "as Optuna asks" if self.optuna else f"in {len(self.chunks)} programs"
        lines = [f"{count} points x {config.seeds} seeds, at most {self.size} points at once, {programs}"]
        return "\n".join(lines + [f"  {i:3} {show(point)}" for i, point in enumerate(self.points)])

    def save(self, run_dir: Path) -> None:
        """Write the plan to a run's folder."""
        save_text(run_dir / PLAN, json.dumps(dataclasses.asdict(self), indent=1) + "\n")


def run_sweep(
    config: Config,
    axes: list[Axis],
    plan: Plan,
    run_dir: Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    on_cluster: bool = False,
    **settings: Any,
) -> None:
    """Run what is missing, and write the table after every chunk, the best point and the marginal plots at the end.

    Raises:
      Interrupted: a signal was received; resume goes on from where it came.
      RunFolderError: the folder holds another sweep, or none to resume, or another process is at it.
    """
    config = sweep_config(config)
    if plan.pbt:
        bounds = {axis.name: axis.bounds for axis in axes}
        settings["population"] = Population(plan.pbt, bounds, config.seeds)
    RunFolder(run_dir).prepare(config, resume=resume, overwrite=overwrite)
    with RunFolder(run_dir).claimed():
        plan = _resumed(plan, run_dir) if resume else plan
        plan.save(run_dir)
        if resume and (run_dir / BEST).is_file():
            print(f"taic_jax: {run_dir} is finished: see {run_dir / TABLE}", file=sys.stderr)
            return
        table: list[dict[str, Any]] = []
        run = _on_cluster if on_cluster else map
        for batch in _batches(config, axes, plan, run_dir, table):
            for rows in run(partial(run_chunk, config, plan, run_dir, settings), batch):
                table += rows
                _write_table(run_dir / TABLE, table)
        finished = [row for row in table if np.isfinite(row["iqm"])]
        if finished:
            told = _best_member(config, plan, run_dir) if plan.pbt else _best_point(config, plan, finished)
            save_text(run_dir / BEST, told)
        draw_marginals(run_dir / MARGINALS, axes, plan.points, {row["point"]: row["iqm"] for row in table})


def sweep_config(config: Config) -> Config:
    """Return the config that all points start from: without videos."""
    return replace(config, "evaluate.video_ticks", 0)


def _best_point(config: Config, plan: Plan, table: list[dict[str, Any]]) -> str:
    """Tell the point that did best, and return its config."""
    best = max(table, key=lambda row: row["iqm"])
    point = plan.points[best["point"]]
    print(f"best: {show(point)}: {best['iqm']:.4g} ({best['low']:.4g} … {best['high']:.4g})")
    return to_yaml(configs_of(config, [point])[0])


def _best_member(config: Config, plan: Plan, run_dir: Path) -> str:
    """Tell the member of all populations that did best, and return its last config behind its schedule."""
    folder = run_dir / "chunk-000"
    returns = np.array(
        json.loads((folder / "summary.json").read_text())["methods"]["taic"]["return"]["per_seed"], float
    )
    best = int(np.nanargmax(returns))
    rows = RunFolder(folder).metrics("train")
    found = schedule(rows, list(plan.points[0]), best)
    print(f"best: {show(found[-1][1])} at the end: {returns[best]:.4g}, point {plan.chunks[0][best // config.seeds]}")
    lines = [f"# from tick {tick}: {show(point)}\n" for tick, point in found]
    return (
        "# What --pbt found; below, the last of it.\n" + "".join(lines) + to_yaml(configs_of(config, [found[-1][1]])[0])
    )


def run_chunk(config: Config, plan: Plan, run_dir: Path, settings: dict[str, Any], chunk: int) -> list[dict[str, Any]]:
    """Run one chunk, unless it is done, and return a row per point."""
    folder, which = run_dir / f"chunk-{chunk:03d}", plan.chunks[chunk]
    points = configs_of(config, [plan.points[i] for i in which])
    if not (folder / "summary.json").is_file():
        begun = (folder / "config.yaml").is_file()
        try:
            run_pipeline(points[0], folder, points=points, resume=begun, **settings)
        except DivergedError as error:
            print(f"taic_jax: {error}", file=sys.stderr)
            save_text(folder / "summary.json", json.dumps({"methods": {}}) + "\n")
    for name in (EXPERIENCE, "checkpoints"):  # only needed to go on; a sweep that was killed here may have left some
        shutil.rmtree(folder / name, ignore_errors=True)
    told = json.loads((folder / "summary.json").read_text())["methods"].get("taic", {}).get("return", {})
    nothing = [None] * (len(which) * config.seeds)
    last, first = (np.array(told.get(name, nothing), float) for name in ("per_seed", "first_per_seed"))
    return [
        _row(plan, i, config, returns, begun)
        for i, returns, begun in zip(which, last.reshape(len(which), -1), first.reshape(len(which), -1), strict=True)
    ]


def _row(plan: Plan, i: int, config: Config, returns: np.ndarray, first: np.ndarray) -> dict[str, Any]:
    low, high = bootstrap_interval(returns)
    return {
        "point": i, **plan.points[i], "seeds": config.seeds, "ticks": config.train.ticks,
        "iqm": float(iqm(returns)), "low": low, "high": high, "mean": float(returns.mean()),
        "diverged": int(np.isnan(returns).sum()), "untrained": float(first.mean()),
        "per_seed": " ".join(f"{x:.5g}" for x in returns),
    }  # fmt: skip


def _on_cluster(work: partial, batch: Sequence[int]) -> Iterator[list[dict[str, Any]]]:
    """Run the chunks of a batch as tasks of the cluster that this process is connected to."""
    from taic_jax.sweep.ray_tasks import run_tasks

    config, plan, run_dir, settings = work.args
    settings = dict(settings)
    signals = settings.pop("signals", None)  # they are this process's
    work = partial(run_chunk, config, plan, run_dir.absolute(), settings)
    return run_tasks(work, [(chunk,) for chunk in batch], signals)


def _batches(
    config: Config, axes: list[Axis], plan: Plan, run_dir: Path, table: list[dict[str, Any]]
) -> Iterator[Sequence[int]]:
    """Yield the chunks to run; where Optuna asks, those it asked for, and tell it of them before it asks for the next.

    Chunks of one batch may run in any order, or at once.
    """
    if not plan.optuna:
        yield range(len(plan.chunks))
        return
    from taic_jax.sweep.optuna_study import Study

    study, told = Study(axes, run_dir, config.seed), 0
    chunk = 0
    while True:
        yield range(chunk, len(plan.chunks))
        chunk = len(plan.chunks)
        for row in table[told:]:
            study.tell(plan.trials[row["point"]], row["iqm"])
        told = len(table)
        wanted = min(plan.size, plan.optuna - len(plan.points))
        if wanted <= 0:
            return
        first = len(plan.points)
        trials, points = study.ask(wanted)
        configs_of(config, points)
        plan.trials += trials
        plan.points += points
        plan.chunks += [[first + i for i in group] for group in chunks(points, plan.size)]
        plan.save(run_dir)


def _resumed(plan: Plan, run_dir: Path) -> Plan:
    """Return the plan of the sweep in the folder; if it was killed before it wrote that, the one that is asked for.

    Raises:
      RunFolderError: there is none, or it is of other axes.
    """
    if {path.name for path in run_dir.iterdir()} == {"config.yaml", LOCK}:
        return plan
    try:
        saved = Plan(**json.loads((run_dir / PLAN).read_text()))
    except (OSError, ValueError, TypeError):
        raise RunFolderError(f"{run_dir} holds no sweep to resume: no {PLAN} in it") from None
    for name in ("axes", "samples", "optuna", "pbt"):
        if getattr(saved, name) != getattr(plan, name):
            raise RunFolderError(
                f"{run_dir} was run with other points: --{name} was {getattr(saved, name)}, got {getattr(plan, name)}"
            )
    return saved


def _write_table(path: Path, table: list[dict[str, Any]]) -> None:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(table[0]), lineterminator="\n")
    writer.writeheader()
    for row in sorted(table, key=lambda row: row["point"]):
        writer.writerow({name: f"{x:.5g}" if isinstance(x, float) else x for name, x in row.items()})
    save_text(path, text.getvalue())
