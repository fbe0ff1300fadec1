"""Show again how numbers stopped being finite: take the one step that failed from the state that was dumped."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from taic_jax.artifacts.models import load_options
from taic_jax.config import replace
from taic_jax.config_io import load_config
from taic_jax.envs.base import Env
from taic_jax.nonfinite import FINITE, QUANTITIES
from taic_jax.options.model import make_networks
from taic_jax.pipeline import learn_over_rows, over_rows, select_windows, step_over_rows
from taic_jax.runtime.checkpoint import ArtifactError, load_tree
from taic_jax.runtime.driver import Run
from taic_jax.runtime.files import read_description
from taic_jax.tasks import make_envs
from taic_jax.types import as_arrays

FIELDS = ("stage", "seed", "seeds", "step", "after", "quantity")


def replay(dump: Path) -> str | None:
    """Take the step after which a seed had stopped again, and say what was not finite; None if all was finite now.

    Args:
      dump: a folder under `dumps` of a run, which must still be where it was.

    Raises:
      ArtifactError: it is none, or not of this version's kind.
    """
    told = _read(dump)
    run_dir = dump.absolute().parents[1]
    config = load_config(run_dir / "config.yaml")
    env, source = make_envs(config)
    # As many seeds as there were, all in this state and of this point: the program is the one that failed.
    point = load_tree(dump / "config", jax.eval_shape(as_arrays, config))
    with Run.view(replace(config, "seeds", told["seeds"]), run_dir, point) as run:
        step, like, args = _stage(run, env, source, told["stage"])
        state = load_tree(dump / "state", jax.eval_shape(lambda rows: jax.tree.map(lambda x: x[0], rows), like))
        states = jax.tree.map(lambda x: jnp.broadcast_to(x, (told["seeds"], *x.shape)), state)
        _, metrics, extra = run.compile(told["stage"], step, states, *args)(states, *args)
    seed, code = told["seed"], int(metrics["nonfinite"][told["seed"]])
    if code == FINITE:
        return None
    return (
        f"seed {seed}, {told['stage']}, after {told['after']:,}: {QUANTITIES[code]} is not finite{_where(extra, seed)}"
    )


def _stage(run: Run, env: Env, source: Env, stage: str) -> tuple[Any, Any, tuple]:
    """Return a stage's step (states, configs, ...), the shapes of its states, and its arguments behind them."""
    config, keys = run.config, run.stage_keys(stage)
    if stage == "learn":
        networks = make_networks(config.options, source.proprioceptive_size, source.action_size)
        init, steps = learn_over_rows(config.options, networks)
        return steps, jax.eval_shape(init, config.options, keys), (config.options, select_windows(run, source))
    task = source if stage == "collect" else env
    folder = Path(config.options.source or run.dir)
    model = (load_options(folder, env, config.options, len(keys)),) if stage == "train" else ()
    init = over_rows(task, stage, "init")
    return step_over_rows(task, stage), jax.eval_shape(init, config, keys, *model), (config, *model)


def _read(dump: Path) -> dict[str, Any]:
    told = read_description(dump)
    if not told or not set(FIELDS) <= set(told):
        raise ArtifactError(f"{dump}: expected a folder under dumps of a run, where a seed stopped; got none")
    return told


def _where(experience: Any, seed: int) -> str:
    """Return the first tick and environment whose numbers are not finite, if experience was recorded."""
    for array in jax.tree.leaves(experience):
        values = np.asarray(array[seed], np.float32)
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            return f", first at tick {bad[0][0]} of environment {bad[0][1]}"
    return ""
