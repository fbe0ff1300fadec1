"""Measures of a finished run, a number per seed: option spaces, paths that options draw, recovery from a change.

Examples for the figures are of the first seed's option model.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from taic_jax.analysis import option_space
from taic_jax.artifacts.experience import EXPERIENCE, read_experience
from taic_jax.artifacts.models import load_options
from taic_jax.config import COLLECT, OptionsConfig
from taic_jax.envs.navigation import MAX_SPEED, Navigation
from taic_jax.options.dataset import Experience
from taic_jax.options.execution import make_executor
from taic_jax.options.model import OptionModel
from taic_jax.pipeline import make_envs
from taic_jax.runtime.run_folder import Row, RunFolder
from taic_jax.types import as_arrays

SPACE_MEASURES = (
    "kl", "active_dimensions", "prior/one/distance_correlation", "prior/many/distance_correlation",
    "prior/one/trustworthiness", "window/distance_correlation", "window/mlp_r2/change", "window/mlp_r2/start",
    "window/mlp_r2/end", "window/mutual_information/change", "window/mutual_information/permuted",
)  # fmt: skip
PREFIX = "space/"
COUNT = 500  # Options of each kind that are measured.
SHOWN = 300  # Options of the example.
STEPS = 11  # Codes from one window's to another's, both included.
SWEEP = np.linspace(-2.0, 2.0, 9)  # Changes of one dimension of a code, in standard deviations of the prior.
PAIRS = 100  # Pairs of windows, and codes whose dimensions are changed, of each option model.
EPISODES = 100  # Fewest episodes of a share of successes.
AFTER = 200_000  # Ticks after the change in which a method may recover: 1000 episodes of the longest kind.
RECOVERED = 0.9  # Share of these last episodes that reach the goal if a seed has recovered.


def each_model(folder: Path) -> Iterator[tuple[OptionModel, Experience, Array]]:
    """Yield the option model of each seed, its experience and a key, one by one: all do not fit into memory."""
    config = RunFolder(folder).config()
    source = Path(config.options.source or folder)
    (name,) = config.options.experience or (COLLECT,)
    models = load_options(folder, make_envs(config)[1], config.options, config.seeds)
    for seed in range(config.seeds):
        experience = read_experience((source if name == COLLECT else Path(name)) / EXPERIENCE, seed)
        model = jax.tree.map(lambda x, k=seed: x[k], models)
        yield model, jax.tree.map(jnp.asarray, experience), jax.random.key(config.seed + seed)


def measure_spaces(folder: Path) -> dict[str, list[float]]:
    """Return the measures of every seed's option space, under `space/NAME`."""
    config = RunFolder(folder).config()
    source = make_envs(config)[1]
    rows = [option_space.measure(source, config.options, *each, COUNT) for each in each_model(folder)]
    return {f"{PREFIX}{name}": [row[name] for row in rows] for name in SPACE_MEASURES}


def example_space(folder: Path) -> dict[str, Any]:
    """Return options [N, D] drawn from the prior, and the states [N, P] after each, in standard deviations of the
    experience; all begin in one state."""
    config = RunFolder(folder).config()
    model, _, key = next(each_model(folder))
    source, executor = make_envs(config)[1], make_executor(as_arrays(config.options), model)
    key_options, key_run = jax.random.split(key)
    options = jax.random.normal(key_options, (SHOWN, config.options.size))
    effects = jax.jit(option_space.execute, static_argnums=0)(source, executor, options, key_run)
    drawn = {"options": options, "ends": model.state_scale(effects.end)}
    # More digits than a picture shows would be more than half of the table.
    return {name: np.asarray(points, np.float64).round(2).tolist() for name, points in drawn.items()}


def as_path(actions: Float[Array, "*batch L 2"]) -> Float[Array, "*batch L+1 2"]:
    """Return the positions in m, from the origin, of a point with these velocities and no walls."""
    steps = MAX_SPEED * Navigation.dt * jnp.clip(actions, -1.0, 1.0)
    return jnp.cumsum(jnp.concatenate([jnp.zeros_like(steps[..., :1, :]), steps], axis=-2), axis=-2)


def decode(config: OptionsConfig, model: OptionModel, codes: Float[Array, "N D"]) -> Float[Array, "N L+1 2"]:
    """Return the paths of codes decoded in open loop."""
    states = jnp.zeros((config.length, model.state_size))
    return as_path(jax.vmap(lambda code: model.decode(code, states)[0])(codes))


