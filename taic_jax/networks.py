"""The policies' networks: Gaussian actors over options, and critics, three-layer MLPs (paper, §4)."""

from collections.abc import Callable, Sequence
from typing import Any

import distrax
import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Key

from taic_jax.types import Scalar


def apply(module: nn.Module, params: Any, *args: Any, **kwargs: Any) -> Any:
    """Return `module.apply(params, ...)`, typed loosely: Flax would name mutated variables too, and none are."""
    return module.apply(params, *args, **kwargs)


class MLP(nn.Module):
    """Dense layers with tanh, or another activation, between them; the last layer is linear.

    Initialised without QR: a batched QR inside a vmapped program can deadlock XLA's CPU runtime.
    """

    sizes: Sequence[int]
    last_scale: float = 1.0
    activation: Callable[[Array], Array] = nn.tanh
    layer_norm: bool = False

    @nn.compact
    def __call__(self, x: Float[Array, "*batch F"]) -> Float[Array, "*batch H"]:
        """Apply the layers to the last axis."""
        for size in self.sizes[:-1]:
            x = nn.Dense(size, kernel_init=nn.initializers.variance_scaling(2.0, "fan_in", "normal"))(x)
            x = self.activation(nn.LayerNorm()(x) if self.layer_norm else x)
        last = nn.initializers.variance_scaling(self.last_scale**2, "fan_in", "normal")
        return nn.Dense(self.sizes[-1], kernel_init=last)(x)


LOG_STD = (-5.0, 2.0)
"""Bounds of the log standard deviation of a squashed policy."""


class PolicyParams(struct.PyTreeNode):
    """Parameters of actor and critic; `log_std` [D] does not depend on the state."""

    actor: Any
    critic: Any
    log_std: Array


class Policy(struct.PyTreeNode):
    """pi(o|s) and V(s) of §3.5, batched over leading axes."""

    option_size: int = struct.field(pytree_node=False)
    hidden_sizes: tuple[int, ...] = struct.field(pytree_node=False)

    @property
    def _actor(self) -> MLP:
        return MLP((*self.hidden_sizes, self.option_size), last_scale=0.01)

    @property
    def _critic(self) -> MLP:
        return MLP((*self.hidden_sizes, 1))

    def init(self, key: Key[Array, ""], observation_size: int, log_std_init: Scalar) -> PolicyParams:
        """Return fresh parameters whose mean option is near zero."""
        key_actor, key_critic = jax.random.split(key)
        obs = jnp.zeros(observation_size)
        log_std = jnp.full(self.option_size, log_std_init, jnp.float32)
        return PolicyParams(self._actor.init(key_actor, obs), self._critic.init(key_critic, obs), log_std)

    def distribution(self, params: PolicyParams, obs: Float[Array, "*batch S"]) -> distrax.MultivariateNormalDiag:
        """Return pi(o|s) for normalised observations."""
        mean = apply(self._actor, params.actor, obs)
        return distrax.MultivariateNormalDiag(mean, jnp.broadcast_to(jnp.exp(params.log_std), mean.shape))

    def draw(
        self, params: PolicyParams, obs: Float[Array, "*batch S"], exploration: Scalar, noise: Float[Array, "*batch D"]
    ) -> tuple[Float[Array, "*batch D"], Float[Array, "*batch"]]:
        """Return an option by standard normal noise, scaled by `exploration`, and its log-probability."""
        distribution: Any = self.distribution(params, obs)
        option = distribution.loc + exploration * distribution.scale_diag * noise
        return option, distribution.log_prob(option)

    def mode(self, params: PolicyParams, obs: Float[Array, "*batch S"]) -> Float[Array, "*batch D"]:
        """Return the mean option for normalised observations."""
        return apply(self._actor, params.actor, obs)

    def divergence(self, distribution: Any) -> Float[Array, "*batch"]:
        """Return KL(pi(o|s) || N(0, I)) in nats."""
        mean = distribution.loc
        return distribution.kl_divergence(distrax.MultivariateNormalDiag(jnp.zeros_like(mean), jnp.ones_like(mean)))

    def value(self, params: PolicyParams, obs: Float[Array, "*batch S"]) -> Float[Array, "*batch"]:
        """Return V(s) for normalised observations."""
        return apply(self._critic, params.critic, obs)[..., 0]


