"""Soft actor-critic over options (§5): its networks, its losses, its gradient step; flat with the identity executor.

A decision is judged by its semi-Markov target r_{t..t+k} + gamma^k V(s_{t+k}), in which
V(s) = min Q(s, o) - temperature log pi(o|s) for an option o drawn from pi, and min is of two critics.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Key

from taic_jax.config import SACConfig
from taic_jax.networks import Critics, SquashedParams, SquashedPolicy
from taic_jax.options.execution import Executor, IdentityExecutor
from taic_jax.rl import off_policy
from taic_jax.rl.off_policy import Rule, descend, follow, make_optimizer
from taic_jax.rl.replay import Transition
from taic_jax.types import Scalar

TERMS = ("critic_loss", "actor_loss", "value", "entropy", "temperature")


class Learnt(struct.PyTreeNode):
    """All that gradient steps change: the parameters, and the state of their optimiser."""

    policy: SquashedParams
    critics: Any
    log_temperature: Array
    targets: Any
    optimizer: optax.OptState


def make_policy(executor: Executor, config: SACConfig) -> SquashedPolicy:
    """Return the policy over the executor's options."""
    return SquashedPolicy(executor.option_size, tuple(config.hidden_sizes))


def make_critics(config: SACConfig) -> Critics:
    """Return the critics' networks."""
    return Critics(tuple(config.hidden_sizes), config.layer_norm)


def init_learnt(config: SACConfig, executor: Executor, observation_size: int, key: Key[Array, ""]) -> Learnt:
    """Return fresh networks; actions have the bound 1, codes that of the config."""
    key_actor, key_critics = jax.random.split(key)
    bound = 1.0 if isinstance(executor, IdentityExecutor) else config.bound
    policy = make_policy(executor, config).init(key_actor, observation_size, bound)
    critics = make_critics(config).init(key_critics, observation_size, executor.option_size)
    log_temperature = jnp.log(jnp.asarray(config.temperature, jnp.float32))
    optimizer = make_optimizer().init((policy.actor, critics, log_temperature))
    return Learnt(policy, critics, log_temperature, critics, optimizer)


def update(
    config: SACConfig, executor: Executor, learnt: Learnt, batch: Transition, key: Key[Array, ""]
) -> tuple[Learnt, Float[Array, "5"]]:
    """Take one gradient step on M transitions of normalised observations; return the terms of the loss."""
    params = learnt.policy.actor, learnt.critics, learnt.log_temperature
    noise = jax.random.normal(key, (2, config.batch_size, executor.option_size))
    gradient, terms = jax.grad(sac_loss, has_aux=True)(params, config, executor, learnt, batch, noise)
    (actor, critics, log_temperature), optimizer = descend(config, gradient, params, learnt.optimizer)
    targets = follow(config, learnt.targets, critics)
    return Learnt(learnt.policy.replace(actor=actor), critics, log_temperature, targets, optimizer), terms


def sac_loss(
    params: Any, config: SACConfig, executor: Executor, learnt: Learnt, batch: Transition, noise: Float[Array, "2 M D"]
) -> tuple[Float[Array, ""], Float[Array, "5"]]:
    """Return the sum of the losses of critics, actor and temperature, none of which moves another's parameters."""
    actor, critics, log_temperature = params
    policy, networks = make_policy(executor, config), make_critics(config)
    bound, temperature = learnt.policy.bound, jax.lax.stop_gradient(jnp.exp(log_temperature))
    target = jax.lax.stop_gradient(semi_markov_target(config, policy, networks, learnt, temperature, batch, noise[0]))
    values = networks.values(critics, batch.obs, batch.option / bound)
    critic_loss = jnp.sum(jnp.mean(jnp.square(values - target[None]), axis=1))
    option, log_prob = policy.draw(learnt.policy.replace(actor=actor), batch.obs, 1.0, noise[1])
    value = both(config, networks.values(jax.lax.stop_gradient(critics), batch.obs, option / bound))
    actor_loss = jnp.mean(cost(config, bound, temperature, option, log_prob) - value)
    entropy = -jax.lax.stop_gradient(jnp.mean(log_prob))
    temperature_loss = log_temperature * (entropy - config.target_entropy * executor.option_size)
    terms = jnp.stack([critic_loss, actor_loss, jnp.mean(value), entropy, temperature])
    return critic_loss + actor_loss + temperature_loss, terms


def semi_markov_target(
    config: SACConfig,
    policy: SquashedPolicy,
    networks: Critics,
    learnt: Learnt,
    temperature: Scalar,
    batch: Transition,
    noise: Float[Array, "M D"],
) -> Float[Array, " M"]:
    """Return r_{t..t+k} + gamma^k V(s_{t+k}) with the target critics; an end of the task has no V."""
    option, log_prob = policy.draw(learnt.policy, batch.next_obs, 1.0, noise)
    values = networks.values(learnt.targets, batch.next_obs, option / learnt.policy.bound)
    value = both(config, values) - cost(config, learnt.policy.bound, temperature, option, log_prob)
    return batch.reward + batch.discount * value


def both(config: SACConfig, values: Float[Array, "2 M"]) -> Float[Array, " M"]:
    """Return the value that two critics together give: between the lower, with a pessimism of 1, and the mean."""
    low = jnp.min(values, axis=0)
    return low + (1.0 - config.pessimism) * (jnp.mean(values, axis=0) - low)


def cost(
    config: SACConfig, bound: Scalar, temperature: Scalar, option: Float[Array, "M D"], log_prob: Float[Array, " M"]
) -> Float[Array, " M"]:
    """Return temperature log pi(o|s); or prior_weight log(pi(o|s) / p(o)), whose mean is a KL divergence from N(0, I).

    `log_prob` is the density of the option in units of its bound, so that of the prior is too.
    """
    log_prior = jnp.sum(jax.scipy.stats.norm.logpdf(option) + jnp.log(bound), axis=-1)
    near_prior = config.prior_weight * (log_prob - log_prior)
    return jnp.where(config.prior_weight > 0.0, near_prior, temperature * log_prob)


RULE = Rule(make_policy, init_learnt, update, TERMS)
init = partial(off_policy.init, RULE)
iterate = partial(off_policy.iterate, RULE)
as_agent = partial(off_policy.as_agent, RULE)
