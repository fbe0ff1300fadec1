"""Metrics of a run: one row per log point in metrics.jsonl, TensorBoard events, and progress on standard error.

The events are derived from metrics.jsonl: when a run resumes, the rows after the checkpoint are dropped, and the events
written anew.
"""

import contextlib
import io
import json
import shutil
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]
from tensorboardX.record_writer import RecordWriter
from tensorboardX.summary import histogram_raw, scalar

from taic_jax.envs.rendering import Frames, write_film
from taic_jax.runtime.files import json_safe, save_text, writing
from taic_jax.runtime.progress import Display, Work
from taic_jax.runtime.run_folder import Row, RunFolder

Unit = Literal["ticks", "steps"]


class RunLogger:
    """A context manager that writes the metrics of a run and, unless `quiet`, shows its progress.

    A row of metrics.jsonl holds `stage`, `ticks`, `time` (seconds since the epoch), and each metric as `stage/name`: a
    number, or a list with one number per seed, or per seed a list of counts. Numbers that are not finite are null.
    Events hold the mean over seeds, and of counts one histogram. Rows of an earlier process stay, but for an incomplete
    last one.
    """

    def __init__(self, run_dir: Path, *, quiet: bool = False):
        self._folder, self._events_dir = RunFolder(run_dir), run_dir / "tensorboard"
        self._path = self._folder.metrics_path
        with writing(run_dir):
            self._events_dir.mkdir(parents=True, exist_ok=True)
        with writing(self._path):
            if self._path.exists():  # cut the bytes that a killed run left after the last newline
                with self._path.open("rb+") as file:
                    file.truncate(file.read().rfind(b"\n") + 1)
        self._open()
        self._display = Display(quiet)

    def __enter__(self) -> "RunLogger":
        self._display.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._display.stop()
        self._close()

    def doing(self, name: str, total: int = 0, done: int = 0) -> contextlib.AbstractContextManager[None]:
        """Show a stage of `total` ticks or steps, `done` before a resume, or other work, as in `train: compiling`."""
        return self._display.showing(Work(name, total, done, done))

    def say(self, text: str) -> None:
        """Print a line among the progress."""
        self._display.say(text)

    def log(self, stage: str, count: int, metrics: Mapping[str, Any], unit: Unit = "ticks") -> None:
        """Write one row, or raise SaveError.

        Args:
            stage: prefix of each metric's name, as in `stage/name`.
            count: interactions, or gradient steps, so far in this stage, per seed.
            metrics: numbers, or arrays of shape [K] with one number per seed, or [K, L] with the counts of 1..L.
            unit: name of `count` in the row.
        """
        row: Row = {"stage": stage, unit: count, "time": round(time.time(), 3)}
        row |= json_safe({f"{stage}/{name}": value for name, value in metrics.items()})
        with writing(self._path):
            self._file.write(json.dumps(row, allow_nan=False) + "\n")
            self._file.flush()
        self._write_events(row)
        with writing(self._events_dir):
            self._events.flush()
        if work := self._display.work:
            work.done, work.unit, work.result = count, unit, mean_of(row.get(f"{stage}/return"))
            work.seeds = max(len(value) if isinstance(value, list) else 1 for value in row.values())
            self._display.update(work)

    def show(self, name: str, count: int, frames: Frames, dt: float) -> None:
        """Write an event with an animation, which TensorBoard plays; `truncate` drops it, so it belongs at the end."""
        gif, (_, height, width, _) = io.BytesIO(), frames.shape
        write_film(Path("film.gif"), gif, frames, dt)
        image = Summary.Image(height=height, width=width, colorspace=3, encoded_image_string=gif.getvalue())
        self._write_event(Summary(value=[Summary.Value(tag=name, image=image)]), count, time.time())

    def truncate(self, stage: str, count: int) -> None:
        """Drop the rows of a stage after `count`, which a resumed run writes again; -1 drops them all."""
        rows = self._folder.metrics()
        remaining = [row for row in rows if row["stage"] != stage or count_of(row) <= count]
        if len(remaining) == len(rows):
            return
        self._close()
        shutil.rmtree(self._events_dir, ignore_errors=True)
        save_text(self._path, "".join(json.dumps(row) + "\n" for row in remaining))
        self._open()
        for row in remaining:
            self._write_events(row)

    def _open(self) -> None:
        with writing(self._path):
            self._file = self._path.open("a")
        with writing(self._events_dir):
            self._events_dir.mkdir(exist_ok=True)
            # tensorboardX.SummaryWriter writes by a thread that dies silently on a full disk: later rows would wait.
            self._events = RecordWriter(str(self._events_dir / f"events.out.tfevents.{int(time.time())}"))
            self._events.write(Event(wall_time=time.time(), file_version="brain.Event:2").SerializeToString())

    def _close(self) -> None:
        try:
            with writing(self._path):
                self._file.close()
        finally:
            with writing(self._events_dir):
                self._events.close()

    def _write_events(self, row: Row) -> None:
        for name, value in row.items():
            if isinstance(value, list) and value and isinstance(value[0], list):
                summary = _histogram(name, np.nansum(np.array(value, float), axis=0))
            elif "/" in name and (mean := mean_of(value)) is not None:
                summary = scalar(name, mean)
            else:
                continue
            self._write_event(summary, count_of(row), row["time"])

    def _write_event(self, summary: Any, step: int, seconds: float) -> None:
        with writing(self._events_dir):
            self._events.write(Event(wall_time=seconds, step=step, summary=summary).SerializeToString())


def _histogram(name: str, counts: np.ndarray) -> Any:
    """Return the summary of an event from the counts of 1..L."""
    values = np.arange(1, len(counts) + 1)
    total, squares = float(counts @ values), float(counts @ values**2)
    return histogram_raw(
        name, min=0.5, max=len(counts) + 0.5, num=int(counts.sum()), sum=total, sum_squares=squares,
        bucket_limits=(values + 0.5).tolist(), bucket_counts=counts.tolist(),
    )  # fmt: skip


def count_of(row: Row) -> int:
    """Return the ticks, or gradient steps, of a row."""
    return row["ticks"] if "ticks" in row else row["steps"]


def mean_of(value: Any) -> float | None:
    """Return the mean over the finite seeds, or None without any."""
    numbers = [number for number in (value if isinstance(value, list) else [value]) if number is not None]
    return sum(numbers) / len(numbers) if numbers else None
