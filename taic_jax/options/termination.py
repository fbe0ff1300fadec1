"""Termination rules beta(s, o), which end a running option before its greatest length (§3.4).

The executor asks its rule after every tick. `memory` is the state that a rule carries for the running option.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from taic_jax.config import OptionsConfig
from taic_jax.networks import apply
from taic_jax.options.losses import prediction_loss
from taic_jax.options.model import Carry, OptionModel
from taic_jax.types import Scalar


def stop_index(errors: Float[Array, " L"], delta: Scalar) -> Int[Array, ""]:
    """Return the index of the action at which Algorithm 1 stops a window: the first whose error reaches delta.

    That action still belongs to the option. If no error reaches delta it is the last one.
    """
    surprised = errors >= delta
    return jnp.where(jnp.any(surprised), jnp.argmax(surprised), len(errors) - 1).astype(jnp.int32)


def prefix_errors(
    model: OptionModel, options: Float[Array, "L D"], states: Float[Array, "L+1 P"]
) -> Float[Array, " L"]:
    """Return L_pred of every prefix of a window: the error of P(s_0, o_i) on s_{i+1} (Algorithm 1, lines 3-5)."""
    start = model.see(states[0], states[0])
    predicted = jax.vmap(partial(model.predict, start))(options)
    return jax.vmap(prediction_loss)(predicted, model.changes(states))


@dataclass(frozen=True)
class Termination:
    """A rule that ends an option, unbatched; this one remembers nothing and never ends an option early.

    `noise_size` is X, the standard normal numbers that `ended` takes.
    """

    noise_size: int = 0

    def start(self, model: OptionModel, state: Float[Array, " P"]) -> Any:
        """Return the memory of an option that begins in this state."""

    def follow(
        self, model: OptionModel, memory: Any, state: Float[Array, " P"], action: Float[Array, " A"], end_logit: Array
    ) -> Any:  # fmt: skip
        """Return the memory after D emitted an action and an end logit in this state."""

    def ended(self, model: OptionModel, memory: Any, state: Float[Array, " P"], noise: Array) -> Bool[Array, ""]:
        """Return whether the option ends in the state after the tick."""
        return jnp.zeros((), bool)


class Fixed(Termination):
    """Fix-len (§3.4.1): every option takes all its ticks."""


class Output(Termination):
    """Term-output (§3.4.2): D's end signal ends the option; the memory is the latest logit.

    With `noise_size` 1 the signal is a probability, and the noise draws from it; with 0 it is yes above one half.
    """

    def start(self, model: OptionModel, state: Float[Array, " P"]) -> Float[Array, ""]:
        """Remember no signal yet."""
        return jnp.zeros(())

    def follow(
        self, model: OptionModel, memory: Array, state: Array, action: Float[Array, " A"], end_logit: Array
    ) -> Float[Array, ""]:
        """Remember the logit."""
        return end_logit

    def ended(self, model: OptionModel, memory: Array, state: Float[Array, " P"], noise: Array) -> Bool[Array, ""]:
        """End with the signal's probability, or if it is above one half."""
        if not self.noise_size:
            return memory > 0.0
        return jax.scipy.special.ndtr(noise[0]) < jax.nn.sigmoid(memory)


class Following(struct.PyTreeNode):
    """Memory of termination predict: the option's first state, E's carry, E's code of the actions so far, and the way
    [2] so far, None without a frame."""

    start: Array
    carry: Carry
    option: Array
    way: Any = None


class Predict(Termination):
    """Term-predict (§3.4.3): E follows the executed actions, and a surprised P ends the option."""

    def start(self, model: OptionModel, state: Float[Array, " P"]) -> Following:
        """Remember the option's first state."""
        encoder, way = model.networks.encoder, jnp.zeros(2) if model.networks.frame else None
        return Following(state, encoder.start(), jnp.zeros(encoder.option_size), way)

    def follow(
        self, model: OptionModel, memory: Following, state: Array, action: Float[Array, " A"], end_logit: Array
    ) -> Following:
        """Let E read the action, and add the tick's way."""
        params = model.params["encoder"]
        carry, (option, _) = apply(model.networks.encoder, params, memory.carry, action, method="step")
        frame = model.networks.frame
        way = memory.way + frame.way(state, memory.start) if frame else None
        return memory.replace(carry=carry, option=option, way=way)

    def ended(self, model: OptionModel, memory: Following, state: Float[Array, " P"], noise: Array) -> Bool[Array, ""]:
        """End if the error of P(s_0, o_i) on the state after the tick is at least delta."""
        predicted = model.predict(model.see(memory.start, memory.start), memory.option)
        change = model.change(state, memory.start, memory.way)
        return prediction_loss(predicted, change) >= model.delta


def make_termination(config: OptionsConfig) -> Termination:
    """Return the config's rule."""
    if config.termination == "predict":
        return Predict()
    return Output(int(config.end_signal == "sampled")) if config.termination == "output" else Fixed()
