"""The four networks of the option model: E, D, P, F (figure 2). Unbatched; the caller vmaps."""

from collections.abc import Sequence
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Key

from taic_jax.config import OptionsConfig
from taic_jax.networks import MLP

Carry = tuple[Array, Array]


def _lstm_cell(hidden_size: int) -> nn.OptimizedLSTMCell:
    # Flax's default is orthogonal, by QR: see `networks.MLP` for why there must be none.
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
        outputs = self.rnn(actions, initial_carry=self.start())
        mean, log_std = jnp.split(self.head(outputs), 2, axis=-1)
        # Bounded, so that neither KL nor samples can overflow early in training.
        return mean, jnp.clip(log_std, -6.0, 2.0)

    def start(self) -> Carry:
        """Return the carry before the first action."""
        return jnp.zeros(self.hidden_size), jnp.zeros(self.hidden_size)


class Decoder(nn.Module):
    """D: o -> actions and end logits, one tick at a time; open loop, so it never looks at the state."""

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

    def step(self, carry: Carry, option: Float[Array, " D"]) -> tuple[Carry, tuple[Array, Array]]:
        """Return the next carry, the action [A] and the logit that it is the last one []."""
        carry, output = self.cell(carry, option)
        output = self.head(output)
        return carry, (output[:-1], output[-1])

    def __call__(self, option: Float[Array, " D"], length: int) -> tuple[Float[Array, "L A"], Float[Array, " L"]]:
        """Return the `length` actions and end logits that as many steps give."""
        inputs = jnp.broadcast_to(option, (length, *option.shape))
        outputs = self.head(self.rnn(inputs, initial_carry=self.start(option)))
        return outputs[:, :-1], outputs[:, -1]


class Predictor(nn.Module):
    """P: (s, o) -> s' as a normalised state change (eq. 8)."""

    state_size: int
    hidden_sizes: Sequence[int]

    @nn.compact
    def __call__(self, state: Float[Array, " P"], option: Float[Array, " D"]) -> Float[Array, " P"]:
        """Predict the normalised change of a normalised state."""
        return MLP((*self.hidden_sizes, self.state_size))(jnp.concatenate([state, option]))


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
    decoder: Decoder
    predictor: Predictor
    estimator: StateEstimator


class Scale(struct.PyTreeNode):
    """Mean and standard deviation [P] over the experience an option model was learnt from."""

    mean: Array
    std: Array

    def __call__(self, x: Float[Array, "*batch P"]) -> Float[Array, "*batch P"]:
        """Normalise the last axis."""
        with jax.numpy_rank_promotion("allow"):
            return (x - self.mean) / self.std


class OptionModel(struct.PyTreeNode):
    """What `learn` makes and `train` uses: parameters, and the scales of states and state changes."""

    params: dict
    state_scale: Scale
    change_scale: Scale


def make_networks(config: OptionsConfig, state_size: int, action_size: int) -> Networks:
    """Return the modules for states [P] and actions [A]."""
    return Networks(
        Encoder(config.size, config.hidden_size),
        Decoder(action_size, config.hidden_size),
        Predictor(state_size, tuple(config.mlp_sizes)),
        StateEstimator(state_size, tuple(config.mlp_sizes)),
    )


def init_params(networks: Networks, config: OptionsConfig, key: Key[Array, ""]) -> dict:
    """Return fresh parameters of all four networks."""
    key_e, key_d, key_p, key_f = jax.random.split(key, 4)
    actions = jnp.zeros((config.length, networks.decoder.action_size))
    state, option = jnp.zeros(networks.predictor.state_size), jnp.zeros(config.size)
    return {
        "encoder": networks.encoder.init(key_e, actions),
        "decoder": networks.decoder.init(key_d, option, config.length),
        "predictor": networks.predictor.init(key_p, state, option),
        "estimator": networks.estimator.init(key_f, option),
    }
