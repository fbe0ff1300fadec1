"""MuJoCo Playground's environments behind `Env`."""

import copy
import importlib
from typing import Any

import jax
import numpy as np
from jax import Array
from jaxtyping import Key

from taic_jax.envs.adapters.admission import extra
from taic_jax.envs.adapters.foreign import ForeignEnv, ForeignPhysics
from taic_jax.envs.errors import AdapterError, UnknownNameError
from taic_jax.envs.rendering import render_mujoco
from taic_jax.envs.third_party import third_party

PLAYGROUND_PREFIX = "playground:"


class PlaygroundEnv(ForeignEnv):
    """The environment registered with MuJoCo Playground under a name, without prefix.

    Physics is MJX's in JAX, also where Playground would choose Warp, and an action is applied for one step, at any
    `action_repeat`.

    Raises:
      MissingExtraError: Playground is not installed.
      UnknownNameError: there is no such environment.
      AdapterError: it needs models that are not on this machine, which are never downloaded, its observation is not one
        vector, or actions have no limits.
    """

    def __init__(self, name: str):
        with third_party(), extra("playground"):
            registry: Any = importlib.import_module("mujoco_playground").registry
        suites = (registry.dm_control_suite, registry.locomotion, registry.manipulation)
        names = [each for suite in suites for each in suite.ALL_ENVS]
        if name not in names:
            valid = [PLAYGROUND_PREFIX + each for each in names]
            raise UnknownNameError("environment", PLAYGROUND_PREFIX + name, valid)
        if name not in registry.dm_control_suite.ALL_ENVS:
            _require_menagerie(PLAYGROUND_PREFIX + name, registry.mjx_env)
        config = registry.get_default_config(name)
        self.episode_length = int(config.episode_length)
        with third_party():
            inner: Any = registry.load(name, config, {"impl": "jax"} if "impl" in config else {})
        model = inner.mj_model
        limits = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, [[-np.inf, np.inf]])
        super().__init__(PLAYGROUND_PREFIX + name, inner, "data", limits)

    def render(self, physics: ForeignPhysics, *, height: int = 240, width: int = 320) -> np.ndarray:
        """Draw with MuJoCo's renderer, from qpos and the places of the targets (mocap bodies)."""
        model, data = self.inner.mj_model, physics.simulation
        qpos, mocap = np.asarray(data.qpos), np.asarray(data.mocap_pos)
        bounds = np.flatnonzero((mocap[1:] != mocap[:-1]).any(axis=(1, 2))) + 1
        frames = []
        for start, stop in zip([0, *bounds], [*bounds, len(qpos)], strict=True):
            scene = copy.copy(model)  # a mocap body is drawn at its place in the model
            scene.body_pos[scene.body_mocapid >= 0] = mocap[start][scene.body_mocapid[scene.body_mocapid >= 0]]
            frames.append(render_mujoco(scene, qpos[start:stop], height=height, width=width))
        return np.concatenate(frames)

    def _start(self, key: Key[Array, ""]) -> Any:
        return self.inner.reset(jax.random.key_data(key))  # Playground keeps raw keys in its info


def _require_menagerie(name: str, mjx_env: Any) -> None:
    """Raise `AdapterError` before Playground clones its robots from the network."""
    if not mjx_env.MENAGERIE_PATH.exists():
        raise AdapterError(
            f"{name}: needs the robots of github.com/google-deepmind/mujoco_menagerie, expected commit "
            f"{mjx_env.MENAGERIE_COMMIT_SHA} in {mjx_env.MENAGERIE_PATH}; without them: {PLAYGROUND_PREFIX}CheetahRun"
        )
