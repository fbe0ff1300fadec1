"""Gymnax's environments behind `Env`."""

import importlib
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import Float, Key, UInt8

from taic_jax.envs.adapters.admission import extra, require_vector_actions
from taic_jax.envs.adapters.foreign import strong
from taic_jax.envs.base import Env, State
from taic_jax.envs.errors import AdapterError, UnknownNameError
from taic_jax.envs.third_party import third_party

GYMNAX_PREFIX = "gymnax:"


class GymnaxPhysics(struct.PyTreeNode):
    """Gymnax's own state, and the key data of the ticks to come."""

    simulation: Any
    key: Array


class GymnaxEnv(Env):
    """The environment registered with gymnax under a name, without prefix, with its default parameters.

    Gymnax's time limit is `episode_length`, which `TimeLimit` enforces, and its automatic reset is not used. Vectors of
    [-1, 1] are scaled to the limits of its actions. Without a clock of its own it makes ten ticks a second.

    Raises:
      MissingExtraError: gymnax is not installed.
      UnknownNameError: there is no such environment.
      AdapterError: it cannot be made, as without the data that it downloads, or its actions are neither one choice nor
        a box with limits.
    """

    def __init__(self, name: str):
        with third_party(), extra("gymnax"):
            gymnax: Any = importlib.import_module("gymnax")
        self.name = GYMNAX_PREFIX + name
        if name not in gymnax.registered_envs:
            raise UnknownNameError("environment", self.name, [GYMNAX_PREFIX + each for each in gymnax.registered_envs])
        try:
            with third_party():
                self.inner, self.params = gymnax.make(name)
        except OSError as error:
            raise AdapterError(f"{self.name}: cannot be made: {error}") from error
        self._space: Any = self.inner.action_space(self.params)
        self.discrete = hasattr(self._space, "n")
        if not self.discrete:
            require_vector_actions(self.name, SimpleNamespace(action_space=self._space))
        self.action_size = int(self._space.n) if self.discrete else int(np.prod(self._space.shape))
        self.episode_length = int(self.params.max_steps_in_episode)
        self.dt = float(getattr(self.params, "dt", getattr(self.params, "tau", 0.1)))
        self.observation_size = self.proprioceptive_size = jax.eval_shape(self.reset, jax.random.key(0)).obs.size

    def reset(self, key: Key[Array, ""]) -> State:
        """Reset by gymnax's own rule."""
        key_start, key_ticks = jax.random.split(key)
        with third_party():
            obs, simulation = self.inner.reset_env(key_start, self.params)
        physics = GymnaxPhysics(jax.tree.map(strong, simulation), jax.random.key_data(key_ticks))
        return State.first(physics, _flat(obs), {})

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Step by gymnax's own rule, without its time limit and reset."""
        key, key_tick = jax.random.split(jax.random.wrap_key_data(state.physics.key))
        with third_party():
            arguments = state.physics.simulation, self._to_gymnax(action), self.params
            obs, simulation, reward, terminated, _ = self.inner.step_env(key_tick, *arguments)
            reward, terminated = jnp.asarray(reward, jnp.float32), jnp.asarray(terminated, bool)
        physics = GymnaxPhysics(jax.tree.map(strong, simulation), jax.random.key_data(key))
        flags = {"terminated": terminated.reshape(()), "truncated": jnp.zeros((), bool)}
        return state.replace(physics=physics, obs=_flat(obs), reward=reward.reshape(()), **flags)

    def render(self, physics: GymnaxPhysics, *, height: int = 240, width: int = 320) -> UInt8[np.ndarray, "T h w 3"]:
        """Draw each observation as grey cells, mid-grey at 0; of one in channels, the largest."""
        with third_party():
            observe = jax.vmap(lambda state: self.inner.observe(jax.random.key(0), state, None, self.params))
            obs = np.asarray(observe(jax.tree.map(jnp.asarray, physics.simulation)), np.float32)
        cells = obs.max(axis=3) if obs.ndim == 4 else obs.reshape(len(obs), -1, obs.shape[-1] if obs.ndim > 1 else 1)
        grey = (127.5 + 127.5 * np.tanh(cells)).astype(np.uint8)
        rows, columns = (np.arange(size) * n // size for size, n in zip((height, width), cells.shape[1:], strict=True))
        return np.repeat(grey[:, rows[:, None], columns, None], 3, axis=3)

    def _to_gymnax(self, action: Float[Array, " A"]) -> Array:
        """Return the index of an action, or the vector within its limits in gymnax's shape."""
        if self.discrete:
            return jnp.argmax(action)
        low, high = jnp.asarray(self._space.low), jnp.asarray(self._space.high)
        return (low + high) / 2 + (high - low) / 2 * action.reshape(self._space.shape)


def _flat(obs: Any) -> Float[Array, " S"]:
    return jnp.concatenate([jnp.ravel(leaf).astype(jnp.float32) for leaf in jax.tree.leaves(obs)])
