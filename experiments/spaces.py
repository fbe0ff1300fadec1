"""The option spaces of a finished run: measures, one number per seed, and an example, which figure 6 draws."""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from taic_jax.analysis import option_space
from taic_jax.artifacts.experience import EXPERIENCE, read_experience
from taic_jax.artifacts.models import load_options
from taic_jax.config import COLLECT
from taic_jax.config_io import load_config
from taic_jax.options.execution import make_executor
from taic_jax.pipeline import make_envs
from taic_jax.types import as_arrays

MEASURES = (
    "kl", "active_dimensions", "prior/one/distance_correlation", "prior/many/distance_correlation",
    "prior/one/trustworthiness", "window/distance_correlation", "window/mlp_r2/change", "window/mlp_r2/start",
    "window/mlp_r2/end", "window/mutual_information/change", "window/mutual_information/permuted",
)  # fmt: skip
PREFIX = "space/"
COUNT = 500
"""Options of each kind that are measured."""
SHOWN = 300
"""Options of the example."""


def measure_spaces(folder: Path) -> dict[str, list[float]]:
    """Return the measures of every seed's option model, learnt from the experience of one run, under `space/NAME`."""
    config = load_config(str(folder / "config.yaml"))
    env, source = make_envs(config)
    models = load_options(folder, env, config.options, config.seeds)
    (name,) = config.options.experience or (COLLECT,)
    experience = (folder if name == COLLECT else Path(name)) / EXPERIENCE
    measured = []
    for seed in range(config.seeds):
        seen = jax.tree.map(jnp.asarray, read_experience(experience, seed))
        model = jax.tree.map(lambda x, k=seed: x[k], models)
        key = jax.random.key(config.seed + seed)
        measured.append(option_space.measure(source, config.options, model, seen, key, COUNT))
    return {f"{PREFIX}{name}": [row[name] for row in measured] for name in MEASURES}


def example_space(folder: Path) -> dict[str, Any]:
    """Return options [N, D] drawn from the prior, and the states [N, P] that each led to from one state.

    They are those of the first seed's option model; a state is measured in standard deviations of the experience.
    """
    config = load_config(str(folder / "config.yaml"))
    env, source = make_envs(config)
    model = jax.tree.map(lambda x: x[0], load_options(folder, env, config.options, config.seeds))
    executor = make_executor(as_arrays(config.options), model)
    key_options, key_run = jax.random.split(jax.random.key(config.seed))
    options = jax.random.normal(key_options, (SHOWN, config.options.size))
    effects = jax.jit(option_space.execute, static_argnums=0)(source, executor, options, key_run)
    drawn = {"options": options, "ends": model.state_scale(effects.end)}
    # More digits than a picture shows would be more than half of the table.
    return {name: np.asarray(points, np.float64).round(2).tolist() for name, points in drawn.items()}
