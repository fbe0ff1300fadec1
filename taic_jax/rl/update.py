"""PPO's updates: clipped losses of minibatches of decisions, in epochs; other ticks take no part in them."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from taic_jax.config import PPOConfig
from taic_jax.networks import Policy, PolicyParams
from taic_jax.types import Scalar, Tree

LOSSES = ("policy_loss", "value_loss", "entropy", "approx_kl", "clip_fraction")


class Decisions(struct.PyTreeNode):
    """R decisions, the input of the loss."""

    obs: Array
    option: Array
    log_prob: Array
    advantage: Array
    target: Array


def make_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Return Adam behind global-norm clipping on one flat vector; `descend` applies the step size."""
    clip = optax.clip_by_global_norm(config.max_grad_norm)
    return optax.flatten(optax.chain(clip, optax.scale_by_adam(eps=1e-5)))


def descend(
    config: PPOConfig, learning_rate: Scalar, gradient: Any, params: Tree, optimizer: optax.OptState
) -> tuple[Tree, optax.OptState]:
    """Take one step of the optimiser; return the next parameters and its next state."""
    with jax.numpy_dtype_promotion("standard"):  # Optax raises a float to an integer power
        updates, optimizer = make_optimizer(config).update(gradient, optimizer)
    return jax.tree.map(lambda p, u: p - learning_rate * u, params, updates), optimizer


def ppo_loss(
    params: PolicyParams,
    policy: Policy,
    batch: Decisions,
    weight: Float[Array, " M"],
    config: PPOConfig,
) -> tuple[Float[Array, ""], Float[Array, "5"]]:
    """Return the clipped loss of M decisions, averaged with weights that sum to one, and its terms."""
    distribution = policy.distribution(params, batch.obs)
    log_ratio = distribution.log_prob(batch.option) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    policy_loss = -jnp.sum(weight * jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))
    value_loss = 0.5 * jnp.sum(weight * jnp.square(policy.value(params, batch.obs) - batch.target))
    entropy = jnp.sum(weight * distribution.entropy())
    loss = policy_loss + config.value_weight * value_loss - config.entropy_weight * entropy
    loss = loss + config.prior_weight * jnp.sum(weight * policy.divergence(distribution))
    approx_kl = jnp.sum(weight * (ratio - 1.0 - log_ratio))
    clip_fraction = jnp.sum(weight, where=jnp.abs(ratio - 1.0) > config.clip)
    return loss, jnp.stack([policy_loss, value_loss, entropy, approx_kl, clip_fraction])


class Update(struct.PyTreeNode):
    """The carry of updates: parameters, optimiser state, and the sum of the loss terms."""

    params: PolicyParams
    optimizer: optax.OptState
    terms: Array


def _minibatch(
    policy: Policy,
    config: PPOConfig,
    learning_rate: Scalar,
    rows: Decisions,
    count: Int[Array, ""],
    num_minibatches: Int[Array, ""],
    index: Int[Array, ""],
    carry: Update,
) -> Update:
    """Take one gradient step on the `index`-th of `num_minibatches` nearly equal parts of `count` rows."""
    size, rest = count // num_minibatches, count % num_minibatches
    first = index * size + jnp.minimum(index, rest)
    size = size + (index < rest).astype(jnp.int32)
    batch = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, first, config.minibatch_size), rows)
    weight = jnp.where(jnp.arange(config.minibatch_size) < size, 1.0 / size.astype(jnp.float32), 0.0)
    gradient, terms = jax.grad(ppo_loss, has_aux=True)(carry.params, policy, batch, weight, config)
    params, optimizer = descend(config, learning_rate, gradient, carry.params, carry.optimizer)
    return Update(params, optimizer, carry.terms + terms)


def shuffled(chosen: Bool[Array, " R"], key: Key[Array, ""]) -> UInt32[Array, " R"]:
    """Return the rows' indices: the chosen ones first, in random order.

    Index and random bits are sorted as one integer, which XLA does four times as fast as it sorts pairs. Rows of
    equal bits keep their order, which matters only at an edge between minibatches.
    """
    width = max(1, (len(chosen) - 1).bit_length())
    index = jnp.arange(len(chosen), dtype=jnp.uint32)
    above = jax.random.bits(key, chosen.shape, jnp.uint32) >> (width + 1) << width
    last = (~chosen).astype(jnp.uint32) << 31
    return jnp.sort(last | above | index) & jnp.uint32(2**width - 1)


def _epoch(
    policy: Policy,
    config: PPOConfig,
    learning_rate: Scalar,
    packed: Float[Array, "R F"],
    unpack: Callable[[Array], Decisions],
    decision: Array,
    carry: Update,
    key: Key[Array, ""],
) -> tuple[Update, None]:
    """Pass once over all decisions in random order, in as many minibatches as they fill."""
    count = jnp.sum(decision, dtype=jnp.int32)
    num_minibatches = (count + config.minibatch_size - 1) // config.minibatch_size
    # The ticks between decisions are beyond the last minibatch.
    rows = unpack(jnp.pad(packed[shuffled(decision, key)], ((0, config.minibatch_size), (0, 0))))
    step = partial(_minibatch, policy, config, learning_rate, rows, count, num_minibatches)
    return jax.lax.fori_loop(0, num_minibatches, step, carry), None


def update(
    policy: Policy,
    config: PPOConfig,
    learning_rate: Scalar,
    params: PolicyParams,
    optimizer: optax.OptState,
    decisions: Decisions,
    decision: Array,
    key: Key[Array, ""],
) -> Update:
    """Run all epochs over the decisions among R ticks."""
    # One matrix, so that a permutation is a single gather.
    packed = jax.vmap(lambda row: ravel_pytree(row)[0])(decisions)
    unpack = jax.vmap(ravel_pytree(jax.tree.map(lambda x: x[0], decisions))[1])
    carry = Update(params, optimizer, jnp.zeros(len(LOSSES)))
    epoch = partial(_epoch, policy, config, learning_rate, packed, unpack, decision)
    carry, _ = jax.lax.scan(epoch, carry, jax.random.split(key, config.epochs))
    return carry
