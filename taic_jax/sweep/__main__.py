"""Sweeps: `python -m taic_jax.sweep CONFIG --axes FIELD=V1,V2 ... [--samples N | --optuna N]`.

Points that differ in numbers alone run with all their seeds in one program; what is static splits them into several.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

from taic_jax import command_line
from taic_jax.command_line import answer, attempt
from taic_jax.config import ConfigError
from taic_jax.sweep.axes import Axis, chunks, configs_of, grid, parse_axis, sample

PROGRAM = "python -m taic_jax.sweep"


@dataclass(frozen=True)
class Command(command_line.Command):
    """Run a grid, random points, or points that Optuna asks for, each with all seeds; write a table and the best."""

    axes: tuple[str, ...] = ()
    """FIELD=V1,V2,... for a grid; FIELD=LOW..HIGH or FIELD=LOW..HIGH:log to draw from."""
    samples: int = 0
    """Random points to draw instead of the grid."""
    optuna: int = 0
    """Points that Optuna (extra sweep) asks for, a chunk at a time."""
    memory: int = 0
    """MiB that a chunk of points may take; 0 takes half of what the machine has."""
    chunk: int = 0
    """Points to run in one program at most; 0 takes as many as the memory holds."""


def main(args: Sequence[str] | None = None) -> int:
    """Run one sweep and return its exit code."""
    return answer(args, PROGRAM, Command, execute)


def execute(command: Command) -> int:
    """Sweep, or only print the plan; return the exit code."""
    axes = _check(command)
    if command.optuna:
        points = []
    else:
        points = sample(axes, command.samples, command.config.seed) if command.samples else grid(axes)
        configs_of(command.config, points)
    from taic_jax.compilation import keep_programs
    from taic_jax.sweep.memory import points_that_fit
    from taic_jax.sweep.runs import TABLE, Plan, run_sweep

    keep_programs()
    # A sweep that is resumed keeps the chunks that it had: there is nothing to measure.
    size = command.chunk or (1 if command.resume else points_that_fit(command.config, command.memory))
    plan = Plan(list(command.axes), command.samples, command.optuna, size, points, chunks(points, size))
    if command.dry_run:
        print(plan.tell(command.config))
        return 0
    run_dir = command.folder
    code = attempt(
        lambda signals: run_sweep(
            command.config, axes, plan, run_dir, resume=command.resume, overwrite=command.overwrite,
            signals=signals, checkpoint_seconds=command.checkpoint_seconds, shard=command.shard,
        ),
        run_dir,
    )  # fmt: skip
    if not code:
        print(run_dir / TABLE)
    return code


def _check(command: Command) -> list[Axis]:
    """Return the axes.

    Raises:
      ConfigError: one is not valid, or stands twice, or there is none; or two strategies are asked for.
    """
    if not command.axes:
        raise ConfigError("--axes: expected at least one FIELD=VALUES, such as train.ppo.learning_rate=1e-4,1e-3")
    axes = [parse_axis(text) for text in command.axes]
    names = [axis.name for axis in axes]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"--axes: {name} stands twice")
    if command.samples and command.optuna:
        raise ConfigError("--samples and --optuna: expected at most one of the two")
    for name in ("samples", "optuna", "memory", "chunk"):
        if getattr(command, name) < 0:
            raise ConfigError(f"--{name}: expected at least 0, got {getattr(command, name)}")
    return axes


if __name__ == "__main__":
    sys.exit(main())