class CategoricalPolicy(Policy):
    """pi(o|s) and V(s) for D discrete options, each one-hot; `log_std` is not used."""

    def distribution(self, params: PolicyParams, obs: Float[Array, "*batch S"]) -> distrax.OneHotCategorical:
        """Return pi(o|s) for normalised observations."""
        return distrax.OneHotCategorical(apply(self._actor, params.actor, obs), dtype=jnp.float32)

    def draw(
        self, params: PolicyParams, obs: Float[Array, "*batch S"], exploration: Scalar, noise: Float[Array, "*batch D"]
    ) -> tuple[Float[Array, "*batch D"], Float[Array, "*batch"]]:
        """Do as `Policy.draw`; exploration 0 takes the most probable option."""
        distribution: Any = self.distribution(params, obs)
        option = one_hot_of(distribution.logits + exploration * gumbel(noise))
        return option, distribution.log_prob(option)

    def mode(self, params: PolicyParams, obs: Float[Array, "*batch S"]) -> Float[Array, "*batch D"]:
        """Return the most probable option for normalised observations."""
        return one_hot_of(super().mode(params, obs))

    def divergence(self, distribution: Any) -> Float[Array, "*batch"]:
        """Return the KL divergence from uniform options in nats."""
        return jnp.log(float(self.option_size)) - distribution.entropy()


def gumbel(noise: Float[Array, "..."]) -> Float[Array, "..."]:
    """Return standard Gumbel numbers of standard normal ones, whose order they keep."""
    return -jnp.log(-jax.scipy.special.log_ndtr(noise))


def one_hot_of(scores: Float[Array, "*batch D"]) -> Float[Array, "*batch D"]:
    """Return 1 at the greatest score and 0 elsewhere."""
    return jax.nn.one_hot(jnp.argmax(scores, axis=-1), scores.shape[-1])


class SquashedParams(struct.PyTreeNode):
    """Parameters of a squashed actor, and its bound."""

    actor: Any
    bound: Array


class SquashedPolicy(struct.PyTreeNode):
    """pi(o|s) of soft actor-critic: its bound times tanh of a Gaussian whose deviation depends on the state."""

    option_size: int = struct.field(pytree_node=False)
    hidden_sizes: tuple[int, ...] = struct.field(pytree_node=False)

    @property
    def _actor(self) -> MLP:
        return MLP((*self.hidden_sizes, 2 * self.option_size), last_scale=0.01)

    def init(self, key: Key[Array, ""], observation_size: int, bound: Scalar) -> SquashedParams:
        """Return fresh parameters whose mean option is near zero."""
        actor = self._actor.init(key, jnp.zeros(observation_size))
        return SquashedParams(actor, jnp.asarray(bound, jnp.float32))

    def draw(
        self,
        params: SquashedParams,
        obs: Float[Array, "*batch S"],
        exploration: Scalar,
        noise: Float[Array, "*batch D"],
    ) -> tuple[Float[Array, "*batch D"], Float[Array, "*batch"]]:
        """Do as `Policy.draw`; the density is that of the option in units of its bound."""
        mean, log_std = jnp.split(apply(self._actor, params.actor, obs), 2, axis=-1)
        normal = distrax.MultivariateNormalDiag(mean, jnp.exp(jnp.clip(log_std, *LOG_STD)))
        before = mean + exploration * normal.scale_diag * noise
        squashed, log_det = distrax.Block(distrax.Tanh(), 1).forward_and_log_det(before)
        log_prob: Any = normal.log_prob(before)
        return params.bound * squashed, log_prob - log_det

    def mode(self, params: SquashedParams, obs: Float[Array, "*batch S"]) -> Float[Array, "*batch D"]:
        """Return the mean before squashing, squashed, for normalised observations."""
        return params.bound * jnp.tanh(jnp.split(apply(self._actor, params.actor, obs), 2, axis=-1)[0])

    def uniform(self, params: SquashedParams, noise: Float[Array, "*batch D"]) -> Float[Array, "*batch D"]:
        """Return uniformly random options within the bound, by standard normal noise."""
        return params.bound * (2.0 * jax.scipy.stats.norm.cdf(noise) - 1.0)


