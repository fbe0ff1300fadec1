"""Executors, which turn an option into primitive actions, tick by tick (§3.4)."""

from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from taic_jax.config import OptionsConfig
from taic_jax.networks import apply
from taic_jax.options.model import OptionModel
from taic_jax.options.termination import Termination, make_termination
from taic_jax.types import Scalar


@runtime_checkable
class Executor(Protocol):
    """The execution of one option, unbatched: the caller vmaps, and ends options after at most `length` ticks."""

    @property
    def option_size(self) -> int:
        """D."""
        ...

    @property
    def length(self) -> int:
        """L, the most ticks of an option."""
        ...

    @property
    def noise_size(self) -> int:
        """X, the standard normal numbers that `act` and `ended` share each tick."""
        ...

    def start(self, option: Float[Array, " D"], obs: Float[Array, " S"]) -> Any:
        """Return the carry of an option that begins at this observation."""
        ...

    def act(self, carry: Any, obs: Float[Array, " S"], noise: Float[Array, " X"]) -> tuple[Any, Float[Array, " A"]]:
        """Return the next carry and the action, each entry in [-1, 1]."""
        ...

    def ended(self, carry: Any, obs: Float[Array, " S"], noise: Float[Array, " X"]) -> Bool[Array, ""]:
        """Return beta(s, o) for the observation after the tick, true if the option ends before `length`."""
        ...


class IdentityExecutor(struct.PyTreeNode):
    """Flat control: the option is the action, held for `length` ticks, by default one."""

    option_size: int = struct.field(pytree_node=False)
    length: int = struct.field(pytree_node=False, default=1)
    noise_size: int = struct.field(pytree_node=False, default=0)

    def start(self, option: Float[Array, " A"], obs: Float[Array, " S"]) -> Float[Array, " A"]:
        """Carry the action itself."""
        return option

    def act(self, carry: Float[Array, " A"], obs: Float[Array, " S"], noise: Array) -> tuple[Array, Array]:
        """Emit the action, clipped to its bounds."""
        return carry, jnp.clip(carry, -1.0, 1.0)

    def ended(self, carry: Float[Array, " A"], obs: Float[Array, " S"], noise: Array) -> Bool[Array, ""]:
        """Never end early."""
        return jnp.zeros((), bool)


class Decoding(struct.PyTreeNode):
    """A running option: its code, D's carry, and the termination rule's memory of it."""

    option: Array
    carry: Any
    memory: Any


class OptionExecutor(struct.PyTreeNode):
    """D under a termination rule; with `std`, actions are drawn from a normal distribution around D's output."""

    model: OptionModel
    termination: Termination = struct.field(pytree_node=False)
    length: int = struct.field(pytree_node=False)
    std: Scalar = struct.field(default=None)

    @property
    def option_size(self) -> int:
        """D."""
        return self.model.networks.encoder.option_size

    @property
    def noise_size(self) -> int:
        """X, the standard normal numbers of a tick: those of the termination rule, then any one per action."""
        return self.termination.noise_size + (0 if self.std is None else self.model.networks.decoder.action_size)

    def start(self, option: Float[Array, " D"], obs: Float[Array, " S"]) -> Decoding:
        """Set D's carry from the code."""
        carry = self._decoder(option, method="start")
        return Decoding(option, carry, self.termination.start(self.model, self._state(obs)))

    def act(self, carry: Decoding, obs: Float[Array, " S"], noise: Float[Array, " X"]) -> tuple[Decoding, Array]:
        """Emit D's next action, with any noise, clipped to its bounds."""
        state = self.model.state_scale(self._state(obs))
        next_carry, (action, end_logit) = self._decoder(carry.carry, carry.option, state, method="step")
        disturbance = 0.0 if self.std is None else self.std * noise[self.termination.noise_size :]
        action = jnp.clip(action + disturbance, -1.0, 1.0)
        followed = self.termination.follow(self.model, carry.memory, action, end_logit)
        return Decoding(carry.option, next_carry, followed), action

    def ended(self, carry: Decoding, obs: Float[Array, " S"], noise: Float[Array, " X"]) -> Bool[Array, ""]:
        """Ask the termination rule."""
        return self.termination.ended(self.model, carry.memory, self._state(obs), noise[: self.termination.noise_size])

    def _state(self, obs: Float[Array, " S"]) -> Float[Array, " P"]:
        """Return the proprioceptive slice: an observation may have more entries than the model reads."""
        return obs[: self.model.state_size]

    def _decoder(self, *args: Any, method: str) -> Any:
        return apply(self.model.networks.decoder, self.model.params["decoder"], *args, method=method)


def make_executor(config: OptionsConfig, model: OptionModel) -> OptionExecutor:
    """Return the executor of an option model under the config's termination rule.

    If delta is P's error itself, the config's replaces the model's, so that a sweep of delta can use one model.
    """
    if config.delta_unit == "error":
        model = model.replace(delta=jnp.asarray(config.delta, jnp.float32))
    return OptionExecutor(model, make_termination(config), config.length)
