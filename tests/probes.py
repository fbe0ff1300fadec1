"""Tasks whose answers are known, options without a model or of a random one, and a reader of trees."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from taic_jax.config import OptionsConfig
from taic_jax.envs import Env, State
from taic_jax.envs.base import Heading
from taic_jax.options.model import OptionModel, Scale, init_params, make_networks


class Probe(Env):
    """A task of one number x, which is its whole observation; subclasses say where it starts and how it moves."""

    name = "probe"
    observation_size = proprioceptive_size = action_size = 1
    episode_length = 1
    dt = 1.0

    def first(self, key: Array) -> Array:
        """Return x [] at the start of an episode."""
        return jnp.zeros(())

    def move(self, x: Array, action: Array) -> tuple[Array, Array, Array, Array]:
        """Return the next x, the reward, and whether the task ended or the time limit cut it."""
        raise NotImplementedError

    def observe(self, x: Array) -> Array:
        """Return the observation [S]."""
        return x[None]

    def reset(self, key: Array) -> State:
        """Start an episode."""
        x, no = self.first(key), jnp.zeros((), bool)
        obs = self.observe(x)
        return State(x, obs, jnp.zeros(()), terminated=no, truncated=no, metrics={"last": obs[-1]})

    def step(self, state: State, action: Array) -> State:
        """Move by one tick."""
        x, reward, terminated, truncated = self.move(state.physics, action[0])
        obs = self.observe(x)
        return state.replace(
            physics=x, obs=obs, reward=reward, terminated=terminated, truncated=truncated, metrics={"last": obs[-1]}
        )

    def render(self, physics: Any, *, height: int = 240, width: int = 320) -> np.ndarray:
        """Draw nothing."""
        return np.zeros((len(physics), height, width, 3), np.uint8)


YES, NO = jnp.ones((), bool), jnp.zeros((), bool)


class Constant(Probe):
    """One tick, reward 1: V = 1."""

    def move(self, x: Array, action: Array) -> tuple[Array, Array, Array, Array]:
        return x, jnp.ones(()), YES, NO


class Observed(Probe):
    """One tick, reward x = -1 or 1: V(x) = x."""

    def first(self, key: Array) -> Array:
        return jax.random.rademacher(key, (), jnp.float32)

    def move(self, x: Array, action: Array) -> tuple[Array, Array, Array, Array]:
        return x, x, YES, NO


class TwoStep(Probe):
    """Two ticks, x = 0 then 1, reward 1 at the second: V(0) = gamma, V(1) = 1."""

    episode_length = 2

    def move(self, x: Array, action: Array) -> tuple[Array, Array, Array, Array]:
        return x + 1.0, x, x > 0.5, NO


class Sign(Observed):
    """One tick, reward 1 if the action has the sign of x = -1 or 1, else -1: the best V is 1."""

    def move(self, x: Array, action: Array) -> tuple[Array, Array, Array, Array]:
        return x, jnp.sign(x * action), YES, NO


class OneOf(Probe):
    """One of the given probes, drawn each episode; it is observed one-hot before x."""

    def __init__(self, *probes: Probe):
        self.probes = probes
        self.observation_size = self.proprioceptive_size = 1 + len(probes)

    def first(self, key: Array) -> tuple[Array, Array]:
        key_which, key_first = jax.random.split(key)
        which = jax.random.randint(key_which, (), 0, len(self.probes))
        return jnp.stack([probe.first(key_first) for probe in self.probes])[which], which

    def move(self, x: tuple[Array, Array], action: Array) -> tuple[Any, Array, Array, Array]:
        x, which = x
        moves = [probe.move(x, action) for probe in self.probes]
        x, reward, terminated, truncated = (jnp.stack(column)[which] for column in zip(*moves, strict=True))
        return (x, which), reward, terminated, truncated

    def observe(self, x: tuple[Array, Array]) -> Array:
        return jnp.append(jax.nn.one_hot(x[1], len(self.probes)), x[0])


class Counting(Probe):
    """x counts the ticks, and is the reward; the episode ends once x = `end` (0: never), by `truncated` or the task.

    x starts at a random number below `spread`, so that environments end at different ticks.
    """

    def __init__(self, end: int = 0, truncated: bool = False, spread: int = 1):
        self.end, self.truncated, self.spread = end, truncated, spread
        self.episode_length = end

    def first(self, key: Array) -> Array:
        return jax.random.randint(key, (), 0, self.spread).astype(jnp.float32)

    def move(self, x: Array, action: Array) -> tuple[Array, Array, Array, Array]:
        x = x + 1.0
        ended = x == self.end
        return x, x, ended & (not self.truncated), ended & self.truncated


class Repeat(struct.PyTreeNode):
    """An executor that repeats its option, an action, for `length` ticks."""

    length: int = struct.field(pytree_node=False)
    option_size: int = struct.field(pytree_node=False, default=1)
    noise_size: int = struct.field(pytree_node=False, default=0)
    discrete: bool = struct.field(pytree_node=False, default=False)
    at_once: int = struct.field(pytree_node=False, default=0)

    def start(self, option: Array, obs: Array) -> Array:
        """Carry the action."""
        return option

    def act(self, carry: Array, obs: Array, noise: Array) -> tuple[Array, Array]:
        """Emit the action, clipped to its bounds."""
        return carry, jnp.clip(carry, -1.0, 1.0)

    def ended(self, carry: Array, obs: Array, noise: Array) -> Array:
        """End early where there is noise, and it is positive."""
        return jnp.any(noise > 0.0)


def draw(rng: np.random.Generator, *shape: int) -> jax.Array:
    """Return standard normal numbers."""
    return jnp.asarray(rng.normal(size=shape), jnp.float32)


def random_model(
    config: OptionsConfig, state_size: int, action_size: int, heading: Heading | None = None
) -> OptionModel:
    """Return an option model whose parameters and scales are drawn at random."""
    rng, networks = np.random.default_rng(0), make_networks(config, state_size, action_size, heading=heading)
    shapes = jax.eval_shape(lambda: init_params(networks, config, jax.random.key(0)))
    params = jax.tree.map(lambda leaf: draw(rng, *leaf.shape), shapes)
    sizes = state_size, networks.predictor.change_size
    scales = [Scale(draw(rng, size), jnp.exp(draw(rng, size))) for size in sizes]
    return OptionModel(params, *scales, jnp.ones(()), networks)


def numbers(tree: Any) -> list[np.ndarray]:
    """Return the leaves of a tree on the host, keys as their data."""
    leaves = jax.tree.leaves(tree)
    is_key = [jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) for leaf in leaves]
    return [np.asarray(jax.random.key_data(x) if key else x) for x, key in zip(leaves, is_key, strict=True)]


def assert_trees_equal(a: Any, b: Any, **tolerance: float) -> None:
    """Compare two trees leaf by leaf: exactly, or within the `rtol` and `atol` given."""
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for x, y in zip(numbers(a), numbers(b), strict=True):
        np.testing.assert_allclose(x, y, **(tolerance or {"rtol": 0, "atol": 0}))
