"""Brax's environments behind `Env`, and ours for Brax's wrappers and trainers."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import Float, Key

from taic_jax.envs.adapters.admission import require_vector_actions, require_vector_obs, strong
from taic_jax.envs.base import Env, State
from taic_jax.envs.errors import AdapterError, UnknownNameError
from taic_jax.envs.third_party import third_party

if TYPE_CHECKING:
    from taic_jax.envs.adapters.brax_export import BraxExport

BRAX_PREFIX = "brax:"
BRAX_PIPELINES = ("spring", "positional", "generalized", "mjx")


class BraxPhysics(struct.PyTreeNode):
    """The parts of Brax's state that outlive a tick and that our `State` does not hold itself."""

    pipeline_state: Any
    info: dict[str, Any]


class BraxEnv(Env):
    """Any environment registered with Brax; its `done` is our `terminated`, and the time limit is ours.

    Args:
      name: as registered with Brax, without prefix.
      pipeline: Brax's physics.

    Raises:
      UnknownNameError: if there is no such environment or pipeline.
      AdapterError: if Brax refuses the pipeline, the observation is not one vector, or actions have no limits.
    """

    episode_length = 1000  # ticks

    def __init__(self, name: str, pipeline: str = "spring"):
        with third_party():
            from brax import envs as brax_envs  # takes seconds, so only those who want Brax wait

        if name not in brax_envs._envs:
            names = [BRAX_PREFIX + known for known in brax_envs._envs]
            raise UnknownNameError("environment", BRAX_PREFIX + name, names)
        if pipeline not in BRAX_PIPELINES:
            raise UnknownNameError("pipeline", pipeline, BRAX_PIPELINES)
        self.name = BRAX_PREFIX + name
        with third_party():
            try:
                self.brax_env: Any = brax_envs.get_environment(name, backend=pipeline)
            except ValueError as error:
                raise AdapterError(f"{self.name}: the pipeline {pipeline!r} does not fit: {error}") from error
            actuator = getattr(getattr(self.brax_env, "sys", None), "actuator", None)
            limits = None if actuator is None else np.asarray(actuator.ctrl_range)
            require_vector_actions(self.name, self.brax_env, limits)
            self.action_size = self.brax_env.action_size
            self.dt = float(getattr(self.brax_env, "dt", 1.0))  # `fast`, a test of Brax's own, has no clock
            start = jax.eval_shape(self.brax_env.reset, jax.random.key(0))
        self._state_type = type(start)
        self.observation_size = self.proprioceptive_size = require_vector_obs(self.name, start.obs)

    def reset(self, key: Key[Array, ""]) -> State:
        """Reset by Brax's own rule."""
        with third_party():
            return _from_brax(self.brax_env.reset(key))

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Step by Brax's own rule."""
        brax_state = self._state_type(
            pipeline_state=state.physics.pipeline_state,
            obs=state.obs,
            reward=state.reward,
            done=state.terminated.astype(jnp.float32),
            metrics=dict(state.metrics),  # Brax writes into the dicts it is given
            info=dict(state.physics.info),
        )
        with third_party():
            after = _from_brax(self.brax_env.step(brax_state, action))
        return after.replace(tick=state.tick, key=state.key, final_obs=state.final_obs)

    def render(self, physics: BraxPhysics, *, height: int = 240, width: int = 320) -> np.ndarray:
        """Draw with MuJoCo's renderer, from Brax's generalised positions."""
        from taic_jax.envs.rendering import render_mujoco

        qpos = physics.pipeline_state.q
        return render_mujoco(self.brax_env.sys.mj_model, qpos, height=height, width=width)


def _from_brax(state: Any) -> State:
    """Convert Brax's state."""
    return State(
        physics=strong(BraxPhysics(pipeline_state=state.pipeline_state, info=state.info)),
        obs=jnp.asarray(state.obs, jnp.float32),
        reward=jnp.asarray(state.reward, jnp.float32),
        terminated=jnp.asarray(state.done, bool),
        truncated=jnp.zeros((), bool),
        metrics={name: jnp.asarray(value, jnp.float32) for name, value in state.metrics.items()},
    )


def to_brax(env: Env) -> "BraxExport":
    """Turn an environment of ours into a `brax.envs.Env`, for Brax's wrappers and trainers.

    Brax counts the ticks, in its `EpisodeWrapper`, so a `TimeLimit` around `env` is taken off; its number is
    still there as `episode_length`, to be passed on: `training.wrap(to_brax(env), env.episode_length)`. At an
    episode's end Brax goes back to the copy's first state, so starts do not vary, nor does a task's `restart` act.
    With JAX 0.10, Brax 0.14.2's PPO stops, for any environment, at a function that JAX took away
    (`device_put_replicated`); its wrappers work.

    Raises:
      AdapterError: `env` is none of ours, resets itself, or has its time limit inside another wrapper.
    """
    with third_party():
        from taic_jax.envs.adapters.brax_export import BraxExport

    return BraxExport(env)
