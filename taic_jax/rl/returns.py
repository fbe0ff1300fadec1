"""Semi-Markov advantages (eq. 11-13) in one reverse scan over ticks."""

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from taic_jax.types import Scalar


class Judgement(struct.PyTreeNode):
    """Rewards, ends and the critic's values of T ticks of B environments.

    Attributes:
      reward: r_t, in the critic's scale.
      terminated: the task ended after tick t: the bootstrap is zero.
      truncated: the time limit cut the episode after tick t: bootstrap from `final_value`.
      value: V(s_t).
      final_value: V of the observation after tick t, before any reset.
      last_value: V(s_T) [B], the bootstrap of an option that the end of the rollout cuts.
    """

    reward: Array
    terminated: Array
    truncated: Array
    value: Array
    final_value: Array
    last_value: Array


def semi_markov_advantages(
    judgement: Judgement, ended: Bool[Array, "T B"], gamma: Scalar, lambda_: Scalar
) -> Float[Array, "T B"]:
    """Return the advantage of deciding at each tick; only entries at decisions are meaningful.

    For a decision at t whose option takes k ticks (eq. 11-13)

        delta_t = r_{t..t+k} + gamma^k V(s_{t+k}) - V(s_t),   A_t = delta_t + gamma^k lambda A_{t+k}.

    The scan carries Z_t = A_t + V(s_t): inside an option Z_t = r_t + gamma Z_{t+1}, and at its end
    Z_t = r_t + gamma (bootstrap + lambda A_{t+1}). With every option one tick long this is GAE.

    Args:
      judgement: rewards, values and ends of episodes.
      ended: the running option ended after tick t (an episode's end ends it too).
      gamma: discount per tick.
      lambda_: decay per decision.
    """
    value, last_value = judgement.value, judgement.last_value
    next_value = jnp.concatenate([value[1:], last_value[None]])
    after_cut = jnp.where(judgement.truncated, judgement.final_value, next_value)
    bootstrap = jnp.where(judgement.terminated, 0.0, after_cut)
    carries_on = ~(judgement.terminated | judgement.truncated)
    ended = ended.at[-1].set(True)

    def tick(carry: tuple[Array, Array], step: tuple[Array, ...]) -> tuple[tuple[Array, Array], Array]:
        z_next, advantage_next = carry
        reward_t, ended_t, carries_on_t, bootstrap_t, value_t = step
        at_end = bootstrap_t + lambda_ * jnp.where(carries_on_t, advantage_next, 0.0)
        z = reward_t + gamma * jnp.where(ended_t, at_end, z_next)
        return (z, z - value_t), z - value_t

    with jax.numpy_rank_promotion("allow"):
        start = (last_value, jnp.zeros_like(last_value))
        steps = (judgement.reward, ended, carries_on, bootstrap, value)
        _, advantages = jax.lax.scan(tick, start, steps, reverse=True)
    return advantages
