"""What every stage of the main job is driven by: compile once, step, log, checkpoint, resume."""

import json
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from taic_jax.config import Config
from taic_jax.nonfinite import FINITE, QUANTITIES, Guarded, begin, guarded
from taic_jax.runtime.checkpoint import ArtifactError, Checkpoints, save_tree
from taic_jax.runtime.devices import Devices
from taic_jax.runtime.files import save_text
from taic_jax.runtime.hosts import agree
from taic_jax.runtime.logging import RunLogger
from taic_jax.runtime.pbt import Members, Population
from taic_jax.runtime.signals import DivergedError, Interrupted, Signals

S = TypeVar("S")

STAGES = ("collect", "learn", "train", "flat", "evaluate", "video", "repeat", "total", "transfer")
BUILDS_ON = {"learn": ("collect",), "train": ("collect", "learn")}
"""What a stage starts from: a seed that stopped there stays stopped."""
CHECKPOINT_SECONDS = 30.0
CLOCK, DUMPS = "clock.json", "dumps"


@dataclass
class Clock:
    """Seconds spent compiling and running, and the ticks run in that time, which checkpoints tell on a resume."""

    compile: float = 0.0
    run: float = 0.0
    ticks: int = 0

    def add(self, since: float, path: Path) -> float:
        """Count what ran since then, write to a JSON file, so that a resumed run counts on, and return the time."""
        self.run += time.perf_counter() - since
        save_text(path, json.dumps({"compile": self.compile, "run": self.run}) + "\n")
        return time.perf_counter()

    @classmethod
    def load(cls, path: Path) -> "Clock":
        """Read what `save` wrote; without a file, start at zero.

        Raises:
          ArtifactError: it is not such a file.
        """
        try:
            return cls(**json.loads(path.read_text())) if path.exists() else cls()
        except (ValueError, TypeError):
            raise ArtifactError(
                f"{path}: expected the seconds of a run, got another file; without it they start at 0"
            ) from None


class Stopped(NamedTuple):
    """Of one stage, for every seed: `FINITE`, or why it stopped, and what it had done by then, in the logs' unit."""

    code: np.ndarray
    after: np.ndarray


@dataclass(frozen=True)
class Run:
    """What every stage needs: rows of configs and keys, one per seed (of each point), where to write, when to stop."""

    config: Config
    keys: jax.Array
    dir: Path
    logger: RunLogger
    clock: Clock
    signals: Signals = field(default_factory=Signals)
    checkpoint_seconds: float = field(default_factory=lambda: CHECKPOINT_SECONDS)
    stopped: dict[str, Stopped] = field(default_factory=dict)
    devices: Devices = Devices()
    population: Population | None = None

    def stage_keys(self, stage: str) -> jax.Array:
        """Return the seeds' keys [K] of one stage; a seed's key does not depend on the number of seeds."""
        return jax.vmap(partial(jax.random.fold_in, data=STAGES.index(stage)))(self.keys)

    def rows(self, tree: S) -> S:
        """Return the rows of the run's own seeds and points, of those that the devices had."""
        return self.devices.take(tree, len(self.keys))

    def inherited(self, stage: str) -> jax.Array:
        """Return the codes [K] of the seeds that stopped in what this stage builds on."""
        codes = [jnp.full(len(self.keys), FINITE, jnp.int32)]
        codes += [jnp.asarray(self.stopped[name].code) for name in BUILDS_ON.get(stage, ()) if name in self.stopped]
        return jnp.stack(codes).max(axis=0)

    def record_divergence(self, stage: str, guard: Guarded, unit: int, known: np.ndarray | None = None) -> np.ndarray:
        """Note which seeds have stopped, dump and tell those that `known` does not have yet, and return the codes [K].

        Raises:
          DivergedError: none goes on.
        """
        codes, steps = jax.device_get((guard.code, guard.step))
        self.stopped[stage] = Stopped(codes, steps * unit)
        for seed in np.flatnonzero(codes != known) if known is not None else ():
            folder = self.dir / DUMPS / f"{stage}-{steps[seed] * unit}-seed{seed}"
            told = {"stage": stage, "seed": int(seed), "seeds": len(codes), "step": int(steps[seed])}
            told |= {"after": int(steps[seed] * unit), "quantity": QUANTITIES[codes[seed]]}
            evolved = isinstance(guard.state, Members)
            state, config = (guard.state.state, guard.state.config) if evolved else (guard.state, self.config)
            for name, rows in {"state": state, "config": config}.items():
                save_tree(folder / name, jax.tree.map(lambda x, k=seed: x[k], rows))
            save_text(folder / "description.json", json.dumps(told, indent=2) + "\n")
            print(
                f"taic_jax: seed {seed} stopped in {stage} after {told['after']:,}: its {told['quantity']} is not "
                f"finite; --replay {folder} shows it again",
                file=sys.stderr,
            )
        if (codes != FINITE).all():
            where = self.dir / DUMPS
            raise DivergedError(f"{stage}: every seed has stopped, at numbers that are not finite: see {where}")
        return codes

    def compile(self, stage: str, function: Callable, *args: Any, donate: bool = False) -> Callable:
        """Compile ahead of time for placed rows; a call of other shapes or types fails instead of compiling again."""
        start = time.perf_counter()
        with self.logger.doing(f"{stage}: compiling"):
            compiled = self.devices.compile(function, *args, donate=donate)
        self.clock.compile += time.perf_counter() - start
        return compiled


