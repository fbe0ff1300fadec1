"""The option model and its four networks: E, D, P, F (figure 2). Unbatched; the caller vmaps."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Int, Key

from taic_jax.config import OptionsConfig
from taic_jax.envs.base import Heading
from taic_jax.networks import MLP, apply
from taic_jax.options.frame import Frame, make_frame

Carry = tuple[Array, Array]
CLIP = 5.0  # standard deviations at which states in the frame of the heading are clipped


def _lstm_cell(hidden_size: int) -> nn.OptimizedLSTMCell:
    # Flax's default is orthogonal, by QR, which can deadlock: see `networks.MLP`.
    return nn.OptimizedLSTMCell(hidden_size, recurrent_kernel_init=nn.initializers.lecun_normal())


class Encoder(nn.Module):
    """E: a_0..a_i -> mean and log standard deviation of o, for every prefix at once (§3.2)."""

    option_size: int
    hidden_size: int

    def setup(self) -> None:
        self.cell = _lstm_cell(self.hidden_size)
        self.rnn = nn.RNN(self.cell)
        self.head = nn.Dense(2 * self.option_size)

    def __call__(self, actions: Float[Array, "L A"]) -> tuple[Float[Array, "L D"], Float[Array, "L D"]]:
        """Return mean and log-std of q(o|a_0..a_i) for each i."""
        outputs: Any = self.rnn(actions, initial_carry=self.start())
        return self._split(outputs)

    def start(self) -> Carry:
        """Return the carry before the first action."""
        return jnp.zeros(self.hidden_size), jnp.zeros(self.hidden_size)

    def step(self, carry: Carry, action: Float[Array, " A"]) -> tuple[Carry, tuple[Array, Array]]:
        """Return the next carry, and mean and log-std [D] of q(o|a_0..a_i) for the action a_i."""
        carry, output = self.cell(carry, action)
        return carry, self._split(output)

    def _split(self, outputs: Float[Array, "*batch H"]) -> tuple[Array, Array]:
        mean, log_std = jnp.split(self.head(outputs), 2, axis=-1)
        # Bounded, so that neither KL nor samples can overflow early in training.
        return mean, jnp.clip(log_std, -6.0, 2.0)


class OpenDecoder(nn.Module):
    """D in open loop: o -> actions and end logits, one tick at a time, without the state (§3.2)."""

    action_size: int
    hidden_size: int

    def setup(self) -> None:
        self.first = nn.Dense(2 * self.hidden_size)
        self.cell = _lstm_cell(self.hidden_size)
        self.rnn = nn.RNN(self.cell)
        self.head = nn.Dense(self.action_size + 1)

    def start(self, option: Float[Array, " D"]) -> Carry:
        """Return the LSTM's carry before the first tick."""
        memory, hidden = jnp.split(nn.tanh(self.first(option)), 2)
        return memory, hidden

    def step(
        self, carry: Carry, option: Float[Array, " D"], state: Float[Array, " P"]
    ) -> tuple[Carry, tuple[Array, Array]]:
        """Return the next carry, the action [A] and the logit that it is the last one []."""
        carry, output = self.cell(carry, option)
        output = self.head(output)
        return carry, (output[:-1], output[-1])

    def __call__(
        self, option: Float[Array, " D"], states: Float[Array, "L P"]
    ) -> tuple[Float[Array, "L A"], Float[Array, " L"]]:
        """Return the actions and end logits that L steps give."""
        inputs = jnp.broadcast_to(option, (len(states), *option.shape))
        outputs = self.head(self.rnn(inputs, initial_carry=self.start(option)))
        return outputs[:, :-1], outputs[:, -1]

    def at(
        self, option: Float[Array, " D"], state: Float[Array, " P"], tick: Int[Array, ""], length: int
    ) -> Float[Array, " A"]:
        """Return the `tick`-th action of `length`, counted from 0, in any state."""
        return self(option, jnp.broadcast_to(state, (length, *state.shape)))[0][tick]


