"""Leave a run alone for hours, watch its memory and whether it goes on, and stop it as a user would.

python -m taic_jax.experiments.endurance --hours 2 ant --seeds 10 --run-dir runs/long

What follows the options is for `python -m taic_jax.run`. A run whose stages end before the time is up ends by itself.
"""

import itertools
import json
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import tyro

POLL = 5.0
SETTLED = 0.2
"""Share of a stage, at its start and at its end, whose medians are compared."""


class Sample(NamedTuple):
    """What a run was at: seconds since its start, stage of its last logged row, rows so far, resident MiB."""

    seconds: float
    stage: str
    rows: int
    mib: float


@dataclass(frozen=True)
class Arguments:
    """Watch a run, whose config and options follow, --run-dir among them; exit code 1 if it failed."""

    hours: float = 2.0
    """After which it is told to stop."""


class Tail:
    """The rows of a growing metrics.jsonl, each read once."""

    def __init__(self, path: Path):
        self._path, self._offset, self.rows, self.stage = path, 0, 0, "start"

    def read(self) -> None:
        """Take in the rows that were added."""
        if not self._path.is_file():
            return
        with self._path.open("rb") as file:
            file.seek(self._offset)
            lines = [line for line in file if line.endswith(b"\n")]
        self._offset += sum(map(len, lines))
        self.rows += len(lines)
        if lines:
            self.stage = json.loads(lines[-1])["stage"]


def resident_mib(process: int) -> float:
    """Return the resident memory of a process; 0 if it has ended."""
    told = subprocess.run(["ps", "-o", "rss=", "-p", str(process)], capture_output=True, text=True, check=False)
    return int(told.stdout or 0) / 1024


def watch(command: Sequence[str], metrics: Path, seconds: float, poll: float = POLL) -> tuple[list[Sample], int]:
    """Run a command, stop it by SIGTERM after so many seconds, and return what was seen and its exit code."""
    samples, tail, begun = [], Tail(metrics), time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            time.sleep(poll)
            tail.read()
            passed = time.monotonic() - begun
            if mib := resident_mib(process.pid):
                samples.append(Sample(passed, tail.stage, tail.rows, mib))
            if passed > seconds:
                process.send_signal(signal.SIGTERM)
                break
    return samples, process.returncode


def growth(samples: Sequence[Sample]) -> float:
    """Return by what share memory is greater in the last fifth of the samples of a stage than in the second.

    In the first fifth it is compiled, and buffers are made.
    """
    part = max(int(len(samples) * SETTLED), 1)
    early, late = samples[part : 2 * part] or samples[:1], samples[-part:]
    return statistics.median(s.mib for s in late) / statistics.median(s.mib for s in early) - 1


def longest_silence(samples: Sequence[Sample]) -> float:
    """Return the most seconds in which no row was added, after the first was."""
    times = [samples[0].seconds]
    times += [after.seconds for before, after in itertools.pairwise(samples) if after.rows != before.rows]
    gaps = zip(times, [*times[1:], samples[-1].seconds], strict=True)
    return max(after - before for before, after in gaps)


def report(samples: Sequence[Sample], code: int) -> None:
    """Print a line a stage, and one on the whole."""
    for stage in dict.fromkeys(sample.stage for sample in samples):
        of_stage = [sample for sample in samples if sample.stage == stage]
        minutes = (of_stage[-1].seconds - of_stage[0].seconds) / 60
        rows = of_stage[-1].rows - of_stage[0].rows
        silent = longest_silence(of_stage)
        memory = f"{of_stage[-1].mib:8.0f} MiB, grown by {growth(of_stage):+.1%}"
        print(f"{stage:10} {minutes:6.1f} min {rows:6} rows {memory}; silent for {silent:.0f} s")
    print(f"{samples[-1].seconds / 3600:.2f} h, exit code {code}, at most {max(s.mib for s in samples):.0f} MiB")


def main(args: Sequence[str] | None = None) -> int:
    """Watch a run and report; return 1 unless it ended by itself or was stopped in time."""
    arguments, run = tyro.cli(Arguments, args=args, return_unknown_args=True)
    if "--run-dir" not in run[:-1]:
        print("endurance: expected --run-dir DIR among the options of the run", file=sys.stderr)
        return 2
    folder = Path(run[run.index("--run-dir") + 1])
    samples, code = watch(
        [sys.executable, "-m", "taic_jax.run", *run], folder / "metrics.jsonl", arguments.hours * 3600
    )
    if samples:
        report(samples, code)
    return 0 if code in (0, 75) else 1


if __name__ == "__main__":
    sys.exit(main())
