"""The command line: `python -m taic_jax.run [CONFIG] [--run-dir DIR] [--section.field value ...]`."""

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from taic_jax import command_line
from taic_jax.command_line import FAILED, answer, attempt
from taic_jax.config import ConfigError
from taic_jax.config_io import to_yaml

PROGRAM = "python -m taic_jax.run"


@dataclass(frozen=True)
class Command(command_line.Command):
    """Collect experience, learn options from it, train a policy that chooses among them, and evaluate."""

    replay: Annotated[Path | None, tyro.conf.arg(metavar="DUMP")] = None
    """Take the step again at which a seed stopped, from the state that the run left under dumps, and stop."""
    hosts: int = 1
    """Hosts of one run; each runs this command, all with the same folder, which the first writes."""
    host: int = 0
    """Which of the hosts this is."""
    coordinator: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")] = ""
    """Where the other hosts reach the first one: any free port of it."""


def main(args: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; see docs/trouble.md."""
    return answer(args, PROGRAM, Command, execute)


def parse(args: Sequence[str]) -> Command:
    """Parse and check the arguments.

    Raises:
      ConfigError: an argument, the named preset or file, or a value is not valid.
    """
    command = command_line.parse(args, PROGRAM, Command)
    if command.hosts < 1:
        raise ConfigError(f"--hosts: expected at least 1, got {command.hosts}")
    if not 0 <= command.host < command.hosts:
        raise ConfigError(f"--host: expected 0 to {command.hosts - 1}, got {command.host}")
    if command.hosts > 1 and command.run_dir is None:
        raise ConfigError("--hosts: expected --run-dir DIR too, a folder that every host sees")
    if command.hosts > 1 and not re.fullmatch(r".+:\d{1,5}", command.coordinator):
        raise ConfigError(f"--coordinator: expected HOST:PORT of the first host, got {command.coordinator!r}")
    return command


def execute(command: Command) -> int:
    """Run the experiment, or only print its configuration and plan; return the exit code."""
    if command.replay:
        from taic_jax.replay import replay

        found = replay(command.replay)
        print(found or f"{command.replay}: all numbers were finite this time")
        return 0 if found else FAILED
    from taic_jax.compilation import keep_programs
    from taic_jax.devices import Hosts, open_devices
    from taic_jax.pipeline import make_envs, run_pipeline
    from taic_jax.summary import plan

    if command.dry_run:
        print(to_yaml(command.config))
        print(plan(command.config, *make_envs(command.config)))
        return 0
    keep_programs()
    hosts = Hosts(command.coordinator, command.hosts, command.host)
    shard = open_devices(command.shard, command.config.seeds, hosts)
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
