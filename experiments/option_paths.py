"""What options of the room draw: interpolated codes, and codes with one dimension changed (section 4.1, figure 5).

Paths are free of walls: an action is a velocity, and a path the sum of its steps.
"""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from taic_jax.artifacts.experience import EXPERIENCE, read_experience
from taic_jax.artifacts.models import load_options
from taic_jax.config import COLLECT, OptionsConfig
from taic_jax.config_io import load_config
from taic_jax.envs.navigation import MAX_SPEED, Navigation
from taic_jax.options.dataset import gather, make_dataset
from taic_jax.options.model import OptionModel
from taic_jax.pipeline import make_envs
from taic_jax.types import as_arrays

STEPS = 11
"""Codes from one window's to another's, both included."""
SWEEP = np.linspace(-2.0, 2.0, 9)
"""What is added to one dimension of a code, in standard deviations of the prior."""
PAIRS = 100
"""Pairs of windows, and codes whose dimensions are changed, of each option model."""


def as_path(actions: Float[Array, "*batch L 2"]) -> Float[Array, "*batch L+1 2"]:
    """Return the positions in m, from the origin, that velocities lead through."""
    steps = MAX_SPEED * Navigation.dt * jnp.clip(actions, -1.0, 1.0)
    return jnp.cumsum(jnp.concatenate([jnp.zeros_like(steps[..., :1, :]), steps], axis=-2), axis=-2)


def decode(config: OptionsConfig, model: OptionModel, codes: Float[Array, "N D"]) -> Float[Array, "N L+1 2"]:
    """Return the paths of codes decoded in open loop."""
    states = jnp.zeros((config.length, model.state_size))
    return as_path(jax.vmap(lambda code: model.decode(code, states)[0])(codes))


def straightness(paths: Float[np.ndarray, "N I L 2"]) -> np.ndarray:
    """Return how smoothly N rows of I paths pass from the first to the last, each in (0, 1].

    It is the distance of the first and last path over the length of the way through all of them, a path being one
    point of all its positions: 1 where each step leads straight on.
    """
    points = paths.reshape(*paths.shape[:2], -1)
    way = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(axis=1)
    return np.linalg.norm(points[:, -1] - points[:, 0], axis=-1) / np.maximum(way, 1e-9)


@jax.jit
def _draw_windows(
    config: OptionsConfig, model: OptionModel, experience: Any, key: Array
) -> tuple[Float[Array, "N D"], Float[Array, "N L 2"]]:
    """Draw pairs of windows from the selection; return the means of their codes, and their actions."""
    dataset = make_dataset(experience, config)
    which = jax.random.randint(key, (2 * PAIRS,), 0, dataset.count)
    windows = gather(dataset, which, jnp.full(2 * PAIRS, config.length), config.length)
    means, _ = jax.vmap(model.encode)(windows.actions)
    return means[:, -1], windows.actions


def measure_paths(config: OptionsConfig, model: OptionModel, experience: Any, key: Array) -> dict[str, Any]:
    """Measure one option model, and return its first pair and code as an example.

    Returns: `smoothness` of interpolated codes; `shuffled`, that of as many codes between the same ends that belong to
    other windows; `effect` [D], by how much a dimension moves the end point over the sweep, in m (root mean square),
    the strongest first; and the `example`s' paths.
    """
    config = as_arrays(config)
    key_windows, key_shuffle = jax.random.split(key)
    codes, actions = _draw_windows(config, model, experience, key_windows)
    first, last = codes[:PAIRS], codes[PAIRS:]
    share = jnp.linspace(0.0, 1.0, STEPS)[None, :, None]
    between = first[:, None] * (1 - share) + last[:, None] * share
    others = codes[jax.random.randint(key_shuffle, (PAIRS, STEPS), 0, 2 * PAIRS)]
    ends = jnp.arange(STEPS)[None, :, None]
    others = jnp.where((ends == 0) | (ends == STEPS - 1), between, others)
    size = codes.shape[1]
    swept = first[:, None, None] + jnp.asarray(SWEEP, jnp.float32)[:, None] * jnp.eye(size)[:, None]
    run = jax.jit(partial(decode, config, model))
    paths = [np.asarray(run(x.reshape(-1, size))).reshape(*x.shape[:-1], -1, 2) for x in (between, others, swept)]
    spread = paths[2][..., -1, :].std(axis=2)  # [N, D, 2], over the sweep
    effect = np.sqrt((spread**2).sum(axis=-1).mean(axis=0))
    order = np.argsort(-effect)
    seen = np.asarray(as_path(actions))
    example = {
        "interpolated": paths[0][0],
        "between": seen[[0, PAIRS]],
        "swept": paths[2][0][order],
        "original": seen[0],
    }
    return {
        "smoothness": float(straightness(paths[0]).mean()),
        "shuffled": float(straightness(paths[1]).mean()),
        "effect": effect[order].tolist(),
        "example": {name: value.tolist() for name, value in example.items()},
    }


def paths_of(folder: Path) -> dict[str, Any]:
    """Return the measures of every seed's option model [K], and the first one's example."""
    config = load_config(str(folder / "config.yaml"))
    env = make_envs(config)[1]
    source = Path(config.options.source) if config.options.source else folder
    models = load_options(folder, env, config.options, config.seeds)
    (name,) = config.options.experience or (COLLECT,)
    experience = (source if name == COLLECT else Path(name)) / EXPERIENCE
    measured = []
    for seed in range(config.seeds):  # one at a time: the experience of all would not fit into memory
        seen = jax.tree.map(jnp.asarray, read_experience(experience, seed))
        model = jax.tree.map(lambda x, k=seed: x[k], models)
        measured.append(measure_paths(config.options, model, seen, jax.random.key(config.seed + seed)))
    numbers = {name: [row[name] for row in measured] for name in ("smoothness", "shuffled")}
    numbers |= {f"effect/{d}": [row["effect"][d] for row in measured] for d in range(config.options.size)}
    return {"numbers": numbers, "example": measured[0]["example"]}
