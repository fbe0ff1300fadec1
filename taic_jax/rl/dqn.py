"""Double DQN over discrete options or discrete actions (§5): its network, its loss, its gradient step.

A decision is judged by its semi-Markov target r_{t..t+k} + gamma^k Q'(s_{t+k}, o), in which o is the best option by the
network and Q' its delayed copy.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Key

from taic_jax.config import DQNConfig
from taic_jax.networks import GreedyParams, GreedyPolicy
from taic_jax.options.execution import Executor
from taic_jax.rl import off_policy
from taic_jax.rl.off_policy import Rule, descend, follow, make_optimizer
from taic_jax.rl.replay import Transition

TERMS = ("value_loss", "value", "epsilon")


class Learnt(struct.PyTreeNode):
    """All that gradient steps change: the parameters, and the state of their optimiser."""

    policy: GreedyParams
    targets: Any
    optimizer: optax.OptState


def make_policy(executor: Executor, config: DQNConfig) -> GreedyPolicy:
    """Return the policy over the executor's discrete options."""
    return GreedyPolicy(executor.option_size, tuple(config.hidden_sizes), config.layer_norm)


def init_learnt(config: DQNConfig, executor: Executor, observation_size: int, key: Key[Array, ""]) -> Learnt:
    """Return a fresh network, with which every option is a random one."""
    policy = make_policy(executor, config).init(key, observation_size, 1.0)
    return Learnt(policy, policy.values, make_optimizer().init(policy.values))


def update(
    config: DQNConfig, executor: Executor, learnt: Learnt, batch: Transition, key: Key[Array, ""]
) -> tuple[Learnt, Float[Array, "3"]]:
    """Take one gradient step on M transitions of normalised observations; return the terms of the loss."""
    target = double_target(learnt.policy.values, make_policy(executor, config), learnt.targets, batch)
    return step_towards(config, executor, learnt, batch, target)


def step_towards(
    config: DQNConfig, executor: Executor, learnt: Learnt, batch: Transition, target: Float[Array, " M"]
) -> tuple[Learnt, Float[Array, "3"]]:
    """Bring the values of the chosen options one gradient step nearer to their targets."""
    values, epsilon = learnt.policy.values, learnt.policy.epsilon
    gradient, terms = jax.grad(dqn_loss, has_aux=True)(values, make_policy(executor, config), batch, target)
    values, optimizer = descend(config, gradient, values, learnt.optimizer)
    fallen = jnp.maximum(epsilon - (1.0 - config.epsilon) / config.epsilon_steps, config.epsilon)
    targets = follow(config, learnt.targets, values)
    return Learnt(GreedyParams(values, fallen), targets, optimizer), jnp.append(terms, epsilon)


def dqn_loss(
    values: Any, policy: GreedyPolicy, batch: Transition, target: Float[Array, " M"]
) -> tuple[Float[Array, ""], Float[Array, "2"]]:
    """Return the mean squared error of the values of the chosen options, and the mean value."""
    chosen = jnp.sum(policy.evaluate(values, batch.obs) * batch.option, axis=-1)
    loss = jnp.mean(jnp.square(chosen - target))
    return loss, jnp.stack([loss, jnp.mean(chosen)])


def double_target(values: Any, policy: GreedyPolicy, targets: Any, batch: Transition) -> Float[Array, " M"]:
    """Return r_{t..t+k} + gamma^k Q'(s_{t+k}, argmax Q(s_{t+k}, .)); an end of the task has no second term."""
    best = jnp.argmax(policy.evaluate(values, batch.next_obs), axis=-1)
    after = jnp.take_along_axis(policy.evaluate(targets, batch.next_obs), best[:, None], axis=-1)[:, 0]
    return batch.reward + batch.discount * after


RULE = Rule(make_policy, init_learnt, update, TERMS)
init = partial(off_policy.init, RULE)
iterate = partial(off_policy.iterate, RULE)
as_agent = partial(off_policy.as_agent, RULE)
