"""The command line: `python -m taic_jax.run [CONFIG] [--run-dir DIR] [--section.field value ...]`."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from taic_jax import command_line
from taic_jax.command_line import FAILED, answer, attempt
from taic_jax.config_io import to_yaml

PROGRAM = "python -m taic_jax.run"


@dataclass(frozen=True)
class Command(command_line.Command):
    """Collect experience, learn options from it, train a policy that chooses among them, and evaluate."""

    replay: Annotated[Path | None, tyro.conf.arg(metavar="DUMP")] = None
    """Take the step again at which a seed stopped, from the state that the run left under dumps, and stop."""


def main(args: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; see docs/trouble.md."""
    return answer(args, PROGRAM, Command, execute)


def parse(args: Sequence[str]) -> Command:
    """Parse and check the arguments.

    Raises:
      ConfigError: an argument, the named preset or file, or a value is not valid.
    """
    return command_line.parse(args, PROGRAM, Command)


def execute(command: Command) -> int:
    """Run the experiment, or only print its configuration and plan; return the exit code."""
    if command.replay:
        from taic_jax.replay import replay

        found = replay(command.replay)
        print(found or f"{command.replay}: all numbers were finite this time")
        return 0 if found else FAILED
    from taic_jax.compilation import keep_programs
    from taic_jax.devices import open_devices
    from taic_jax.pipeline import make_envs, run_pipeline
    from taic_jax.summary import plan

    if command.dry_run:
        print(to_yaml(command.config))
        print(plan(command.config, *make_envs(command.config)))
        return 0
    keep_programs()
    shard = open_devices(command.shard, command.config.seeds)
    run_dir = command.folder
    code = attempt(
        lambda signals: run_pipeline(
            command.config, run_dir, resume=command.resume, overwrite=command.overwrite,
            signals=signals, checkpoint_seconds=command.checkpoint_seconds, shard=shard,
        ),
        run_dir,
    )  # fmt: skip
    if not code:
        print(run_dir / "summary.json")
    return code


if __name__ == "__main__":
    sys.exit(main())
