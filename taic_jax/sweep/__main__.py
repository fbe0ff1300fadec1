"""Sweeps: `python -m taic_jax.sweep CONFIG --axes FIELD=V1,V2 ... [--samples N | --optuna N]`.

Points that differ in numbers alone run with all their seeds in one program; static fields split them into several.
"""

import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from taic_jax import command_line
from taic_jax.command_line import answer, attempt
from taic_jax.config import ConfigError
from taic_jax.sweep.axes import Axis, chunks, configs_of, grid, is_leaf, parse_axis, sample

PROGRAM, EXAMPLE = "python -m taic_jax.sweep", "train.ppo.learning_rate"


@dataclass(frozen=True)
class Command(command_line.Command):
    """Run a grid, random points, or points that Optuna asks for, each with all seeds; write a table and the best."""

    axes: tuple[str, ...] = ()
    """FIELD=V1,V2,... for a grid; FIELD=LOW..HIGH or FIELD=LOW..HIGH:log to draw from."""
    samples: int = 0
    """Random points to draw instead of the grid."""
    optuna: int = 0
    """Points that Optuna (extra sweep) asks for, a chunk at a time."""
    pbt: int = 0
    """Iterations of stage train after which, again and again, the worst points take over from the best (0: never)."""
    cluster: str = ""
    """HOST:PORT of a Ray cluster (extra cluster) whose nodes share this folder, or local; runs a chunk on each node."""
    memory: int = 0
    """MiB that a chunk of points may take; 0 takes half of what the machine has."""
    chunk: int = 0
    """Points to run in one program at most; 0 takes as many as the memory holds."""


def main(args: Sequence[str] | None = None) -> int:
    """Run one sweep and return its exit code."""
    return answer(args, PROGRAM, Command, execute)


def execute(command: Command) -> int:
    """Sweep, or only print the plan; return the exit code."""
    config, axes, points = command.config, _check(command), []
    if command.cluster and not command.dry_run:
        from taic_jax.sweep.ray_tasks import connect

        connect(command.cluster)
    if command.optuna:
        importlib.import_module("taic_jax.sweep.optuna_study")  # fails without Optuna, before a folder is made
    else:
        points = sample(axes, command.samples, config.seed) if command.samples else grid(axes)
        configs_of(config, points)
    from taic_jax.pipeline import check_run
    from taic_jax.runtime.devices import open_devices
    from taic_jax.runtime.program_cache import keep_programs
    from taic_jax.runtime.tracking import tracker_package
    from taic_jax.sweep.memory import points_that_fit
    from taic_jax.sweep.runs import TABLE, Plan, run_sweep, sweep_config

    tracker_package(command.track)  # refuses first
    keep_programs()
    shard = "none" if command.pbt and command.shard == "auto" else command.shard
    shard = open_devices(shard, config.seeds * (len(points) or command.optuna))
    check_run(sweep_config(config), command.run_dir, resume=command.resume, overwrite=command.overwrite)
    # A resumed sweep has its chunks: nothing needs a measurement.
    size = command.chunk or (1 if command.resume else points_that_fit(config, command.memory))
    if command.pbt and not command.resume and size < len(points):
        raise ConfigError(f"--pbt: expected its {len(points)} points to run in one program, got at most {size} at once")
    groups = chunks(points, size)
    plan = Plan(list(command.axes), command.samples, command.optuna, size, points, groups, pbt=command.pbt)
    if command.dry_run:
        print(plan.describe(config))
        return 0
    run_dir = command.folder
    code = attempt(
        lambda signals: run_sweep(
            config, axes, plan, run_dir, resume=command.resume, overwrite=command.overwrite,
            on_cluster=bool(command.cluster), quiet=command.quiet, shard=shard, signals=signals,
            checkpoint_seconds=command.checkpoint_seconds, track=command.track,
        ),
        run_dir,
    )  # fmt: skip
    if not code:
        print(run_dir / TABLE)
    return code


def _check(command: Command) -> list[Axis]:
    """Return the axes; refuse none, duplicates, two strategies, and anything that population-based training bars."""
    if not command.axes:
        raise ConfigError(f"--axes: expected at least one FIELD=VALUES, such as {EXAMPLE}=1e-4,1e-3")
    axes = [parse_axis(text) for text in command.axes]
    names = [axis.name for axis in axes]
    if doubled := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"--axes: {doubled[0]} stands twice")
    if command.samples and command.optuna:
        raise ConfigError("--samples and --optuna: expected at most one of the two")
    for name in ("samples", "optuna", "pbt", "memory", "chunk"):
        if getattr(command, name) < 0:
            raise ConfigError(f"--{name}: expected at least 0, got {getattr(command, name)}")
    if command.pbt:
        _check_population(command, names)
    return axes


def _check_population(command: Command, names: list[str]) -> None:
    """Refuse axes whose points cannot copy each other's policies, and options that split points over programs."""
    for name in names:
        if not (is_leaf(name) and name.startswith("train.")):
            raise ConfigError(f"--pbt: {name}: expected numbers of stage train that one program can vary, as {EXAMPLE}")
    if command.optuna or command.shard == "seeds":
        other = "--optuna" if command.optuna else "--shard seeds"
        raise ConfigError(f"--pbt and {other}: expected at most one of the two; points are compared in one program")


if __name__ == "__main__":
    sys.exit(main())
