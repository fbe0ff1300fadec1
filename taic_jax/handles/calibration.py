"""The time and memory of runs, by the first steps of each stage."""

from pathlib import Path
from typing import NamedTuple

import jax
import psutil

from taic_jax.artifacts.experience import experience_bytes
from taic_jax.config import PRACTISE, Config, ConfigError, Shard, experience_ticks, needs_collect, replace, settings_of
from taic_jax.options.dataset import HELD_OUT_EVERY, STRETCH
from taic_jax.pipeline import run_pipeline
from taic_jax.runtime.logging import count_of
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.runtime.signals import DivergedError
from taic_jax.sources import make_envs

STEPS = 4


class Cost(NamedTuple):
    """Seconds of all steps of a run, those that its programs took to compile, and its memory in MiB."""

    seconds: float
    compilation: float
    memory: float

    def __str__(self) -> str:
        more = f"in addition evaluation, and compilation, which took {self.compilation:.0f} s"
        time = f"{'time':8} about {self.seconds / 60:.2g} minutes here, by {STEPS} steps of each stage; {more}"
        return f"{time}\n{'peak':8} about {self.memory:,.0f} MiB"


def calibrate(config: Config, folder: Path, shard: Shard = "none") -> Cost:
    """Take the first steps of every stage in a new folder, and extrapolate; raise as `pipeline.run_pipeline`."""
    early = replace(config, "evaluate.video_ticks", 0)
    for name, value in (("since", 0.0), ("until", 1.0), ("fraction", 1.0)):  # the first steps hold few windows
        early = replace(early, f"options.{name}", value)
    window = STRETCH * HELD_OUT_EVERY * config.options.length  # ticks of which some are held out
    most = max(STEPS, -(-window // settings_of(config.collect).rollout_length))
    try:
        summary = run_pipeline(early, folder, quiet=True, shard=shard, most=most).summary
    except DivergedError as error:
        raise ConfigError(str(error)) from None
    collect, train, seconds = config.collect.ticks, config.train.ticks, 0.0
    sizes = {"collect": collect, "learn": config.options.steps, "total": collect + train}
    sizes[PRACTISE] = config.practise.ticks
    metrics = RunFolder(folder).metrics
    for stage in {row["stage"] for row in metrics()} - {"evaluate"}:
        rows = metrics(stage)
        steps = sizes.get(stage, train) // count_of(rows[0])  # the first row counts one step
        seconds += steps * (rows[-1]["time"] - rows[0]["time"]) / max(len(rows) - 1, 1)
    ticks = experience_ticks(config.collect) if needs_collect(config) and not config.options.source else 0
    experience = 2 * experience_bytes(make_envs(config)[1], ticks) * config.seeds
    on_device = jax.local_devices()[0].memory_stats()  # None on a CPU
    used = on_device["peak_bytes_in_use"] if on_device else psutil.Process().memory_info().rss
    return Cost(seconds, summary["seconds"]["compile"], (used + experience) / 2**20)
