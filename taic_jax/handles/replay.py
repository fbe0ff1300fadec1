"""Replay of a failed step, from the dumped state, to name the first number that is not finite."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from taic_jax.artifacts.models import load_options
from taic_jax.config import COLLECT, replace
from taic_jax.envs.base import Env
from taic_jax.nonfinite import FINITE, QUANTITIES
from taic_jax.pipeline import select_windows
from taic_jax.runtime.checkpoint import ArtifactError, load_tree
from taic_jax.runtime.driver import Run
from taic_jax.runtime.files import read_description
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.sources import make_envs, take_over
from taic_jax.trainer import init_learning, init_rows, learn_rows, make_trainer, step_rows
from taic_jax.types import as_arrays

FIELDS = ("stage", "seed", "seeds", "step", "after", "quantity")


def replay(dump: Path) -> str | None:
    """Repeat the step at which a seed stopped; return a line on the first number that is not finite, or None.

    Args:
      dump: a folder under `dumps` of a run, still in its place.

    Raises:
      ArtifactError: it is not a dump, or was written by another version.
    """
    dumped = read_description(dump) or {}
    if not set(FIELDS) <= set(dumped):
        raise ArtifactError(f"{dump}: expected a folder under dumps of a run, where a seed stopped; got none")
    run_dir = dump.absolute().parents[1]
    config = RunFolder(run_dir).config()
    env, source = make_envs(config)
    # With as many seeds as the run, all in this state and of this point, the program is the one that failed.
    point = load_tree(dump / "config", jax.eval_shape(as_arrays, config))
    with Run.view(replace(config, "seeds", dumped["seeds"]), run_dir, point) as run:
        step, like, args = _stage(run, env, source, dumped["stage"])
        state = load_tree(dump / "state", jax.eval_shape(lambda rows: jax.tree.map(lambda x: x[0], rows), like))
        states = jax.tree.map(lambda x: jnp.broadcast_to(x, (dumped["seeds"], *x.shape)), state)
        _, metrics, extra = run.compile(dumped["stage"], step, states, *args)(states, *args)
    seed, code = dumped["seed"], int(metrics["nonfinite"][dumped["seed"]])
    if code == FINITE:
        return None
    where = _first_bad(extra, seed)
    return f"seed {seed}, {dumped['stage']}, after {dumped['after']:,}: {QUANTITIES[code]} is not finite{where}"


def _stage(run: Run, env: Env, source: Env, stage: str) -> tuple[Any, Any, tuple]:
    """Return a stage's step (states, *arguments), the shapes of its states, and the arguments."""
    config, keys = run.config, run.stage_keys(stage)
    if stage == "learn":
        states = jax.eval_shape(partial(init_learning, source), config.options, keys)
        return learn_rows, states, (config.options, select_windows(run, source))
    model = None
    if stage == "train":
        model = take_over(replace(run.folder.config(), "seeds", len(keys)), env, source).model
        model = load_options(run.folder.path, env, config.options, len(keys)) if model is None else model
    make = partial(make_trainer, stage, source if stage == COLLECT else env)
    states = jax.eval_shape(partial(init_rows, make), (config, model), keys)
    return partial(step_rows, make), states, ((config, model),)


def _first_bad(experience: Any, seed: int) -> str:
    """Return the first tick and environment with a number that is not finite, if the step recorded experience."""
    for array in jax.tree.leaves(experience):
        values = np.asarray(array[seed], np.float32)
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            return f", first at tick {bad[0][0]} of environment {bad[0][1]}"
    return ""
