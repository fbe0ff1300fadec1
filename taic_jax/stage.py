"""What every stage of the main job is driven by: compile once, step, log, checkpoint, resume."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import jax

from taic_jax.checkpoint import Checkpoints
from taic_jax.config import Config
from taic_jax.logging import RunLogger

S = TypeVar("S")
STAGES = ("collect", "learn", "train", "flat", "evaluate", "video", "repeat", "total", "transfer")
CHECKPOINT_SECONDS = 30.0
CLOCK = "clock.json"


@dataclass
class Clock:
    """Seconds spent compiling and running, and the ticks run in that time."""

    compile: float = 0.0
    run: float = 0.0
    ticks: int = 0

    def save(self, path: Path) -> None:
        """Write to a JSON file, so that a resumed run counts on."""
        path.write_text(json.dumps(asdict(self)) + "\n")

    @classmethod
    def load(cls, path: Path) -> "Clock":
        """Read what `save` wrote; without a file, start at zero."""
        return cls(**json.loads(path.read_text())) if path.exists() else cls()


@dataclass(frozen=True)
class Run:
    """What every stage needs: the config with array leaves, one key per seed, where to write."""

    config: Config
    keys: jax.Array
    dir: Path
    logger: RunLogger
    clock: Clock

    def stage_keys(self, stage: str) -> jax.Array:
        """Return the seeds' keys [K] of one stage; a seed's key does not depend on the number of seeds."""
        return jax.vmap(partial(jax.random.fold_in, data=STAGES.index(stage)))(self.keys)

    def compile(self, function: Callable, *args: Any, donate: bool = False) -> Callable:
        """Compile ahead of time, so that a call of other shapes or types fails instead of compiling again."""
        start = time.perf_counter()
        compiled = jax.jit(function, donate_argnums=0 if donate else ()).lower(*args).compile()
        self.clock.compile += time.perf_counter() - start
        return compiled


def drive(
    run: Run,
    stage: str,
    step: Callable[..., tuple[S, dict, Any]],
    state: S,
    *args: Any,
    num_steps: int,
    unit: int,
    ticks: int = 0,
    after: Callable[[int, Any], None] | None = None,
) -> S:
    """Take `num_steps` steps, from the stage's last checkpoint on, logging each.

    Args:
      run: the run.
      stage: its name.
      step: (state, *args) -> (state, metrics [K], what `after` is told).
      state: before the first step; consumed.
      *args: arrays that stay the same.
      num_steps: in all.
      unit: what a step counts for in logs: ticks per seed, or gradient steps.
      ticks: interactions a step costs over all seeds.
      after: called with the step's index and the third result.
    """
    checkpoints = Checkpoints(run.dir / "checkpoints" / stage)
    first = checkpoints.latest_step() or 0
    if first:
        state = checkpoints.load(first, state)
    run.logger.truncate(stage, first * unit)
    if first == num_steps:
        return state
    compiled = run.compile(step, state, *args, donate=True)
    saved = time.perf_counter()
    with run.logger.stage(stage, num_steps * unit, done=first * unit):
        for index in range(first, num_steps):
            state, metrics, extra = compiled(state, *args)
            run.logger.log(stage, (index + 1) * unit, jax.device_get(metrics), "ticks" if ticks else "steps")
            if after is not None:
                after(index, extra)
            run.clock.ticks += ticks
            if time.perf_counter() - saved > CHECKPOINT_SECONDS or index + 1 == num_steps:
                checkpoints.save(index + 1, state)
                run.clock.run += time.perf_counter() - saved
                run.clock.save(run.dir / CLOCK)
                saved = time.perf_counter()
    return state
