"""Windows of experience: action sequences with the states they pass through."""

import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from taic_jax.config import OptionsConfig
from taic_jax.envs.views import Views, one_view
from taic_jax.options.frame import Frame
from taic_jax.options.model import Scale

# Every tenth stretch of experience is held out if learning needs P's error on unseen windows. A stretch is several
# windows long, so that few of its windows overlap with others.
HELD_OUT_EVERY, STRETCH = 10, 8


class ShortExperienceError(ValueError):
    """An experience too short to hold a part out."""


class Experience(struct.PyTreeNode):
    """T consecutive ticks of B environments; `obs` is the proprioceptive slice."""

    obs: Any
    action: Any
    reward: Any
    done: Any


class Window(struct.PyTreeNode):
    """L actions and the L + 1 states around them; `mask` [L] marks the actions that belong to the window."""

    states: Array
    actions: Array
    mask: Array


class Dataset(struct.PyTreeNode):
    """Experience flattened to rows, one environment after another, and the rows at which a selected window starts.

    `starts` has one entry per row. Its first `count` are the windows to learn from, the next `held_out` the held-out
    windows; the rest is void, because the two numbers depend on the data and the array's size must not.
    """

    experience: Experience
    starts: Array
    count: Array
    held_out: Array
    state_scale: Scale
    change_scale: Scale
    views: Views


def window_score(reward: Float[Array, "T B"], done: Array, length: int) -> tuple[Float[Array, "T B"], Array]:
    """Return the sum of rewards over the `length` ticks from each tick, and whether no episode ends in them.

    No window contains the last tick of an episode: the state after it is the next episode's.
    """
    total, crosses = jnp.zeros_like(reward), jnp.zeros_like(done)
    for i in range(length):
        total = total + jnp.roll(reward, -i, axis=0)
        crosses = crosses | jnp.roll(done, -i, axis=0)
    inside = jnp.arange(reward.shape[0]) < reward.shape[0] - length
    return total, ~crosses & inside[:, None]


def make_dataset(
    experience: Experience | Sequence[Experience],
    config: OptionsConfig,
    views: Views | None = None,
    frame: Frame | None = None,
) -> Dataset:
    """Select windows of `config.length` ticks and measure the scales over them.

    Windows start between the shares `since` and `until` of each experience, a span that is cut into `parts`. Of each
    part, `select="top"` takes the `fraction` with the greatest reward (§4.2.2), `select="random"` takes all.

    Args:
      experience: one, or several of the same body; windows are selected from each separately, then merged.
      config: the settings of the selection; with `views="all"` the dataset has all views of the body.
      views: the views of the body; by default one.
      frame: the one in which the model will see states; by default the world's.

    Raises:
      ShortExperienceError: windows must be held out, and no experience is long enough.
    """
    sources = [experience] if isinstance(experience, Experience) else list(experience)
    needed = STRETCH * HELD_OUT_EVERY * config.length
    if holds_out(config) and all(len(source.reward) < needed for source in sources):
        raise ShortExperienceError(
            f"options.delta_unit: quantile needs {needed} ticks of each environment, to hold every tenth stretch of "
            f"{STRETCH} windows out; got {max(len(source.reward) for source in sources)}; error needs none"
        )
    num_parts = len(sources) * config.parts
    columns = [_candidates(source, config, i * config.parts) for i, source in enumerate(sources)]
    score, part, held_out = (jnp.concatenate(column) for column in zip(*columns, strict=True))
    part = jnp.where(jnp.isfinite(score), part, num_parts)  # rows where no window may start
    order, selected = _select(score, part, num_parts, config)
    group = jnp.where(selected, held_out[order].astype(jnp.int32), 2)
    starts = order[jnp.argsort(group, stable=True)]
    count, num_held_out = jnp.sum(group == 0, dtype=jnp.int32), jnp.sum(group == 1, dtype=jnp.int32)
    rows: Any = jax.tree.map(lambda *x: jnp.concatenate([flatten(y) for y in x]), *sources)
    probes = 10_000 if frame else 100_000  # with a frame all states of a window are read
    probe = starts[(jnp.arange(float(probes)) * (count.astype(jnp.float32) / probes)).astype(jnp.int32)]
    if views is None or config.views == "one":
        views = one_view(rows.obs.shape[-1], rows.action.shape[-1])
    ticks = jnp.arange(config.length + 1) if frame else jnp.array([0, config.length])
    windows = rows.obs[probe[:, None] + ticks[None]]
    windows = jax.vmap(views.obs, (0, None))(jnp.arange(len(views)), windows).reshape((-1, *windows.shape[1:]))
    states, change = windows[:, 0], windows[:, -1] - windows[:, 0]
    if frame:
        states, change = flatten(frame.seen(windows, windows[:, :1])), jax.vmap(frame.changes)(windows)[:, -1]
    return Dataset(rows, starts, count, num_held_out, _scale(states), _scale(change, frame), views)


