"""Options in lockstep ticks: one rollout of both levels.

Every environment takes one real step per tick. The policy decides on a new option in those whose last option ended;
then the executor emits the next action; then the termination rule decides whether the option ends.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Key

from taic_jax.envs.base import Env, State
from taic_jax.options.execution import Executor
from taic_jax.runtime.devices import over_envs
from taic_jax.types import select

DecideFn = Callable[[Array, Array], tuple[Array, Array]]
"""(observations [B, S], standard normal noise [B, D]) -> (options [B, D], log-probabilities [B])."""


class RolloutCarry(struct.PyTreeNode):
    """The state between two ticks, leading axis B."""

    env: State
    option: Any
    duration: Array
    ended: Array
    episode_return: Array
    last_return: Array


class Rollout(struct.PyTreeNode):
    """T ticks of B environments; `option` and `log_prob` are meaningful only at decisions.

    `duration` counts the ticks of the running option, this one included; `noise` [T, B, Z] has all random numbers: D
    for the policy, then those of the executor.
    """

    obs: Array
    option: Array
    log_prob: Array
    decision: Array
    action: Array
    reward: Array
    ended: Array
    duration: Array
    terminated: Array
    truncated: Array
    final_obs: Array
    episode_return: Array
    extras: Any
    noise: Any = None


def start(
    env: Env, executor: Executor, num_envs: int, key: Key[Array, ""], stagger: bool = False
) -> RolloutCarry:  # fmt: skip
    """Reset `num_envs` environments; every one of them decides at its first tick.

    With `stagger` their first episodes begin at random ticks, and have no return: else all would be in the same part of
    an episode for ever, if its end is the time limit's.
    """
    state: Any = jax.vmap(env.reset)(jax.random.split(key, num_envs))
    options = jax.vmap(executor.start)(jnp.zeros((num_envs, executor.option_size)), state.obs)
    total, never = jnp.zeros(num_envs), jnp.full(num_envs, jnp.nan, jnp.float32)
    if stagger:
        key_ticks = jax.random.fold_in(key, num_envs)  # the resets of other tasks stay as they were
        state = state.replace(tick=jax.random.randint(key_ticks, (num_envs,), 0, env.episode_length))
        total = jnp.where(state.tick > 0, never, total)
    return RolloutCarry(state, options, jnp.zeros(num_envs, jnp.int32), jnp.ones(num_envs, bool), total, never)


def _tick(
    env: Env,
    executor: Executor,
    decide: DecideFn,
    keep: Callable[[State], Any],
    running: RolloutCarry,
    noise: Float[Array, "B Z"],
) -> tuple[RolloutCarry, Rollout]:
    obs, decision = running.env.obs, running.ended
    chance = noise[:, executor.option_size :]
    option, log_prob = decide(obs, noise[:, : executor.option_size])
    carry, action = jax.vmap(executor.act)(_begin(executor, decision, option, obs, running.option), obs, chance)
    state: Any = jax.vmap(env.step)(running.env, action)
    done = state.terminated | state.truncated
    duration = jnp.where(decision, 0, running.duration) + 1
    ended = jax.vmap(executor.ended)(carry, state.final_obs, chance)
    ended = ended | (duration >= executor.length) | done
    total = running.episode_return + state.reward
    tick = Rollout(
        obs=obs, option=option, log_prob=log_prob, decision=decision, action=action, reward=state.reward,
        ended=ended, duration=duration, terminated=state.terminated, truncated=state.truncated,
        final_obs=state.final_obs, episode_return=total, extras=keep(state),
    )  # fmt: skip
    last_return = jnp.where(done, total, running.last_return)
    return RolloutCarry(state, carry, duration, ended, jnp.where(done, 0.0, total), last_return), tick


def _begin(
    executor: Executor, decision: Bool[Array, " B"], option: Float[Array, "B D"], obs: Float[Array, "B S"], running: Any
) -> Any:
    """Return the running options, with new ones where an environment decides.

    If `start` is costly, a few environments begin at a time, in as many rounds as there are decisions: most ticks have
    few of these.
    """
    few = min(executor.at_once, len(decision))
    if not few:
        return select(decision, jax.vmap(executor.start)(option, obs), running)
    order = jnp.argsort(~decision)

    def begin(index: Any, options: Any) -> Any:
        rows = jax.lax.dynamic_slice_in_dim(order, index * few, few)
        fresh, old = jax.vmap(executor.start)(option[rows], obs[rows]), jax.tree.map(lambda x: x[rows], options)
        return jax.tree.map(lambda x, y: x.at[rows].set(y), options, select(decision[rows], fresh, old))

    return jax.lax.fori_loop(0, -(-jnp.sum(decision) // few), begin, running)


def nothing(state: State) -> None:
    """Keep no extras of a tick."""


def pack_metrics(state: State) -> Array:
    """Return the metrics of a tick as one array, in the order of their names: each array slows the loop down."""
    return (
        jnp.stack([state.metrics[name] for name in sorted(state.metrics)], axis=-1) if state.metrics else state.reward
    )


def rollout_metrics(running: RolloutCarry, ticks: Rollout, length: int) -> dict[str, Array]:
    """Return scalars of ticks whose extras are packed and, if options take more than one tick, their durations [L]."""
    count = jnp.sum(ticks.decision, dtype=jnp.float32)
    return {
        # The mean over each environment's last finished episode; NaN before the first.
        "return": jnp.nanmean(running.last_return),
        "episodes": jnp.sum(ticks.terminated | ticks.truncated, dtype=jnp.float32),
        "decisions": count,
        "duration": ticks.decision.size / count,
        **{f"mean/{name}": jnp.mean(ticks.extras[..., i]) for i, name in enumerate(sorted(running.env.metrics))},
        **({"durations": count_durations(ticks, length)} if length > 1 else {}),
    }


def count_durations(ticks: Rollout, length: int, where: Array | bool = True) -> Float[Array, " L"]:
    """Return the number of options that ended after 1, 2, ... `length` ticks, among ticks [T, B] with `where`."""
    ended = ticks.ended & where
    with jax.numpy_rank_promotion("allow"):
        counts = ended[..., None] & (ticks.duration[..., None] == jnp.arange(1, length + 1))
    return jnp.sum(counts, axis=(0, 1)).astype(jnp.float32)


def rollout(
    env: Env,
    executor: Executor,
    decide: DecideFn,
    running: RolloutCarry,
    key: Key[Array, ""],
    length: int,
    keep: Callable[[State], Any] = nothing,
) -> tuple[RolloutCarry, Rollout]:
    """Run `length` ticks of every environment.

    Args:
      env: an environment that resets itself (`AutoReset`).
      running: the result of `start` or of the previous rollout.
      keep: the extras to record of the state after each tick (before a reset: reward and metrics only).
    """
    num_envs = running.ended.shape[0]
    noise = jax.random.normal(key, (length, num_envs, executor.option_size + executor.noise_size))
    scan = partial(jax.lax.scan, partial(_tick, env, executor, decide, keep))
    running, ticks = over_envs(scan, num_envs)(running, noise)
    return running, ticks.replace(noise=noise)
