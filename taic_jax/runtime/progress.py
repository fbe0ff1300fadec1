"""Progress of a run on standard error: a bar on a terminal, a line every 10 seconds in a log file."""

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

INTERVAL = 10.0  # seconds between two lines


@dataclass
class Work:
    """One piece of work and its progress."""

    name: str  # the stage, and its activity if that is not training, as in `train: compiling`
    total: int = 0  # ticks or gradient steps per seed in all; 0 without a measure
    first: int = 0  # units before a resume
    done: int = 0  # units so far
    unit: str = "ticks"
    seeds: int = 1  # side by side
    result: float | None = None  # mean return

    def __post_init__(self):
        self.began = time.monotonic()

    @property
    def rate(self) -> float:
        """Ticks or steps a second, over all seeds."""
        return self.seeds * (self.done - self.first) / max(time.monotonic() - self.began, 1e-9)

    def measures(self) -> list[str]:
        """Return the return and the speed in words, as far as there are any."""
        texts = [] if self.result is None else [f"return {self.result:,.1f}"]
        return texts + ([f"{self.rate:,.0f} {self.unit}/s"] if self.done > self.first else [])

    def line(self) -> str:
        """Return the whole progress in one line."""
        seconds = time.monotonic() - self.began
        if not self.total:
            return f"{self.name}, {seconds:.0f} s" if seconds >= 1 else self.name
        texts = [f"{self.name}: {self.done / self.total:.0%} of {self.total:,} {self.unit}", *self.measures()]
        if self.first < self.done < self.total:
            texts.append(f"{_duration(self.seeds * (self.total - self.done) / self.rate)} left")
        return ", ".join(texts)


class Display:
    """A bar on a terminal for each stage, redrawn in place, and one below that moves during other work.

    A file gets a line at the first beginning of each work without a measure, every `INTERVAL` seconds, and at the end
    of each stage. A `quiet` display shows nothing.
    """

    def __init__(self, quiet: bool):
        self._console = Console(stderr=True, quiet=quiet)
        columns = TextColumn("{task.description:>20}"), BarColumn(bar_width=24), TextColumn("{task.fields[text]}")
        hidden = quiet or not self._console.is_terminal
        self._progress = Progress(*columns, TimeRemainingColumn(), console=self._console, disable=hidden)
        self._task: TaskID
        self.work: Work | None = None
        self._begun: set[str] = set()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._repeat, daemon=True)

    def start(self) -> None:
        """Begin to show."""
        self._progress.start()
        self._thread.start()

    def stop(self) -> None:
        """Leave the bars in place, and write no more lines."""
        self._progress.stop()
        self._ended.set()
        self._thread.join()

    @contextlib.contextmanager
    def showing(self, work: Work) -> Iterator[None]:
        """Show this work in the context; the bar of a stage stays behind, any other goes."""
        task = self._task = self._progress.add_task(work.name, total=work.total or None, text="")
        self.update(work)
        if not work.total and work.name not in self._begun:
            self._begun.add(work.name)
            self._write(work)
        self.work = work
        try:
            yield
        finally:
            self.work = None
            self._progress.stop_task(task)
            if work.total:
                self._write(work)
            else:
                self._progress.remove_task(task)

    def update(self, work: Work) -> None:
        """Draw the progress of this work."""
        if work.total:
            text = f"{work.done:,}/{work.total:,}  " + "  ".join(work.measures())
            self._progress.update(self._task, completed=work.done, text=text)

    def say(self, text: str) -> None:
        """Write a line that stays, above the bars."""
        self._console.print(f"taic_jax: {text}", highlight=False, markup=False, emoji=False, soft_wrap=True)

    def _write(self, work: Work) -> None:
        if self._progress.disable:
            self.say(work.line())

    def _repeat(self) -> None:
        while not self._ended.wait(INTERVAL):
            if work := self.work:
                self._write(work)


def _duration(seconds: float) -> str:
    """Return a duration in words, in seconds, or tenths of minutes or hours."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"