class ClosedDecoder(nn.Module):
    """D in closed loop: pi(a|o, s) and the end logit, from the normalised state of each tick (§4.2.2, §5).

    The carry counts the ticks, as a share of the longest option: without it an end signal could not depend on time.
    """

    action_size: int
    hidden_sizes: Sequence[int]
    length: int
    squash: bool = False

    def setup(self) -> None:
        self.mlp = MLP((*self.hidden_sizes, self.action_size + 1))

    def start(self, option: Float[Array, " D"]) -> Float[Array, ""]:
        """Return the share of past ticks: none."""
        return jnp.zeros(())

    def step(
        self, carry: Float[Array, ""], option: Float[Array, " D"], state: Float[Array, " P"]
    ) -> tuple[Array, tuple[Array, Array]]:
        """Return the next carry, the action [A] and the logit that it is the last one []."""
        output = self.mlp(jnp.concatenate([state, option, carry[None]]))
        return carry + 1.0 / self.length, (self._actions(output), output[-1])

    def __call__(
        self, option: Float[Array, " D"], states: Float[Array, "L P"]
    ) -> tuple[Float[Array, "L A"], Float[Array, " L"]]:
        """Return the actions and end logits that L steps through these states give."""
        ticks = jnp.arange(len(states), dtype=jnp.float32)[:, None] / self.length
        outputs = self.mlp(jnp.hstack([states, jnp.broadcast_to(option, (len(states), *option.shape)), ticks]))
        return self._actions(outputs), outputs[:, -1]

    def at(
        self, option: Float[Array, " D"], state: Float[Array, " P"], tick: Int[Array, ""], length: int
    ) -> Float[Array, " A"]:
        """Return the `tick`-th action of `length`, counted from 0, in this state."""
        return self.step(tick.astype(jnp.float32) / length, option, state)[1][0]

    def _actions(self, outputs: Float[Array, "*batch O"]) -> Float[Array, "*batch A"]:
        return jnp.tanh(outputs[..., :-1]) if self.squash else outputs[..., :-1]


class Predictor(nn.Module):
    """P: (s, o) -> s' as a normalised state change (eq. 8) of C entries: the state's, and those of the way."""

    change_size: int
    hidden_sizes: Sequence[int]

    @nn.compact
    def __call__(self, state: Float[Array, " P"], option: Float[Array, " D"]) -> Float[Array, " C"]:
        """Predict the normalised change of a normalised state."""
        return MLP((*self.hidden_sizes, self.change_size))(jnp.concatenate([state, option]))


class StateEstimator(nn.Module):
    """F: o -> (s, s'), both normalised (eq. 9)."""

    state_size: int
    hidden_sizes: Sequence[int]

    @nn.compact
    def __call__(self, option: Float[Array, " D"]) -> Float[Array, "2 P"]:
        """Estimate start and end state."""
        return MLP((*self.hidden_sizes, 2 * self.state_size))(option).reshape(2, self.state_size)


class Networks(NamedTuple):
    """The modules; their parameters are in `OptionModel.params` under the same names."""

    encoder: Encoder
    decoder: OpenDecoder | ClosedDecoder
    predictor: Predictor
    estimator: StateEstimator
    discrete: bool  # D's output is logits of one-hot actions
    frame: Frame | None = None  # None for the world's axes without the way


class Scale(struct.PyTreeNode):
    """Mean and standard deviation, [P] of states or [C] of changes, over the experience of an option model."""

    mean: Array
    std: Array

    def __call__(self, x: Float[Array, "*batch P"]) -> Float[Array, "*batch P"]:
        """Normalise the last axis."""
        with jax.numpy_rank_promotion("allow"):
            return (x - self.mean) / self.std

    def undo(self, x: Float[Array, "*batch P"]) -> Float[Array, "*batch P"]:
        """Return what was normalised to x."""
        with jax.numpy_rank_promotion("allow"):
            return x * self.std + self.mean