def straightness(paths: Float[np.ndarray, "N I L 2"]) -> np.ndarray:
    """Return the straightness of N rows of I paths, each in (0, 1]: the distance of the first and last path over the
    length of the way through all, a path being one point of all its positions."""
    points = paths.reshape(*paths.shape[:2], -1)
    way = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(axis=1)
    return np.linalg.norm(points[:, -1] - points[:, 0], axis=-1) / np.maximum(way, 1e-9)


def measure_paths(config: OptionsConfig, model: OptionModel, experience: Experience, key: Array) -> dict[str, Any]:
    """Measure one option model, and return the paths of its first pair and code as the `example`.

    `smoothness` is the straightness of interpolated codes; `shuffled`, that of codes of other windows between the same
    ends; `effect` [D], each dimension's spread of the end point over the sweep, in m (root mean square), the strongest
    first.
    """
    config = as_arrays(config)
    key_windows, key_shuffle = jax.random.split(key)
    encode = jax.jit(option_space.encode_windows, static_argnums=4)
    windows = encode(config, model, experience, key_windows, 2 * PAIRS)
    codes = windows.mean
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
    drawn = np.asarray(as_path(windows.actions))
    example = {"interpolated": paths[0][0], "between": drawn[[0, PAIRS]]}
    example |= {"swept": paths[2][0][order], "original": drawn[0]}
    smoothness, shuffled = (float(straightness(x).mean()) for x in paths[:2])
    numbers = {"smoothness": smoothness, "shuffled": shuffled, "effect": effect[order].tolist()}
    return numbers | {"example": {name: value.tolist() for name, value in example.items()}}


def measure_run_paths(folder: Path) -> dict[str, Any]:
    """Return the `numbers` of the paths of every seed's options (section 4.1, figure 5), and the `example`."""
    options = RunFolder(folder).config().options
    rows = [measure_paths(options, *each) for each in each_model(folder)]
    numbers = {name: [row[name] for row in rows] for name in ("smoothness", "shuffled")}
    numbers |= {f"effect/{d}": [row["effect"][d] for row in rows] for d in range(options.size)}
    return {"numbers": numbers, "example": rows[0]["example"]}


def recovery_of(rows: Sequence[Row], stage: str) -> tuple[np.ndarray, dict[str, list]]:
    """Return the share of episodes [K, I] that reached the goal in each iteration, and numbers per seed (section 4.1).

    `changed_at` is the tick at which the task changed, or NaN; `success_before` and `success_after` are the share of
    successes among the last 100 episodes before, and among the last 100 of the `AFTER` ticks after the change, NaN
    where there are fewer; `ticks_after` are all ticks after it. A row of the log is an iteration.
    """
    unit = rows[0]["ticks"]
    changed, success, episodes = (
        np.array([row[f"{stage}/{name}"] for row in rows], float).T
        for name in ("mean/changed", "mean/success", "episodes")
    )
    reached = success * unit  # an episode ends at its success
    shares = np.divide(reached, episodes, out=np.full_like(reached, np.nan), where=episodes > 0)
    numbers: dict[str, list] = {"changed_at": [], "success_before": [], "success_after": [], "ticks_after": []}
    for k in range(len(changed)):
        after = np.cumsum(changed[k] * unit)
        total = float(after[-1])
        before, within = changed[k] == 0, (changed[k] == 1) & (after <= AFTER)
        numbers["changed_at"].append(len(after) * unit - total if total else float("nan"))
        numbers["success_before"].append(_last_share(reached[k, before], episodes[k, before]))
        numbers["success_after"].append(_last_share(reached[k, within], episodes[k, within]))
        numbers["ticks_after"].append(total)
    return shares, numbers


def is_reliable(shares: np.ndarray) -> np.ndarray:
    """Return which seeds [K] reached the goal reliably; not those with too few episodes, as before an early change."""
    return np.nan_to_num(shares) >= RECOVERED


def _last_share(reached: np.ndarray, episodes: np.ndarray) -> float:
    """Return the share of successes in the fewest last iterations with `EPISODES` episodes, NaN if there are none."""
    counts = np.cumsum(episodes[::-1])
    if not len(counts) or counts[-1] < EPISODES:
        return float("nan")
    last = np.argmax(counts >= EPISODES) + 1
    return float(reached[-last:].sum() / counts[last - 1])