def holds_out(config: OptionsConfig) -> bool:
    """Return whether learning needs P's error on held-out windows."""
    return config.termination == "predict" and config.delta_unit == "quantile"


def _candidates(experience: Experience, config: OptionsConfig, first_part: int) -> tuple[Array, Array, Array]:
    """Return for every row the score of the window that starts there, or NaN, its part, and whether it is held out."""
    num_ticks, num_envs = experience.reward.shape
    score, valid = window_score(experience.reward, experience.done, config.length)
    tick = jnp.arange(num_ticks)
    share = tick.astype(jnp.float32) / num_ticks
    valid = valid & ((config.since <= share) & (share < config.until))[:, None]
    part = ((share - config.since) / (config.until - config.since) * config.parts).astype(jnp.int32)
    held_out = (tick // (STRETCH * config.length)) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    held_out = held_out & holds_out(config)
    return (
        flatten(jnp.where(valid, score, jnp.nan)),
        jnp.tile(first_part + jnp.clip(part, 0, config.parts - 1), num_envs),
        jnp.tile(held_out, num_envs),
    )


def _select(
    score: Float[Array, " R"], part: Int[Array, " R"], num_parts: int, config: OptionsConfig
) -> tuple[Int[Array, " R"], Array]:
    """Return the rows in order of part and score, and which of them, in this order, are selected."""
    order = jnp.lexsort((-score, part))
    part = part[order]
    sizes = jnp.bincount(part, length=num_parts + 1)
    rank = jnp.arange(len(part)) - (jnp.cumsum(sizes) - sizes)[part]
    share = config.fraction if config.select == "top" else 1.0
    quota = jnp.maximum((sizes.astype(jnp.float32) * share).astype(jnp.int32), 1)
    return order, (rank < quota[part]) & (part < num_parts)


def flatten(x: Array) -> Array:
    """Join the axes T and B to rows, one environment after another."""
    return jnp.swapaxes(x, 0, 1).reshape((-1, *x.shape[2:]))


def _scale(x: Float[Array, "N P"], frame: Frame | None = None) -> Scale:
    # A constant entry, such as a fixed coordinate of an arena, must not be amplified.
    std = jnp.std(x, axis=0)
    std = jnp.where(std < 1e-4, 1.0, std)
    if frame and frame.weight:  # the way comes last
        std = std.at[-frame.way_size :].divide(math.sqrt(frame.weight))
    return Scale(jnp.mean(x, axis=0), std)


def gather(
    dataset: Dataset,
    which: Int[Array, " N"],
    ticks: Int[Array, " N"],
    length: int,
    view: Int[Array, " N"] | None = None,
) -> Window:
    """Return the windows at positions `which` of `starts`, of `ticks` <= `length` ticks each; leading axis N.

    Each has its `view`, by default the recorded one.
    """
    rows = dataset.starts[which][:, None] + jnp.arange(length + 1)[None]
    mask = jnp.arange(length)[None] < ticks[:, None]
    states, actions = dataset.experience.obs[rows], dataset.experience.action[rows[:, :-1]]
    if view is not None:
        states, actions = jax.vmap(dataset.views.obs)(view, states), jax.vmap(dataset.views.action)(view, actions)
    return Window(states, actions, mask)
