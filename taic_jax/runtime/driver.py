"""The driver of every stage of the main job: compile once, step, log, checkpoint, resume."""

import contextlib
import json
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
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
from taic_jax.runtime.files import DESCRIPTION, save_json, writes_here
from taic_jax.runtime.hosts import agree
from taic_jax.runtime.logging import RunLogger
from taic_jax.runtime.pbt import Members, Population
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.runtime.signals import DivergedError, Interrupted, Signals
from taic_jax.types import as_rows

S = TypeVar("S")

STAGE_STREAMS = {
    "collect": 0, "learn": 1, "train": 2, "flat": 3, "evaluate": 4, "video": 5, "repeat": 6, "total": 7, "transfer": 8,
    "practise": 9,
}  # fmt: skip
"""The stream of random numbers of each stage. A number is never reused: old runs draw from it."""
# The stages whose results a stage starts from: a seed that stopped there stays stopped.
BUILDS_ON = {"learn": ("collect",), "practise": ("collect", "learn"), "train": ("collect", "learn", "practise")}
CHECKPOINT_SECONDS = 30.0
PER_SAVE = 40  # Seconds between checkpoints for each that a save holds the run up; as many pass beside it.
DUMPS = "dumps"


@dataclass
class Clock:
    """Seconds of compilation and of running, and the ticks in that time, which a resume counts from checkpoints."""

    compile: float = 0.0
    run: float = 0.0
    ticks: int = 0

    def add(self, since: float, path: Path) -> float:
        """Add the time since then, write the seconds for a resumed run, and return the time."""
        self.run += time.perf_counter() - since
        save_json(path, {"compile": self.compile, "run": self.run})
        return time.perf_counter()

    @classmethod
    def load(cls, path: Path) -> "Clock":
        """Read the file of `add`, or raise ArtifactError; without a file, start at zero."""
        try:
            return cls(**json.loads(path.read_text())) if path.exists() else cls()
        except (ValueError, TypeError):
            expected = "expected the seconds of a run, got another file; without it they start at 0"
            raise ArtifactError(f"{path}: {expected}") from None


class Stopped(NamedTuple):
    """One stage's codes [K], `FINITE` or the reason of a stop, and the ticks or steps [K] before the stop."""

    code: np.ndarray
    after: np.ndarray


@dataclass(frozen=True)
class Run:
    """The state that stages share: rows of configs and keys, one per seed (of each point), the folder and signals."""

    config: Config
    keys: jax.Array
    folder: RunFolder
    logger: RunLogger
    clock: Clock = field(default_factory=Clock)
    signals: Signals = field(default_factory=Signals)
    checkpoint_seconds: float = field(default_factory=lambda: CHECKPOINT_SECONDS)
    stopped: dict[str, Stopped] = field(default_factory=dict)
    devices: Devices = Devices()
    population: Population | None = None
    most: int = 0  # steps of each stage that a calibration takes; 0 for all

    @classmethod
    @contextlib.contextmanager
    def open(
        cls,
        config: Config,
        path: Path,
        *,
        points: Sequence[Config] = (),
        resume: bool = False,
        overwrite: bool = False,
        quiet: bool = False,
        **settings: Any,
    ) -> Iterator["Run"]:
        """Begin or resume a run in the folder `path`, and lock it in the context.

        Args as `pipeline.run_pipeline`; `settings` are the `devices`, `signals`, `checkpoint_seconds` and `population`.
        Raise RunFolderError for a folder of another run, none to resume or a busy one, ArtifactError for a bad clock.
        """
        folder, points = RunFolder(path), points or (config,)
        folder.prepare(config, resume=resume, overwrite=overwrite)
        logs = contextlib.nullcontext(path) if writes_here() else tempfile.TemporaryDirectory()
        with folder.claimed(), logs as logs, RunLogger(Path(logs), quiet=quiet) as logger:
            folder.reopen(config)
            clock = Clock.load(folder.clock_path)
            logger.truncate("evaluate", -1)
            rows, keys = as_rows(points, config.seeds), _keys(config, len(points))
            yield cls(rows, keys, folder, logger, clock, **settings)

    @classmethod
    @contextlib.contextmanager
    def view(cls, config: Config, path: Path, point: Config) -> Iterator["Run"]:
        """Yield one point of the run in the folder `path`, a config of arrays; neither lock nor write the folder."""
        with tempfile.TemporaryDirectory() as logs, RunLogger(Path(logs), quiet=True) as logger:
            yield cls(as_rows([point], config.seeds), _keys(config), RunFolder(path), logger)

    def stage_keys(self, stage: str) -> jax.Array:
        """Return the seeds' keys [K] of one stage; a seed's key does not depend on the number of seeds."""
        return jax.vmap(partial(jax.random.fold_in, data=STAGE_STREAMS[stage]))(self.keys)

    def rows(self, tree: S) -> S:
        """Return the rows of the run's own seeds and points, without those that the devices repeat."""
        return self.devices.take(tree, len(self.keys))

    def inherited(self, stage: str) -> jax.Array:
        """Return the codes [K] of the seeds in the stages that this one builds on."""
        codes = [jnp.full(len(self.keys), FINITE, jnp.int32)]
        codes += [jnp.asarray(self.stopped[name].code) for name in BUILDS_ON.get(stage, ()) if name in self.stopped]
        return jnp.stack(codes).max(axis=0)

    def record_divergence(self, stage: str, guard: Guarded, unit: int, before: np.ndarray | None = None) -> np.ndarray:
        """Record and return the seeds' codes [K], and dump and report each seed whose code was another `before`.

        Raise DivergedError if no seed goes on.
        """
        codes, steps = jax.device_get((guard.code, guard.step))
        self.stopped[stage] = Stopped(codes, steps * unit)
        for seed in np.flatnonzero(codes != before) if before is not None else ():
            self._dump(stage, guard, unit, int(seed))
        if (codes != FINITE).all():
            dumps = self.folder.path / DUMPS
            raise DivergedError(f"{stage}: every seed has stopped, at numbers that are not finite: see {dumps}")
        return codes

    def _dump(self, stage: str, guard: Guarded, unit: int, seed: int) -> None:
        """Save the last good state of a seed for `--replay`, and report the stop."""
        code, step = (int(x[seed]) for x in jax.device_get((guard.code, guard.step)))
        quantity = QUANTITIES[code]
        description = {"stage": stage, "seed": seed, "seeds": len(self.keys), "step": step, "after": step * unit}
        folder = self.folder.path / DUMPS / f"{stage}-{step * unit}-seed{seed}"
        evolved = isinstance(guard.state, Members)
        state, config = (guard.state.state, guard.state.config) if evolved else (guard.state, self.config)
        for name, rows in {"state": state, "config": config}.items():
            save_tree(folder / name, jax.tree.map(lambda x: x[seed], rows))
        save_json(folder / DESCRIPTION, description | {"quantity": quantity})
        why = f"its {quantity} is not finite; --replay {folder} shows it again"
        print(f"taic_jax: seed {seed} stopped in {stage} after {step * unit:,}: {why}", file=sys.stderr)

    def compile(self, stage: str, function: Callable, *args: Any, donate: bool = False) -> Callable:
        """Compile ahead of time for placed rows; a call of other shapes or types fails instead of compiling again."""
        start = time.perf_counter()
        with self.logger.doing(f"{stage}: compiling"):
            compiled = self.devices.compile(function, *args, donate=donate)
        self.clock.compile += time.perf_counter() - start
        return compiled


