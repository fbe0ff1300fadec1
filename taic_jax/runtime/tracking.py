"""A run's rows of metrics.jsonl on Weights & Biases or Trackio: means over seeds, and each seed by itself.

One tracker's run holds all seeds, since Trackio opens one run at a time: a run per seed could only follow afterwards.
"""

import contextlib
import importlib
import json
import os
import sys
import threading
import time
import uuid
from collections.abc import Iterator
from typing import Any

import numpy as np

from taic_jax.config import Config, ConfigError, Track, walk
from taic_jax.envs.errors import MissingExtraError
from taic_jax.runtime.files import save_json, writes_here
from taic_jax.runtime.logging import count_of, mean_of
from taic_jax.runtime.run_folder import Row, RunFolder

INTERVAL = 10.0  # seconds between two looks for new rows


def tracker_package(track: Track) -> Any:
    """Import a tracker, logged in if it needs that, or raise MissingExtraError or ConfigError."""
    try:
        package: Any = None if track == "none" else importlib.import_module(track)
        _ = track == "wandb" and package.login()
    except ImportError:
        raise MissingExtraError(track, track) from None
    except Exception as error:
        raise ConfigError(f"--track {track}: {error}") from None
    return package


@contextlib.contextmanager
def follow(
    track: Track, folder: RunFolder, config: Config, name: str, part: slice = slice(None), *, resume: bool = True
) -> Iterator[None]:
    """Send the rows of a run's folder as they are written in the context, each once, and at the end the returns.

    `name` is the tracker's run, `part` the rows of one point of a sweep; `resume` goes on with the same tracker's run.
    """
    package = tracker_package(track) if writes_here() else None
    if package is None:
        yield
        return
    path, since, ended = folder.path / f"{track}-{name}.json", 0.0 if resume else time.time(), threading.Event()
    try:
        saved = json.loads(path.read_text()) if resume and path.is_file() else {}
        state = {"id": uuid.uuid4().hex[:8], "sent": {}} | saved
        same = {"resume": "allow"} | ({"id": state["id"]} if track == "wandb" else {})  # Trackio's key is the name
        with contextlib.redirect_stdout(sys.stderr):
            project, name = os.environ.get("WANDB_PROJECT", "taic_jax"), f"{name} {state['id']}"
            run = package.init(project=project, name=name, config=dict(walk(config)), **same)
    except Exception as error:
        raise ConfigError(f"--track {track}: {error}") from None

    def send_new() -> None:
        waiting = True
        while waiting:
            waiting = not ended.wait(INTERVAL)
            rows = [row for row in folder.metrics() if row["time"] >= since]
            for row in rows:
                series, count = list(row)[-1], count_of(row)  # of the stage, or of the method that is evaluated
                if count > state["sent"].get(series, -1):
                    _send(package, run, row["stage"], count, row, part)
                    state["sent"][series] = count
            if rows:
                save_json(path, state)

    thread = threading.Thread(target=send_new, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        if folder.finished:
            methods, modes = folder.summary()["methods"].items(), ("return", "return_mean_option")
            returns = {f"summary/{x}/{mode}": y[mode]["per_seed"] for x, y in methods for mode in modes}
            _send(package, run, "summary", 0, returns, part)
        with contextlib.redirect_stdout(sys.stderr):
            run.finish()


def _send(package: Any, run: Any, stage: str, count: int, row: Row, part: slice) -> None:
    values: Row = {}
    for name, value in row.items():
        seeds = value[part] if isinstance(value, list) else [value]
        if "/" in name and isinstance(seeds[0], list):
            counts = np.nansum(np.array(seeds, float), axis=0)
            values[name] = package.Histogram(np_histogram=(counts, np.arange(len(counts) + 1) + 0.5))
        elif "/" in name:
            values |= {f"{name}/seed{k}": x for k, x in enumerate(seeds) if len(seeds) > 1} | {name: mean_of(seeds)}
    values = {name: value for name, value in values.items() if value is not None}
    if package.__name__ == "wandb":  # its own steps only grow, and stages count anew
        run.define_metric(f"{stage}/*", step_metric=f"{stage}/count")
        run.log(values | {f"{stage}/count": count})
    else:
        run.log(values, step=count)
