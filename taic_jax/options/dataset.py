"""Windows of experience: action sequences with their start and end states."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int

from taic_jax.config import OptionsConfig
from taic_jax.options.model import Scale


class Experience(struct.PyTreeNode):
    """T consecutive ticks of B environments; `obs` is the proprioceptive slice."""

    obs: Any
    action: Any
    reward: Any
    done: Any


class Window(struct.PyTreeNode):
    """One action sequence; `mask` [L] marks the actions that belong to it."""

    start: Array
    actions: Array
    end: Array
    mask: Array


class Dataset(struct.PyTreeNode):
    """Experience flattened to rows, and the rows at which a selected window starts.

    `starts` [T*B] is sorted best first and only its first `count` entries are valid: their number depends on
    the data, the array's size must not. Row t*B + b is environment b at tick t.
    """

    experience: Experience
    starts: Array
    count: Array
    state_scale: Scale
    change_scale: Scale


def window_score(reward: Float[Array, "T B"], done: Array, length: int) -> tuple[Float[Array, "T B"], Array]:
    """Return the reward collected over the `length` ticks from each tick, and whether no episode ends in them.

    The tick at which an episode ends is left out too: the state after it is the next episode's.
    """
    total, crosses = jnp.zeros_like(reward), jnp.zeros_like(done)
    for i in range(length):
        total = total + jnp.roll(reward, -i, axis=0)
        crosses = crosses | jnp.roll(done, -i, axis=0)
    inside = jnp.arange(reward.shape[0]) < reward.shape[0] - length
    return total, ~crosses & inside[:, None]


def make_dataset(experience: Experience, config: OptionsConfig) -> Dataset:
    """Select windows of `config.length` ticks and measure the scales over them.

    Windows start between the shares `since` and `until` of the experience. Of these, `select="top"` keeps the
    `fraction` that collected most reward (§4.2.2), `select="random"` keeps all.
    """
    num_ticks, num_envs = experience.reward.shape
    score, valid = window_score(experience.reward, experience.done, config.length)
    when = (jnp.arange(num_ticks, dtype=jnp.float32) / num_ticks)[:, None]
    valid = valid & (config.since <= when) & (when < config.until)
    score, valid = score.reshape(-1), valid.reshape(-1)
    count = jnp.sum(valid, dtype=jnp.int32)
    if config.select == "top":
        starts = jnp.argsort(jnp.where(valid, -score, jnp.inf))
        count = jnp.maximum((count.astype(jnp.float32) * config.fraction).astype(jnp.int32), 1)
    else:
        starts = jnp.argsort(~valid, stable=True)
    rows = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), experience)
    probe = starts[(jnp.arange(100_000.0) * (count.astype(jnp.float32) / 1e5)).astype(jnp.int32)]
    state = rows.obs[probe]
    change = rows.obs[probe + config.length * num_envs] - state
    return Dataset(rows, starts, count, _scale(state), _scale(change))


def _scale(x: Float[Array, "N P"]) -> Scale:
    # A constant entry (an arena's never-moving coordinate) must not be blown up.
    std = jnp.std(x, axis=0)
    return Scale(jnp.mean(x, axis=0), jnp.where(std < 1e-4, 1.0, std))


def gather(dataset: Dataset, which: Int[Array, " N"], length: int, num_envs: int) -> Window:
    """Return the windows at positions `which` of the selection, leading axis N."""
    start = dataset.starts[which]
    rows = start[:, None] + num_envs * jnp.arange(length)[None]
    experience = dataset.experience
    mask = jnp.ones((which.shape[0], length), bool)
    return Window(experience.obs[start], experience.action[rows], experience.obs[start + length * num_envs], mask)
