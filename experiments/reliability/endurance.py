"""Watch the memory and the progress of a run for hours, and stop it as a user would.

python -m taic_jax.experiments.reliability.endurance --hours 2 ant --seeds 10 --run-dir runs/long

Further arguments are those of `python -m taic_jax.run`. A run whose stages end before the time is up ends by itself.
"""

import contextlib
import itertools
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import psutil
import tyro

from taic_jax.runtime.run_folder import RunFolder

POLL = 5.0
SETTLED = 0.2  # Share of a stage's samples in each of the two medians that are compared.


class Sample(NamedTuple):
    """The state of a run: seconds since its start, stage of its last logged row, rows so far, resident MiB."""

    seconds: float
    stage: str
    rows: int
    mib: float


@dataclass(frozen=True)
class Arguments:
    """Watch a run with the config and options that follow, --run-dir among them; exit code 1 if it fails."""

    hours: float = 2.0  # After which it is stopped.


def watch(process: subprocess.Popen, run: RunFolder, seconds: float, poll: float = POLL) -> tuple[list[Sample], int]:
    """Stop a run by SIGTERM after so many seconds, and return its samples and its exit code."""
    samples, begun = [], time.monotonic()
    with process:
        while process.poll() is None:
            time.sleep(poll)
            passed = time.monotonic() - begun
            rows = run.metrics()
            with contextlib.suppress(psutil.Error):  # it has ended
                if size := psutil.Process(process.pid).memory_info().rss:
                    samples.append(Sample(passed, rows[-1]["stage"] if rows else "start", len(rows), size / 2**20))
            if passed > seconds:
                process.terminate()
                break
    return samples, process.returncode


def growth(samples: Sequence[Sample]) -> float:
    """Return the growth of memory, as a share, from the second fifth of a stage's samples to the last; in the first
    fifth JAX compiles, and allocates buffers."""
    part = max(int(len(samples) * SETTLED), 1)
    early, late = samples[part : 2 * part] or samples[:1], samples[-part:]
    return statistics.median(s.mib for s in late) / statistics.median(s.mib for s in early) - 1


def longest_silence(samples: Sequence[Sample]) -> float:
    """Return the most seconds between two rows, or from the last row to the end."""
    added = [after.seconds for before, after in itertools.pairwise(samples) if after.rows != before.rows]
    times = [samples[0].seconds, *added, samples[-1].seconds]
    return max(after - before for before, after in itertools.pairwise(times))


def report(samples: Sequence[Sample], code: int) -> None:
    """Print a line per stage, and one on the whole run."""
    for stage in dict.fromkeys(sample.stage for sample in samples):
        of_stage = [sample for sample in samples if sample.stage == stage]
        first, last = of_stage[0], of_stage[-1]
        memory = f"{last.mib:8.0f} MiB, grown by {growth(of_stage):+.1%}; silent for {longest_silence(of_stage):.0f} s"
        print(f"{stage:10} {(last.seconds - first.seconds) / 60:6.1f} min {last.rows - first.rows:6} rows {memory}")
    print(f"{samples[-1].seconds / 3600:.2f} h, exit code {code}, at most {max(s.mib for s in samples):.0f} MiB")


def main(args: Sequence[str] | None = None) -> int:
    """Watch a run and report; return 1 unless it ended by itself or by our signal."""
    arguments, run = tyro.cli(Arguments, args=args, return_unknown_args=True)
    if "--run-dir" not in run[:-1]:
        print("endurance: expected --run-dir DIR among the options of the run", file=sys.stderr)
        return 2
    folder = RunFolder(Path(run[run.index("--run-dir") + 1]))
    process = subprocess.Popen([sys.executable, "-m", "taic_jax.run", *run], stdout=subprocess.DEVNULL)
    samples, code = watch(process, folder, arguments.hours * 3600)
    if samples:
        report(samples, code)
    return 0 if code in (0, 75) else 1


if __name__ == "__main__":
    sys.exit(main())
