"""What a run is doing, on standard error: a bar on a terminal, a line every 10 seconds in a log file."""

import sys
import threading
import time
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

INTERVAL = 10.0
"""Seconds between two lines."""


@dataclass
class Work:
    """What is under way.

    Attributes:
      name: of the stage, and what it does where it does not train, as in `train: compiling`.
      total: ticks or gradient steps per seed in all; 0 where nothing can be counted.
      done: how many were made; `first` of them before a resume.
      unit: what they are.
      seeds: how many make them side by side.
      result: mean return, or nothing yet.
    """

    name: str
    total: int = 0
    first: int = 0
    done: int = 0
    unit: str = "ticks"
    seeds: int = 1
    result: float | None = None

    def __post_init__(self):
        self.began = time.monotonic()

    @property
    def rate(self) -> float:
        """Ticks or steps a second, over all seeds."""
        return self.seeds * (self.done - self.first) / max(time.monotonic() - self.began, 1e-9)

    def measures(self) -> list[str]:
        """Say how it goes: return and speed, as far as there are any."""
        texts = [] if self.result is None else [f"return {self.result:,.1f}"]
        return texts + ([f"{self.rate:,.0f} {self.unit}/s"] if self.done > self.first else [])

    def line(self) -> str:
        """Say all of it in one line."""
        seconds = time.monotonic() - self.began
        if not self.total:
            return f"{self.name}, {seconds:.0f} s" if seconds >= 1 else self.name
        texts = [f"{self.name}: {self.done / self.total:.0%} of {self.total:,} {self.unit}", *self.measures()]
        if self.first < self.done < self.total:
            texts.append(f"{_duration(self.seeds * (self.total - self.done) / self.rate)} left")
        return ", ".join(texts)


class Display:
    """Shows nothing; those below show it somewhere."""

    def start(self) -> None:
        """Begin to show."""

    def show(self, work: Work | None) -> None:
        """Show this work from now on, or how far it has come; None is a pause between two."""

    def say(self, text: str) -> None:
        """Write a line that stays."""

    def stop(self) -> None:
        """Show nothing more."""


class Bar(Display):
    """A bar for each stage, redrawn in place, and below it one that moves while something else is done."""

    def __init__(self, console: Console):
        self._progress = Progress(
            TextColumn("{task.description:>20}"),
            BarColumn(bar_width=24),
            TextColumn("{task.fields[text]}"),
            TimeRemainingColumn(),
            console=console,
        )
        self._work: Work | None = None
        self._task: TaskID | None = None

    def start(self) -> None:
        """Begin to draw."""
        self._progress.start()

    def show(self, work: Work | None) -> None:
        """Draw the bar of this work; that of a finished stage stays, any other goes."""
        if work is not self._work:
            self._leave()
            self._work = work
            if work:
                self._task = self._progress.add_task(work.name, total=work.total or None, text="")
        if work and self._task is not None and work.total:
            text = f"{work.done:,}/{work.total:,}  " + "  ".join(work.measures())
            self._progress.update(self._task, completed=work.done, text=text)

    def say(self, text: str) -> None:
        """Write a line above the bars."""
        self._progress.console.print(f"taic_jax: {text}", highlight=False)

    def stop(self) -> None:
        """Leave what is drawn as it is."""
        self._leave()
        self._progress.stop()

    def _leave(self) -> None:
        if self._work and self._task is not None:
            self._progress.stop_task(self._task)
            if not self._work.total:
                self._progress.remove_task(self._task)
        self._work = self._task = None


class Lines(Display):
    """A line where work without a measure first begins, every `INTERVAL` seconds, and at the end of each stage."""

    def __init__(self) -> None:
        self._begun: set[str] = set()
        self._work: Work | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._repeat, daemon=True)

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    def show(self, work: Work | None) -> None:
        """Take this work for the lines to come."""
        if work is not self._work:
            if self._work and self._work.total:
                self.say(self._work.line())
            if work and not work.total and work.name not in self._begun:
                self._begun.add(work.name)
                self.say(work.line())
        self._work = work

    def say(self, text: str) -> None:
        """Write a line."""
        print(f"taic_jax: {text}", file=sys.stderr, flush=True)

    def stop(self) -> None:
        """Write no more lines."""
        self._ended.set()
        self._thread.join()

    def _repeat(self) -> None:
        while not self._ended.wait(INTERVAL):
            if work := self._work:
                self.say(work.line())


def make_display(quiet: bool) -> Display:
    """Return what suits standard error: a terminal, or a file."""
    console = Console(stderr=True)
    if quiet:
        return Display()
    return Bar(console) if console.is_terminal else Lines()


def _duration(seconds: float) -> str:
    """Return a duration in words; tenths of minutes and hours where those are few."""
    for unit, size in (("h", 3600), ("min", 60)):
        if seconds >= 1.5 * size:
            return f"{seconds / size:.1f} {unit}"
    return f"{seconds:.0f} s"