def _keys(config: Config, points: int = 1) -> jax.Array:
    """Return the keys of the rows: seed k of a run is seed 0 of a run whose seed is k more."""
    return jnp.stack([jax.random.key(config.seed + k) for _ in range(points) for k in range(config.seeds)])


def resume(checkpoints: Checkpoints, guard: Guarded) -> tuple[Guarded, int]:
    """Return the last checkpoint that every host sees, and its step; without one, `guard` and 0."""
    # A checkpoint's types are never weak: so a start and a resume compile the same program.
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
    """Take and log `num_steps` steps in all, from the stage's last checkpoint on, and return the state.

    A seed whose numbers are not finite stops at its last good state, which is also dumped; the others go on.

    Args:
      run: the run; its `stopped` receives the codes.
      step: (states [K], *args: constant) -> (states, metrics [K] with the codes `nonfinite`, input of `after`).
      state: before the first step; consumed.
      unit: ticks per seed, or gradient steps, of a step in the logs.
      ticks: interactions of a step over all seeds.
      after: called with the step's index and the third result.

    Raises:
      Interrupted: at a signal, after the current step is finished and saved.
      DivergedError: every seed has stopped.
      SaveError: a file cannot be written; earlier checkpoints stay.
    """
    num_steps = min(num_steps, run.most or num_steps)
    checkpoints = Checkpoints(run.folder.path / "checkpoints" / stage)
    guard, first = resume(checkpoints, begin(state, run.inherited(stage)))
    run.clock.ticks += first * ticks
    run.logger.truncate(stage, first * unit)
    codes = run.record_divergence(stage, guard, unit)
    if first == num_steps:
        return guard.state
    guard, args = run.devices.place((guard, args))
    compiled = run.compile(stage, guarded(step), guard, *args, donate=True)
    saved, pause = time.perf_counter(), run.checkpoint_seconds
    with checkpoints.waited_for(), run.logger.doing(stage, num_steps * unit, done=first * unit):
        for index in range(first, num_steps):
            guard, metrics, extra = compiled(guard, *args)
            metrics, new_codes = jax.device_get(run.rows((metrics, guard.code)))
            run.logger.log(stage, (index + 1) * unit, metrics, "ticks" if ticks else "steps")
            if after is not None:
                after(index, run.rows(extra))
            run.clock.ticks += ticks
            if changed := bool((new_codes != codes).any()):
                codes = run.record_divergence(stage, run.rows(guard), unit, before=codes)
            due = changed or index + 1 == num_steps or time.perf_counter() - saved > pause
            due, received = agree([due, run.signals.received or 0])
            if due or received:
                began = time.perf_counter()
                checkpoints.save(index + 1, run.rows(guard))
                pause = run.checkpoint_seconds and max(run.checkpoint_seconds, PER_SAVE * (time.perf_counter() - began))
                saved = run.clock.add(saved, run.folder.clock_path)
            if received:
                raise Interrupted(received)
    agree([0])  # every host waits for the files of `after`
    return run.rows(guard.state)
