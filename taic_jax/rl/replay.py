"""A replay buffer of decisions, each with the discounted rewards of its option's ticks; bounded, and inside `jit`."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key

from taic_jax.rl.rollout import Rollout
from taic_jax.types import Scalar, select


class Transition(struct.PyTreeNode):
    """A decision and its option's outcome after k ticks: the arrays of a semi-Markov target.

    `reward` is r_{t..t+k} = r_t + gamma r_{t+1} + ...; `discount` is gamma^k, or zero if the task ended.
    """

    obs: Array
    option: Array
    reward: Array
    discount: Array
    next_obs: Array


class Replay(struct.PyTreeNode):
    """The newest `capacity` transitions as rows [C, F] of one matrix, and the number of all that were ever added."""

    rows: Array
    count: Array


def init(capacity: int, observation_size: int, option_size: int) -> Replay:
    """Return an empty buffer, of `replay_bytes`."""
    return Replay(jnp.zeros((capacity, 2 * observation_size + option_size + 2)), jnp.zeros((), jnp.int32))


def replay_bytes(capacity: int, observation_size: int, option_size: int) -> int:
    """Return the bytes of a buffer of one seed."""
    return 4 * capacity * (2 * observation_size + option_size + 2)


def init_pending(num_envs: int, observation_size: int, option_size: int) -> Transition:
    """Return the transitions [B] of options that have not begun."""
    zeros, obs = jnp.zeros(num_envs), jnp.zeros((num_envs, observation_size))
    return Transition(obs, jnp.zeros((num_envs, option_size)), zeros, zeros, obs)


def complete(pending: Transition, ticks: Rollout, gamma: Scalar) -> tuple[Transition, Transition]:
    """Add ticks [T, B] to the options that run; return those pending [B], and a transition per tick [T, B].

    Only transitions of ticks that end an option are meaningful. Options may outlast the ticks.
    """

    def tick(running: Transition, now: Rollout) -> tuple[Transition, Transition]:
        zeros = jnp.zeros_like(now.reward)
        fresh = Transition(now.obs, now.option, zeros, zeros + 1.0, now.obs)
        running = select(now.decision, fresh, running)
        running = running.replace(
            reward=running.reward + running.discount * now.reward,
            discount=gamma * running.discount,
            next_obs=now.final_obs,
        )
        return running, running.replace(discount=jnp.where(now.terminated, 0.0, running.discount))

    return jax.lax.scan(tick, pending, ticks.replace(extras=None, noise=None))


def add(replay: Replay, transitions: Transition, chosen: Bool[Array, "T B"]) -> Replay:
    """Add the chosen of these transitions [T, B], in the order of ticks, in place of the oldest."""
    rows = jax.vmap(lambda row: ravel_pytree(row)[0])(jax.tree.map(_flat, transitions))
    rank, capacity = jnp.cumsum(_flat(chosen), dtype=jnp.int32), len(replay.rows)
    place = jnp.where(_flat(chosen), (replay.count + rank - 1) % capacity, capacity)  # others are out of bounds
    return Replay(replay.rows.at[place].set(rows, mode="drop"), replay.count + rank[-1])


def sample(replay: Replay, key: Key[Array, ""], size: int, like: Transition) -> Transition:
    """Return `size` transitions, each uniform over the buffer; `like` [B] has their structure."""
    stored: Int[Array, ""] = jnp.minimum(replay.count, len(replay.rows))
    rows: Float[Array, "M F"] = replay.rows[jax.random.randint(key, (size,), 0, jnp.maximum(stored, 1))]
    return jax.vmap(ravel_pytree(jax.tree.map(lambda x: x[0], like))[1])(rows)


def _flat(x: Any) -> Array:
    return x.reshape((-1, *x.shape[2:]))