def resume(checkpoints: Checkpoints, guard: Guarded) -> tuple[Guarded, int]:
    """Return the last checkpoint that every host sees, and its step; without one, what is given, and 0.

    Types are never weak, as a checkpoint's are not: the program compiled at the start is the one that resumes.
    """
    guard = jax.tree.map(
        lambda x: jax.lax.convert_element_type(x, x.dtype) if getattr(x, "weak_type", False) else x, guard
    )
    (step,) = agree([checkpoints.latest_step() or 0], least=True)
    return checkpoints.load(step, guard) if step else guard, step


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

    A seed whose numbers are not finite stops at its last good state, which is also dumped; the others go on.

    Args:
      run: the run; its `stopped` is told of the seeds that did not get through.
      stage: its name.
      step: (states [K], *args) -> (states, metrics [K] with the codes `nonfinite`, what `after` is told).
      state: before the first step; consumed.
      *args: arrays that stay the same.
      num_steps: in all.
      unit: what a step counts for in logs: ticks per seed, or gradient steps.
      ticks: interactions a step costs over all seeds.
      after: called with the step's index and the third result.

    Raises:
      Interrupted: a signal was received; the step that was being taken is finished and saved.
      DivergedError: every seed has stopped.
      SaveError: something cannot be written; the checkpoints before are still there.
    """
    checkpoints = Checkpoints(run.dir / "checkpoints" / stage)
    guard, first = resume(checkpoints, begin(state, run.inherited(stage)))
    run.clock.ticks += first * ticks
    run.logger.truncate(stage, first * unit)
    known = run.record_divergence(stage, guard, unit)
    if first == num_steps:
        return guard.state
    guard, args = run.devices.place((guard, args))
    compiled = run.compile(stage, guarded(step), guard, *args, donate=True)
    saved = time.perf_counter()
    with checkpoints.waited_for(), run.logger.stage(stage, num_steps * unit, done=first * unit):
        for index in range(first, num_steps):
            guard, metrics, extra = compiled(guard, *args)
            metrics, codes = jax.device_get(run.rows((metrics, guard.code)))
            run.logger.log(stage, (index + 1) * unit, metrics, "ticks" if ticks else "steps")
            if after is not None:
                after(index, run.rows(extra))
            run.clock.ticks += ticks
            if changed := bool((codes != known).any()):
                known = run.record_divergence(stage, run.rows(guard), unit, known)
            due = changed or index + 1 == num_steps or time.perf_counter() - saved > run.checkpoint_seconds
            due, received = agree([due, run.signals.received or 0])
            if due or received:
                checkpoints.save(index + 1, run.rows(guard))
                saved = run.clock.add(saved, run.dir / CLOCK)
            if received:
                raise Interrupted(received)
    agree([0])  # no host reads what `after` writes before it is there
    return run.rows(guard.state)
