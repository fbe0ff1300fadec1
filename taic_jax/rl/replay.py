"""A replay buffer of decisions, each with the discounted rewards of its option's ticks; bounded, and inside `jit`."""

import jax
import jax.numpy as jnp
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Key

from taic_jax.envs.base import Goals
from taic_jax.rl.rollout import Rollout
from taic_jax.types import Scalar, select

HALVINGS = 8  # of a leap into the future that would leave the episode


class Transition(struct.PyTreeNode):
    """A decision and its option's outcome after k ticks: the arrays of a semi-Markov target.

    `reward` is r_{t..t+k} = r_t + gamma r_{t+1} + ...; `discount` is gamma^k, or zero if the task ended. For hindsight,
    `trail` [L, Q] has the goals achieved after each of the k = `ticks` ticks; without it Q is 0.
    """

    obs: Array
    option: Array
    reward: Array
    discount: Array
    next_obs: Array
    trail: Array
    ticks: Array
    episode: Array


class Replay(struct.PyTreeNode):
    """The newest transitions of each environment as rows [B, C, F], and the number [B] of all that were ever added."""

    rows: Array
    count: Array


def row_size(observation_size: int, option_size: int, length: int, goal_size: int) -> int:
    """Return F, the numbers of a transition."""
    return 2 * observation_size + option_size + length * goal_size + 4


def init(capacity: int, like: Transition) -> Replay:
    """Return an empty buffer for `capacity` transitions of environments [B] such as `like`."""
    num_envs, size = len(like.reward), sum(x[0].size for x in jax.tree.leaves(like))
    return Replay(jnp.zeros((num_envs, capacity // num_envs, size)), jnp.zeros(num_envs, jnp.int32))


def init_pending(num_envs: int, observation_size: int, option_size: int, length: int, goal_size: int) -> Transition:
    """Return the transitions [B] of options that have not begun."""
    zeros, obs = jnp.zeros(num_envs), jnp.zeros((num_envs, observation_size))
    option, trail = jnp.zeros((num_envs, option_size)), jnp.zeros((num_envs, length, goal_size))
    return Transition(obs, option, zeros, zeros, obs, trail, zeros, zeros)


def complete(
    pending: Transition, ticks: Rollout, gamma: Scalar, goals: Goals | None = None
) -> tuple[Transition, Transition]:
    """Add ticks [T, B] to the options that run; return those pending [B], and a transition per tick [T, B].

    Only transitions of ticks that end an option are meaningful. Options may outlast the ticks.
    """

    def tick(running: Transition, now: Rollout) -> tuple[Transition, Transition]:
        zeros = jnp.zeros_like(now.reward)
        fresh = running.replace(obs=now.obs, option=now.option, reward=zeros, discount=zeros + 1.0, ticks=zeros)
        running = select(now.decision, fresh, running)
        if goals is not None:
            put = jax.vmap(lambda trail, tick, goal: trail.at[tick].set(goal))
            achieved = jax.vmap(goals.achieved)(now.final_obs)
            running = running.replace(trail=put(running.trail, running.ticks.astype(jnp.int32), achieved))
        running = running.replace(
            reward=running.reward + running.discount * now.reward,
            discount=gamma * running.discount,
            next_obs=now.final_obs,
            ticks=running.ticks + 1.0,
        )
        done = (now.terminated | now.truncated).astype(jnp.float32)
        ended = running.replace(discount=jnp.where(now.terminated, 0.0, running.discount))
        return running.replace(episode=running.episode + done), ended

    return jax.lax.scan(tick, pending, ticks.replace(extras=None, noise=None))


def add(replay: Replay, transitions: Transition, chosen: Bool[Array, "T B"]) -> Replay:
    """Add the chosen of these transitions [T, B], in the order of ticks, in place of their environment's oldest."""

    def one(rows: Array, count: Array, new: Array, chosen: Array) -> tuple[Array, Array]:
        rank, capacity = jnp.cumsum(chosen, dtype=jnp.int32), len(rows)
        place = jnp.where(chosen, (count + rank - 1) % capacity, capacity)  # others are out of bounds
        return rows.at[place].set(new, mode="drop"), count + rank[-1]

    packed = jax.vmap(jax.vmap(lambda row: ravel_pytree(row)[0]))(transitions)
    return Replay(*jax.vmap(one, in_axes=(0, 0, 1, 1))(replay.rows, replay.count, packed, chosen))


def sample(
    replay: Replay, key: Key[Array, ""], size: int, like: Transition, horizon: int = 0
) -> tuple[Transition, Transition]:
    """Return `size` transitions, each uniform over the buffer, and one of the same episode up to `horizon` later.

    `like` [B] has their structure. Environments are drawn in proportion to their transitions.
    """
    key_env, key_age, key_later = jax.random.split(key, 3)
    capacity = replay.rows.shape[1]
    stored = jnp.minimum(replay.count, capacity).astype(jnp.float32)
    env = jax.random.categorical(key_env, jnp.log(stored), shape=(size,))
    age = (jax.random.uniform(key_age, (size,)) * stored[env]).astype(jnp.int32)

    def at(age: Array) -> Transition:
        return unpack(replay.rows[env, (replay.count[env] - 1 - age) % capacity])

    unpack = jax.vmap(ravel_pytree(jax.tree.map(lambda x: x[0], like))[1])
    batch = at(age)
    longest = jnp.minimum(age, horizon).astype(jnp.float32)
    leap = (jax.random.uniform(key_later, (size,)) * (longest + 1.0)).astype(jnp.int32)
    later = batch
    for halving in reversed(range(HALVINGS if horizon else 0)):
        other = at(age - (leap >> halving))
        later = select(other.episode == batch.episode, other, later)
    return batch, later


def relabelled(batch: Transition, later: Transition, gamma: Scalar, goals: Goals) -> Transition:
    """Return transitions whose goal is the one that a later transition achieved at its end, with the rewards for it."""

    def one(transition: Transition, later: Transition) -> Transition:
        goal = later.trail[later.ticks.astype(jnp.int32) - 1]
        reward, terminated = jax.vmap(goals.reward, in_axes=(0, None))(transition.trail, goal)
        tick = jnp.arange(len(reward), dtype=jnp.float32)
        before = jnp.cumsum(terminated, dtype=jnp.int32) > terminated.astype(jnp.int32)
        lived = (tick < transition.ticks) & ~before
        discounts = gamma**tick
        return transition.replace(
            obs=goals.aim(transition.obs, goal),
            next_obs=goals.aim(transition.next_obs, goal),
            reward=jnp.sum(jnp.where(lived, discounts * reward, 0.0)),
            discount=jnp.where(jnp.any(lived & terminated), 0.0, gamma**transition.ticks),
        )

    return jax.vmap(one)(batch, later)
