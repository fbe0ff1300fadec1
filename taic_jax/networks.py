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

    def value(self, params: PolicyParams, obs: Float[Array, "*batch S"]) -> Float[Array, "*batch"]:
        """Return V(s) for normalised observations."""
        return apply(self._critic, params.critic, obs)[..., 0]


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
