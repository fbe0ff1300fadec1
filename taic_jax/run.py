"""The command line: `python -m taic_jax.run [CONFIG] [--run-dir DIR] [--section.field value ...]`."""

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from taic_jax import command_line
from taic_jax.command_line import FAILED, answer, attempt
from taic_jax.config import ConfigError, impossible
from taic_jax.config.files import differences
from taic_jax.runtime.signals import Signals

PROGRAM = "python -m taic_jax.run"


@dataclass(frozen=True)
class Command(command_line.Command):
    """Collect experience, learn options from it, train a policy that chooses among them, and evaluate."""

    replay: Annotated[Path | None, tyro.conf.arg(metavar="DUMP")] = None
    """Repeat the step at which a seed stopped, from the state that the run saved under dumps, and stop."""
    hosts: int = 1
    """Hosts of one run; each runs this command with the same folder, which the first host writes."""
    host: int = 0
    """Index of this host."""
    coordinator: Annotated[str, tyro.conf.arg(metavar="HOST:PORT")] = ""
    """Address of the first host, with any of its free ports."""


def main(args: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; see docs/trouble.md."""
    return answer(args, PROGRAM, Command, execute)


def _check_hosts(command: Command) -> None:
    hosts, host, last = command.hosts, command.host, command.hosts - 1
    if hosts < 1:
        raise impossible("--hosts", hosts, "at least 1", 1)
    if not 0 <= host <= last:
        raise impossible("--host", host, f"0 to {last}", min(max(host, 0), last))
    if hosts == 1:
        return
    if command.run_dir is None:
        raise ConfigError("--hosts: expected --run-dir DIR too, a folder that every host sees")
    address, _, port = command.coordinator.rpartition(":")
    if not address or not port.isdigit() or not 1 <= int(port) <= 65535:
        expected = "HOST:PORT of the first host, with a port from 1 to 65535"
        raise impossible("--coordinator", repr(command.coordinator), expected)
    if command.shard == "none":
        raise impossible("--shard", "none", "what to split over the hosts, seeds or envs")


def execute(command: Command) -> int:
    """Run the experiment, or only print its configuration and plan; return the exit code."""
    _check_hosts(command)
    if command.replay:
        from taic_jax.handles.replay import replay

        report = replay(command.replay)
        print(report or f"{command.replay}: all numbers were finite this time")
        return 0 if report else FAILED
    from rich.console import Console

    from taic_jax.pipeline import check_run, run_pipeline
    from taic_jax.runtime.devices import open_devices
    from taic_jax.runtime.hosts import ALONE, Hosts
    from taic_jax.runtime.program_cache import keep_programs
    from taic_jax.runtime.run_folder import RunFolder
    from taic_jax.runtime.tracking import follow, tracker_package
    from taic_jax.summary import as_table, plan

    tracker_package(command.track)  # refuses first
    keep_programs()
    hosts = ALONE if command.dry_run else Hosts(command.coordinator, command.hosts, command.host)
    shard = open_devices(command.shard, command.config.seeds, hosts)
    run_dir, config = command.folder, command.config
    begin: dict[str, Any] = {"resume": command.resume, "overwrite": command.overwrite}
    if command.dry_run:
        envs = check_run(config, command.run_dir, **begin)
        print(differences(config) or "{}  # the defaults", plan(config, *envs), sep="\n\n")
        if not command.quiet:
            from taic_jax.handles.calibration import calibrate

            with tempfile.TemporaryDirectory() as folder:
                print(calibrate(config, Path(folder) / "run", shard))
        return 0

    def work(signals: Signals) -> None:
        if command.track != "none":
            RunFolder(run_dir).check(config, **begin)  # before the tracker has a run
        with follow(command.track, RunFolder(run_dir), config, run_dir.resolve().name, resume=command.resume):
            summary, _ = run_pipeline(
                config, run_dir, **begin, quiet=command.quiet, signals=signals,
                checkpoint_seconds=command.checkpoint_seconds, shard=shard,
            )  # fmt: skip
        if not command.quiet:
            Console().print(as_table(summary, config.collect.learner))
            print(f"compare and look at runs:  python -m taic_jax.report {run_dir}")
            print(f"curves (extra viz):        tensorboard --logdir {run_dir}")
        print(RunFolder(run_dir).summary_path)

    return attempt(work, run_dir)


if __name__ == "__main__":
    sys.exit(main())
