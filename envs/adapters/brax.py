"""Brax's environments behind `Env`."""

from typing import Any

import numpy as np

from taic_jax.envs.adapters.foreign import ForeignEnv, ForeignPhysics
from taic_jax.envs.errors import AdapterError, UnknownNameError
from taic_jax.envs.rendering import render_mujoco
from taic_jax.envs.third_party import third_party

BRAX_PREFIX = "brax:"
BRAX_PIPELINES = ("spring", "positional", "generalized", "mjx")


class BraxEnv(ForeignEnv):
    """The environment registered with Brax under a name, without prefix, on one of Brax's pipelines.

    Raises:
      UnknownNameError: there is no such environment or pipeline.
      AdapterError: Brax refuses the pipeline, the observation is not one vector, or actions have no limits.
    """

    episode_length = 1000  # ticks

    def __init__(self, name: str, pipeline: str = "spring"):
        with third_party():
            from brax import envs as brax_envs  # its import takes seconds

        if name not in brax_envs._envs:
            raise UnknownNameError("environment", BRAX_PREFIX + name, [BRAX_PREFIX + each for each in brax_envs._envs])
        if pipeline not in BRAX_PIPELINES:
            raise UnknownNameError("pipeline", pipeline, BRAX_PIPELINES)
        try:
            with third_party():
                inner: Any = brax_envs.get_environment(name, backend=pipeline)
        except ValueError as error:
            raise AdapterError(f"{BRAX_PREFIX}{name}: the pipeline {pipeline!r} does not fit: {error}") from error
        actuator = getattr(getattr(inner, "sys", None), "actuator", None)
        limits = None if actuator is None else np.asarray(actuator.ctrl_range)
        super().__init__(BRAX_PREFIX + name, inner, "pipeline_state", limits)

    def render(self, physics: ForeignPhysics, *, height: int = 240, width: int = 320) -> np.ndarray:
        """Draw with MuJoCo's renderer, from Brax's generalised positions."""
        return render_mujoco(self.inner.sys.mj_model, physics.simulation.q, height=height, width=width)