class GreedyParams(struct.PyTreeNode):
    """Parameters of the values Q(s, .), and the share of random options."""

    values: Any
    epsilon: Array


class GreedyPolicy(struct.PyTreeNode):
    """The best of D discrete options by their values, each one-hot; or, with probability epsilon, a random one."""

    option_size: int = struct.field(pytree_node=False)
    hidden_sizes: tuple[int, ...] = struct.field(pytree_node=False)
    layer_norm: bool = struct.field(pytree_node=False)

    @property
    def _values(self) -> MLP:
        return MLP((*self.hidden_sizes, self.option_size), activation=nn.relu, layer_norm=self.layer_norm)

    def init(self, key: Key[Array, ""], observation_size: int, epsilon: Scalar) -> GreedyParams:
        """Return fresh parameters."""
        return GreedyParams(self._values.init(key, jnp.zeros(observation_size)), jnp.asarray(epsilon, jnp.float32))

    def evaluate(self, values: Any, obs: Float[Array, "*batch S"]) -> Float[Array, "*batch D"]:
        """Return Q(s, o) of every option for normalised observations."""
        return apply(self._values, values, obs)

    def draw(
        self, params: GreedyParams, obs: Float[Array, "*batch S"], exploration: Scalar, noise: Float[Array, "*batch D"]
    ) -> tuple[Float[Array, "*batch D"], Float[Array, "*batch"]]:
        """Return an option by standard normal noise, and its log-probability; `exploration` scales epsilon."""
        best, epsilon = self.mode(params, obs), exploration * params.epsilon
        # The greatest of the numbers is independent of its place, and its power by its distribution is uniform.
        chance = jax.scipy.stats.norm.cdf(jnp.max(noise, axis=-1)) ** self.option_size
        option = jnp.where((chance < epsilon)[..., None], self.uniform(params, noise), best)
        share = jnp.sum(option * best, axis=-1) * (1.0 - epsilon) + epsilon / self.option_size
        return option, jnp.log(share)

    def mode(self, params: GreedyParams, obs: Float[Array, "*batch S"]) -> Float[Array, "*batch D"]:
        """Return the best option for normalised observations."""
        return one_hot_of(self.evaluate(params.values, obs))

    def uniform(self, params: GreedyParams, noise: Float[Array, "*batch D"]) -> Float[Array, "*batch D"]:
        """Return uniformly random options by standard normal noise."""
        return one_hot_of(noise)


class Critics(struct.PyTreeNode):
    """Two action values Q(s, o), each a row of the parameters; their minimum is the value."""

    hidden_sizes: tuple[int, ...] = struct.field(pytree_node=False)
    layer_norm: bool = struct.field(pytree_node=False)

    @property
    def _critic(self) -> MLP:
        return MLP((*self.hidden_sizes, 1), activation=nn.relu, layer_norm=self.layer_norm)

    def init(self, key: Key[Array, ""], observation_size: int, option_size: int) -> Any:
        """Return fresh parameters [2]."""
        init = jax.vmap(self._critic.init, in_axes=(0, None))
        return init(jax.random.split(key), jnp.zeros(observation_size + option_size))

    def values(self, params: Any, obs: Float[Array, "M S"], option: Float[Array, "M D"]) -> Float[Array, "2 M"]:
        """Return both values for normalised observations, and options in units of their bound."""
        inputs = jnp.concatenate([obs, option], axis=-1)
        return jax.vmap(lambda p: apply(self._critic, p, inputs)[..., 0])(params)
