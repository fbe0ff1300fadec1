"""Executors: what turns an option into primitive actions until its termination rule ends it (§3.4)."""

from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from taic_jax.config import OptionsConfig
from taic_jax.networks import apply
from taic_jax.options.model import Networks, OptionModel, make_networks


@runtime_checkable
class Executor(Protocol):
    """Run one option, unbatched: the caller vmaps."""

    @property
    def option_size(self) -> int:
        """D."""
        ...

    def start(self, option: Float[Array, " D"], obs: Float[Array, " S"]) -> Any:
        """Return the carry of an option that begins at this observation."""
        ...

    def act(self, carry: Any, obs: Float[Array, " S"]) -> tuple[Any, Float[Array, " A"]]:
        """Return the next carry and the action, each entry in [-1, 1]."""
        ...

    def ended(self, carry: Any, obs: Float[Array, " S"]) -> Bool[Array, ""]:
        """Return beta(s, o) for the observation after the tick."""
        ...


class IdentityExecutor(struct.PyTreeNode):
    """Flat control: the option is the action and ends after one tick."""

    option_size: int = struct.field(pytree_node=False)

    def start(self, option: Float[Array, " A"], obs: Float[Array, " S"]) -> Float[Array, " A"]:
        """Carry the action itself."""
        return option

    def act(self, carry: Float[Array, " A"], obs: Float[Array, " S"]) -> tuple[Array, Array]:
        """Emit the action, clipped to its bounds."""
        return carry, jnp.clip(carry, -1.0, 1.0)

    def ended(self, carry: Float[Array, " A"], obs: Float[Array, " S"]) -> Bool[Array, ""]:
        """End always."""
        return jnp.ones((), bool)


class Decoding(struct.PyTreeNode):
    """A running option: its code, D's carry, and the ticks it has run."""

    option: Array
    carry: Any
    tick: Array


class OptionExecutor(struct.PyTreeNode):
    """D behind its termination rule: `fixed` ends every option after `length` ticks (§3.4.1)."""

    model: OptionModel
    networks: Networks = struct.field(pytree_node=False)
    length: int = struct.field(pytree_node=False)

    @property
    def option_size(self) -> int:
        """D."""
        return self.networks.encoder.option_size

    def start(self, option: Float[Array, " D"], obs: Float[Array, " S"]) -> Decoding:
        """Set D's carry from the code."""
        carry = apply(self.networks.decoder, self.model.params["decoder"], option, method="start")
        return Decoding(option, carry, jnp.zeros((), jnp.int32))

    def act(self, carry: Decoding, obs: Float[Array, " S"]) -> tuple[Decoding, Float[Array, " A"]]:
        """Emit D's next action, clipped to its bounds."""
        params = self.model.params["decoder"]
        memory, (action, _) = apply(self.networks.decoder, params, carry.carry, carry.option, method="step")
        return Decoding(carry.option, memory, carry.tick + 1), jnp.clip(action, -1.0, 1.0)

    def ended(self, carry: Decoding, obs: Float[Array, " S"]) -> Bool[Array, ""]:
        """End after `length` ticks, whatever the state."""
        return carry.tick >= self.length


def make_executor(config: OptionsConfig, action_size: int, model: OptionModel) -> OptionExecutor:
    """Return the executor of an option model under the config's termination rule."""
    networks = make_networks(config, model.state_scale.mean.shape[-1], action_size)
    return OptionExecutor(model, networks, config.length)
