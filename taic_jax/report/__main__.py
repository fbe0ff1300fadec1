"""A page about runs: `python -m taic_jax.report RUNS... [--out report.html]`; see docs/report.md."""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from taic_jax.command_line import tell, typed
from taic_jax.config import ConfigError

PROGRAM = "python -m taic_jax.report"


@dataclass(frozen=True)
class Command:
    """Write one self-contained HTML page with the results, curves, option spaces, videos and configs of runs."""

    runs: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RUNS")] = ()
    """Folders of runs or sweeps, finished or not."""
    out: Path = Path("report.html")
    """The page to write; another report there is replaced."""
    points: int = 300
    """Points of a curve at most; the page tells where iterations are left out."""
    options: int = 1000
    """Options in the picture of an option space; 0 leaves these pictures out."""
    no_videos: tyro.conf.FlagCreatePairsOff[bool] = False
    """Leave the videos out, which are most of the page's size."""


def main(args: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0, or 2 for a mistake in the arguments."""
    return tell(lambda: execute(typed(sys.argv[1:] if args is None else args, PROGRAM, Command)))


def execute(command: Command) -> int:
    """Write the page and print its path, or raise ConfigError for an invalid argument."""
    if not command.runs:
        raise ConfigError("RUNS: expected at least one folder of a run, got none")
    for name, value, least in (("points", command.points, 2), ("options", command.options, 0)):
        if value < least:
            raise ConfigError(f"--{name}: expected at least {least}, got {value}")
    from taic_jax.report.page import Detail, write_report

    write_report(command.runs, command.out, Detail(command.points, command.options, not command.no_videos))
    print(command.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
