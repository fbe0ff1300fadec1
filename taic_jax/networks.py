"""The policy's networks: a Gaussian actor over options and a critic, three-layer MLPs (paper, §4)."""

from collections.abc import Sequence
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
    """Dense layers with tanh between them; the last layer is linear.

    Initialised without QR: a batched QR inside a vmapped program can deadlock XLA's CPU runtime.
    """

    sizes: Sequence[int]
    last_scale: float = 1.0

    @nn.compact
    def __call__(self, x: Float[Array, "*batch F"]) -> Float[Array, "*batch H"]:
        """Apply the layers to the last axis."""
        for size in self.sizes[:-1]:
            x = nn.tanh(nn.Dense(size, kernel_init=nn.initializers.variance_scaling(2.0, "fan_in", "normal"))(x))
        last = nn.initializers.variance_scaling(self.last_scale**2, "fan_in", "normal")
        return nn.Dense(self.sizes[-1], kernel_init=last)(x)


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

    def value(self, params: PolicyParams, obs: Float[Array, "*batch S"]) -> Float[Array, "*batch"]:
        """Return V(s) for normalised observations."""
        return apply(self._critic, params.critic, obs)[..., 0]
