"""Running statistics of observations and rewards, on top of Brax's maintained implementation."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from taic_jax.envs.third_party import third_party
from taic_jax.types import Scalar

with third_party():
    from brax.training.acme import running_statistics

Statistics = running_statistics.RunningStatisticsState
"""Mean and standard deviation of all data so far, with a 64-bit count."""


CARRIED = 100_000  # observations that carried statistics count as, those of several rollouts
CLIP = 10.0


def init(shape: tuple[int, ...] = ()) -> Statistics:
    """Return statistics without data: mean 0, standard deviation 1."""
    return running_statistics.init_state(jnp.zeros(shape))


def identity(size: int) -> Statistics:
    """Return statistics of mean 0 and standard deviation 1 that count as 2^32 observations: more do not change them."""
    fresh: Any = init((size,))
    return fresh.replace(
        count=fresh.count.replace(hi=jnp.ones_like(fresh.count.hi)), summed_variance=jnp.full(size, 2.0**32)
    )


def carry_over(statistics: Statistics, shared: int, size: int) -> Statistics:
    """Return statistics of `size` entries of which the first `shared` are those of another run.

    They count as `CARRIED` observations: a policy would see the body anew if the first rollout outweighed them, and
    entries of the task would never leave their mean of 0 and standard deviation of 1 if all observations counted.
    """
    source: Any = statistics
    mean = jnp.zeros(size).at[:shared].set(source.mean[:shared])
    std = jnp.ones(size).at[:shared].set(source.std[:shared])
    count = source.count
    count = count.replace(hi=jnp.zeros_like(count.hi), lo=jnp.full_like(count.lo, CARRIED))
    return source.replace(count=count, mean=mean, std=std, summed_variance=CARRIED * jnp.square(std))


def update(statistics: Statistics, batch: Float[Array, "..."]) -> Statistics:
    """Update statistics with a batch whose trailing axes have their shape."""
    # Brax broadcasts the mean over the batch axes implicitly.
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        return running_statistics.update(statistics, batch, validate_shapes=False)


def normalize(statistics: Statistics, x: Float[Array, "..."], clip: float = CLIP) -> Float[Array, "..."]:
    """Return (x - mean) / std, clipped to `clip` standard deviations."""
    mean: Any = statistics.mean
    std: Any = statistics.std
    with jax.numpy_rank_promotion("allow"):
        return jnp.clip((x - mean) / std, -clip, clip)


class RewardScale(struct.PyTreeNode):
    """Statistics of the running discounted return of each environment [B]."""

    statistics: Statistics
    discounted_return: Array


def init_reward_scale(num_envs: int) -> RewardScale:
    """Return the scale before the first reward."""
    return RewardScale(init(), jnp.zeros(num_envs))


def scale_rewards(
    scale: RewardScale, reward: Float[Array, "T B"], done: Bool[Array, "T B"], gamma: Scalar
) -> tuple[RewardScale, Float[Array, "T B"]]:
    """Divide rewards by the standard deviation of the discounted return, the new ticks included."""

    def tick(total: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        reward_t, done_t = step
        total = gamma * total + reward_t
        return jnp.where(done_t, 0.0, total), total

    with jax.numpy_rank_promotion("allow"):
        discounted_return, totals = jax.lax.scan(tick, scale.discounted_return, (reward, done))
        statistics = update(scale.statistics, totals)
        std: Any = statistics.std
        scaled = jnp.clip(reward / jnp.maximum(std, 1e-4), -10.0, 10.0)
    return RewardScale(statistics, discounted_return), scaled
