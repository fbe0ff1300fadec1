"""Environments of libraries with Brax's interface behind `Env`: pure functions of a state with `done`."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import Float, Key

from taic_jax.envs.adapters.admission import require_vector_actions
from taic_jax.envs.base import Env, State
from taic_jax.envs.errors import AdapterError
from taic_jax.envs.third_party import third_party


class ForeignPhysics(struct.PyTreeNode):
    """The parts of the library's state that outlive a tick and have no field in our `State`."""

    simulation: Any
    info: dict[str, Any]
    unobserved: dict[str, Array]  # entries of an observation in parts, without its "state"


class ForeignEnv(Env):
    """An environment of such a library; its `done` is our `terminated`, and the time limit is ours.

    Of an observation in parts, the one named "state" is taken. `simulation` names the field of the library's state that
    becomes `ForeignPhysics.simulation`; `limits` are low and high of every action, None if the library has none.

    Raises:
      AdapterError: the observation is not one vector, or actions have no limits.
    """

    def __init__(self, name: str, inner: Any, simulation: str, limits: Float[np.ndarray, "A 2"] | None):
        require_vector_actions(name, inner, limits)
        self.name, self.inner, self._simulation = name, inner, simulation
        with third_party():
            start = jax.eval_shape(self._start, jax.random.key(0))
        self._state_type = type(start)
        self._in_parts = isinstance(start.obs, Mapping)
        obs = start.obs.get("state", start.obs) if self._in_parts else start.obs
        if len(getattr(obs, "shape", ())) != 1:
            shapes = jax.tree.map(lambda leaf: leaf.shape, obs)
            raise AdapterError(f"{name}: obs: got the shapes {shapes}, expected one vector [S]")
        self.observation_size = self.proprioceptive_size = obs.shape[0]
        self.action_size = int(inner.action_size)
        self.dt = float(getattr(inner, "dt", 1.0))  # `fast`, a test of Brax's own, has no clock

    def reset(self, key: Key[Array, ""]) -> State:
        """Reset by the library's own rule."""
        with third_party():
            return self._from_library(self._start(key))

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Step by the library's own rule."""
        physics = state.physics
        before = self._state_type(
            **{self._simulation: physics.simulation},
            obs={**physics.unobserved, "state": state.obs} if self._in_parts else state.obs,
            reward=state.reward,
            done=state.terminated.astype(jnp.float32),
            metrics=dict(state.metrics),  # a copy, as the libraries write into these dicts
            info=dict(physics.info),
        )
        with third_party():
            after = self._from_library(self.inner.step(before, action))
        return after.replace(tick=state.tick, key=state.key, final_obs=state.final_obs)

    def _start(self, key: Key[Array, ""]) -> Any:
        return self.inner.reset(key)

    def _from_library(self, state: Any) -> State:
        parts = dict(state.obs) if self._in_parts else {"state": state.obs}
        obs = parts.pop("state")
        physics = jax.tree.map(strong, ForeignPhysics(getattr(state, self._simulation), state.info, parts))
        obs, reward = jnp.asarray(obs, jnp.float32), jnp.asarray(state.reward, jnp.float32)
        metrics = {name: jnp.asarray(value, jnp.float32) for name, value in state.metrics.items()}
        return State.first(physics, obs, metrics).replace(reward=reward, terminated=jnp.asarray(state.done, bool))


def strong(leaf: Any) -> Array:
    """Return an array of strong dtype, so that reset and step return the same types."""
    array = jnp.asarray(leaf)
    return jax.lax.convert_element_type(array, array.dtype)
