"""Executors, which turn an option into primitive actions, tick by tick (§3.4)."""

from typing import Any, Protocol, runtime_checkable

import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float

from taic_jax.config import OptionsConfig
from taic_jax.networks import apply, gumbel, one_hot_of
from taic_jax.options.choice import leading
from taic_jax.options.model import OptionModel
from taic_jax.options.termination import Termination, make_termination
from taic_jax.types import Scalar


@runtime_checkable
class Executor(Protocol):
    """The execution of one option, unbatched: the caller vmaps, and ends options after at most `length` ticks."""

    @property
    def option_size(self) -> int:
        """D, the numbers of an option."""
        ...

    @property
    def length(self) -> int:
        """L, the most ticks of an option."""
        ...

    @property
    def discrete(self) -> bool:
        """Whether options are one-hot."""
        ...

    @property
    def noise_size(self) -> int:
        """X, the standard normal numbers that `act` and `ended` share each tick."""
        ...

    @property
    def at_once(self) -> int:
        """The environments in which options begin together, since `start` is costly; 0 for all."""
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
    """Flat control: the option is the action, held for `length` ticks, by default one; one-hot if `discrete`."""

    option_size: int = struct.field(pytree_node=False)
    length: int = struct.field(pytree_node=False, default=1)
    discrete: bool = struct.field(pytree_node=False, default=False)
    noise_size: int = struct.field(pytree_node=False, default=0)
    at_once: int = struct.field(pytree_node=False, default=0)

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
    """A running option: its code, D's carry, the termination rule's memory of it, and its view if it has a way.

    `first` is the state in which it began, in its view, if D sees the body from the heading there.
    """

    option: Array
    carry: Any
    memory: Any
    view: Any = None
    first: Any = None


class OptionExecutor(struct.PyTreeNode):
    """D under a termination rule; with `std`, actions are drawn from a normal distribution around D's output.

    Discrete actions have D's greatest logit, after Gumbel noise times `std`: 1 draws them by their probabilities. With
    `codes` an option is one-hot, one of the model's code book; `by_way` it is the way that the option shall lead.
    """

    model: OptionModel
    termination: Termination = struct.field(pytree_node=False)
    length: int = struct.field(pytree_node=False)
    std: Scalar = struct.field(default=None)
    codes: int = struct.field(pytree_node=False, default=0)
    by_way: bool = struct.field(pytree_node=False, default=False)

    @property
    def option_size(self) -> int:
        """D; the codes of the book; or 2 entries of the way."""
        return 2 if self.by_way else self.codes or self.model.networks.encoder.option_size

    @property
    def discrete(self) -> bool:
        """Whether options are one-hot: those of a code book."""
        return self.codes > 0

    @property
    def noise_size(self) -> int:
        """X, the standard normal numbers of a tick: those of the termination rule, then any one per action."""
        return self.termination.noise_size + (0 if self.std is None else self.model.networks.decoder.action_size)

    @property
    def at_once(self) -> int:
        """A choice by way takes hundreds of P's predictions."""
        return 8 if self.by_way else 0

    def code(self, option: Float[Array, "*batch M"]) -> Float[Array, "*batch D"]:
        """Return the codes of options that are not chosen by their way."""
        return option @ self.model.book if self.codes else option

    def start(self, option: Float[Array, " M"], obs: Float[Array, " S"]) -> Decoding:
        """Set D's carry from the code."""
        code, view = self._chosen(option, self._state(obs, None))
        carry, state, frame = self._decoder(code, method="start"), self._state(obs, view), self.model.networks.frame
        first = state if frame and frame.turns else None
        return Decoding(code, carry, self.termination.start(self.model, state), view, first)

    def _chosen(self, option: Float[Array, " M"], state: Float[Array, " P"]) -> tuple[Float[Array, " D"], Any]:
        """Return the code of an option, and its view if it has one."""
        return leading(self.model, option, state) if self.by_way else (self.code(option), None)

    def act(self, carry: Decoding, obs: Float[Array, " S"], noise: Float[Array, " X"]) -> tuple[Decoding, Array]:
        """Emit D's next action, with any noise, clipped to its bounds or one-hot."""
        state = self._state(obs, carry.view)
        next_carry, (output, end_logit) = self._decoder(
            carry.carry, carry.option, self.model.see(state, carry.first), method="step"
        )
        action = self._action(output, noise[self.termination.noise_size :])
        followed = self.termination.follow(self.model, carry.memory, state, action, end_logit)
        if carry.view is not None:
            action = self.model.views.action(self.model.views.back(carry.view), action)
        return carry.replace(carry=next_carry, memory=followed), action

    def ended(self, carry: Decoding, obs: Float[Array, " S"], noise: Float[Array, " X"]) -> Bool[Array, ""]:
        """Ask the termination rule."""
        state = self._state(obs, carry.view)
        return self.termination.ended(self.model, carry.memory, state, noise[: self.termination.noise_size])

    def _action(self, output: Float[Array, " A"], noise: Array) -> Float[Array, " A"]:
        discrete = self.model.networks.discrete
        if self.std is not None:
            output = output + self.std * (gumbel(noise) if discrete else noise)
        return one_hot_of(output) if discrete else jnp.clip(output, -1.0, 1.0)

    def _state(self, obs: Float[Array, " S"], view: Any) -> Float[Array, " P"]:
        """Return the proprioceptive slice, in a view: an observation may have more entries than the model reads."""
        state = obs[: self.model.state_size]
        return state if view is None else self.model.views.obs(view, state)

    def _decoder(self, *args: Any, method: str) -> Any:
        return apply(self.model.networks.decoder, self.model.params["decoder"], *args, method=method)


def make_executor(config: OptionsConfig, model: OptionModel) -> OptionExecutor:
    """Return the executor of an option model under the config's termination rule.

    If delta is P's error itself, the config's replaces the model's, so that a sweep of delta can use one model.
    """
    if config.delta_unit == "error":
        model = model.replace(delta=jnp.asarray(config.delta, jnp.float32))
    std: Any = jnp.ones(()) if config.sample_actions and model.networks.discrete else None
    rule, by_way = make_termination(config), config.choose == "way"
    return OptionExecutor(model, rule, config.length, std, config.codes, by_way)
