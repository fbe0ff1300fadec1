"""Measures of the option spaces of a finished run, one number per seed: what figure 6 says in numbers."""

from pathlib import Path

import jax
import jax.numpy as jnp

from taic_jax import option_space
from taic_jax.artifacts import load_options
from taic_jax.config import COLLECT
from taic_jax.config_io import load_config
from taic_jax.experience import EXPERIENCE, read_experience
from taic_jax.pipeline import make_envs

MEASURES = (
    "kl", "active_dimensions", "prior/one/distance_correlation", "prior/many/distance_correlation",
    "prior/one/trustworthiness", "window/distance_correlation", "window/mlp_r2/change", "window/mlp_r2/start",
    "window/mlp_r2/end", "window/mutual_information/change", "window/mutual_information/permuted",
)  # fmt: skip
PREFIX = "space/"
COUNT = 500
"""Options of each kind that are measured."""


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