class OptionModel(struct.PyTreeNode):
    """E, D, P and F with their parameters, and the scales of states and state changes.

    `delta` [] is the error of P at which termination predict ends an option. `book` [M, D] are the codes of discrete
    options, None without `options.codes`. `views` are those of the body if options are chosen by their way.
    `action_scale` is that of recorded data, in whose units `encode` and `decode` then take and return actions; networks
    and executors know actions in [-1, 1] alone.
    """

    params: dict
    state_scale: Scale
    change_scale: Scale
    delta: Array
    networks: Networks = struct.field(pytree_node=False)
    book: Any = None
    views: Any = None
    action_scale: Any = None

    @property
    def state_size(self) -> int:
        """P, the numbers of the proprioceptive slice."""
        return self.state_scale.mean.shape[-1]

    @property
    def sides(self) -> int:
        """Equal sides of the body, each a view in which an option can begin; 1 without options by their way."""
        return len(self.views) if self.views else 1

    def see(self, states: Float[Array, "*batch P"], first: Any) -> Float[Array, "*batch P"]:
        """Return normalised states, in the frame of the heading as seen from `first` [*batch P], clipped there."""
        if not (frame := self.networks.frame):
            return self.state_scale(states)
        seen = self.state_scale(frame.seen(states, first))
        return jnp.clip(seen, -CLIP, CLIP) if frame.turns else seen

    def changes(self, states: Float[Array, "T P"]) -> Float[Array, "T-1 C"]:
        """Return the normalised change from the first state to each later one."""
        frame = self.networks.frame
        return self.change_scale(frame.changes(states) if frame else states[1:] - states[:1])

    def change(self, state: Float[Array, " P"], first: Float[Array, " P"], way: Any) -> Float[Array, " C"]:
        """Return the normalised change from the first state to another, by the way [2] with a frame."""
        frame = self.networks.frame
        return self.change_scale(frame.change(state, first, way) if frame else state - first)

    def encode(self, actions: Float[Array, "L A"]) -> tuple[Float[Array, "L D"], Float[Array, "L D"]]:
        """Return mean and log standard deviation of q(o|a_0..a_i) for each i."""
        actions = self.action_scale(actions) if self.action_scale else actions
        return apply(self.networks.encoder, self.params["encoder"], actions)

    def decode(
        self, option: Float[Array, " D"], states: Float[Array, "L P"]
    ) -> tuple[Float[Array, "L A"], Float[Array, " L"]]:
        """Return D's actions and end logits at normalised states; an open-loop D uses only their number."""
        actions, ends = apply(self.networks.decoder, self.params["decoder"], option, states)
        return (self.action_scale.undo(actions) if self.action_scale else actions), ends

    def predict(self, state: Float[Array, " P"], option: Float[Array, " D"]) -> Float[Array, " C"]:
        """Return the normalised change of a normalised state under an option."""
        return apply(self.networks.predictor, self.params["predictor"], state, option)

    def way(self, state: Float[Array, " P"], option: Float[Array, " D"]) -> Float[Array, " 2"]:
        """Return the way in m that P predicts of an option from a normalised state, with a frame that has the way."""
        return self.change_scale.undo(self.predict(state, option))[-2:]

    def estimate(self, option: Float[Array, " D"]) -> Float[Array, "2 P"]:
        """Return F's estimate of the normalised start and end state."""
        return apply(self.networks.estimator, self.params["estimator"], option)

    def with_decoder(self, params: Any) -> "OptionModel":
        """Return the model with other parameters of D."""
        return self.replace(params={**self.params, "decoder": params})


def make_networks(
    config: OptionsConfig, state_size: int, action_size: int, discrete: bool = False, heading: Heading | None = None
) -> Networks:
    """Return the modules for states [P] and actions [A], which are one-hot if `discrete`, of a body with a heading."""
    frame = make_frame(config, heading)
    if config.decoder == "closed":
        decoder = ClosedDecoder(action_size, tuple(config.decoder_sizes), config.length, config.squash)
    else:
        decoder = OpenDecoder(action_size, config.hidden_size)
    return Networks(
        Encoder(config.size, config.hidden_size),
        decoder,
        Predictor(state_size + (frame.way_size if frame else 0), tuple(config.mlp_sizes)),
        StateEstimator(state_size, tuple(config.mlp_sizes)),
        discrete,
        frame,
    )


def init_params(networks: Networks, config: OptionsConfig, key: Key[Array, ""]) -> dict:
    """Return fresh parameters of all four networks."""
    key_e, key_d, key_p, key_f = jax.random.split(key, 4)
    actions = jnp.zeros((config.length, networks.decoder.action_size))
    state, option = jnp.zeros(networks.estimator.state_size), jnp.zeros(config.size)
    return {
        "encoder": networks.encoder.init(key_e, actions),
        "decoder": networks.decoder.init(key_d, option, jnp.zeros((config.length, len(state)))),
        "predictor": networks.predictor.init(key_p, state, option),
        "estimator": networks.estimator.init(key_f, option),
    }
