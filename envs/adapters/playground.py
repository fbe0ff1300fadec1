"""MuJoCo Playground's environments behind `Env`."""

import copy
import importlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import Float, Key

from taic_jax.envs.adapters.admission import extra, require_vector_actions, require_vector_obs, strong
from taic_jax.envs.base import Env, State
from taic_jax.envs.errors import AdapterError, UnknownNameError
from taic_jax.envs.third_party import third_party

PLAYGROUND_PREFIX = "playground:"


class PlaygroundPhysics(struct.PyTreeNode):
    """The parts of Playground's state that outlive a tick and that our `State` does not hold itself."""

    data: Any  # mjx.Data
    info: dict[str, Any]
    unobserved: dict[str, Array]  # entries of an observation in parts, without its "state"


class PlaygroundEnv(Env):
    """An environment of MuJoCo Playground; its `done` is our `terminated`, and the time limit is ours.

    Of an observation in parts, the one named "state" is taken. Physics is MJX's in JAX, also where Playground
    would choose Warp, and an action is applied for one step, whatever `action_repeat` its configuration holds.

    Args:
      name: as registered with Playground, without prefix.

    Raises:
      MissingExtraError: Playground is not installed.
      UnknownNameError: if there is no such environment.
      AdapterError: if it needs models that are not on this machine, which are never downloaded, its observation
        is not one vector, or actions have no limits.
    """

    def __init__(self, name: str):
        self.name = PLAYGROUND_PREFIX + name
        with third_party(), extra("playground"):
            registry: Any = importlib.import_module("mujoco_playground").registry
        suites = (registry.dm_control_suite, registry.locomotion, registry.manipulation)
        if not any(name in suite.ALL_ENVS for suite in suites):
            names = [PLAYGROUND_PREFIX + known for suite in suites for known in suite.ALL_ENVS]
            raise UnknownNameError("environment", self.name, names)
        if name not in registry.dm_control_suite.ALL_ENVS:
            _require_menagerie(self.name, registry.mjx_env)
        config = registry.get_default_config(name)
        with third_party():
            overrides: dict[str, Any] = {"impl": "jax"} if "impl" in config else {}
            self.playground_env: Any = registry.load(name, config, overrides)
            start = jax.eval_shape(self.playground_env.reset, _raw(jax.random.key(0)))
        model = self.playground_env.mj_model
        limits = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [[-np.inf, np.inf]])
        require_vector_actions(self.name, self.playground_env, limits)
        self._state_type = type(start)
        self._in_parts = isinstance(start.obs, Mapping)
        obs = start.obs.get("state", start.obs) if self._in_parts else start.obs
        self.observation_size = self.proprioceptive_size = require_vector_obs(self.name, obs)
        self.action_size = int(self.playground_env.action_size)
        self.episode_length = int(config.episode_length)
        self.dt = float(self.playground_env.dt)

    def reset(self, key: Key[Array, ""]) -> State:
        """Reset by Playground's own rule."""
        with third_party():
            return self._from_playground(self.playground_env.reset(_raw(key)))

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Step by Playground's own rule."""
        physics = state.physics
        before = self._state_type(
            data=physics.data,
            obs={**physics.unobserved, "state": state.obs} if self._in_parts else state.obs,
            reward=state.reward,
            done=state.terminated.astype(jnp.float32),
            metrics=dict(state.metrics),  # Playground writes into the dicts it is given
            info=dict(physics.info),
        )
        with third_party():
            after = self._from_playground(self.playground_env.step(before, action))
        return after.replace(tick=state.tick, key=state.key, final_obs=state.final_obs)

    def render(self, physics: PlaygroundPhysics, *, height: int = 240, width: int = 320) -> np.ndarray:
        """Draw with MuJoCo's renderer, from qpos and from where the targets (mocap bodies) are."""
        from taic_jax.envs.rendering import render_mujoco

        model = self.playground_env.mj_model
        qpos, mocap = np.asarray(physics.data.qpos), np.asarray(physics.data.mocap_pos)
        bounds = np.flatnonzero((mocap[1:] != mocap[:-1]).any(axis=(1, 2))) + 1
        frames = []
        for start, stop in zip([0, *bounds], [*bounds, len(qpos)], strict=True):
            scene = copy.copy(model)  # a mocap body is drawn where the model puts it
            scene.body_pos[scene.body_mocapid >= 0] = mocap[start][scene.body_mocapid[scene.body_mocapid >= 0]]
            frames.append(render_mujoco(scene, qpos[start:stop], height=height, width=width))
        return np.concatenate(frames)

    def _from_playground(self, state: Any) -> State:
        parts = dict(state.obs) if self._in_parts else {"state": state.obs}
        obs = parts.pop("state")
        return State(
            physics=strong(PlaygroundPhysics(data=state.data, info=state.info, unobserved=parts)),
            obs=jnp.asarray(obs, jnp.float32),
            reward=jnp.asarray(state.reward, jnp.float32),
            terminated=jnp.asarray(state.done, bool),
            truncated=jnp.zeros((), bool),
            metrics={name: jnp.asarray(value, jnp.float32) for name, value in state.metrics.items()},
        )


def _raw(key: Key[Array, ""]) -> Array:
    """Return the kind of key that Playground's environments keep in their info."""
    return jax.random.key_data(key)


def _require_menagerie(name: str, mjx_env: Any) -> None:
    """Stop before Playground would clone its robots from the network."""
    if not mjx_env.MENAGERIE_PATH.exists():
        raise AdapterError(
            f"{name}: needs the robots of github.com/google-deepmind/mujoco_menagerie, expected commit "
            f"{mjx_env.MENAGERIE_COMMIT_SHA} in {mjx_env.MENAGERIE_PATH}; without them: {PLAYGROUND_PREFIX}CheetahRun"
        )
