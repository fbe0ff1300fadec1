"""MuJoCo in JAX (MJX): the same models on GPU and TPU."""

import jax
import jax.numpy as jnp
import mujoco
from jax import Array
from jaxtyping import Float

from taic_jax.envs.base import PhysicsState
from taic_jax.envs.third_party import third_party


class MjxPhysics:
    """Steps of `mujoco.mjx` on a template `mjx.Data`, of which only `PhysicsState` and the controls change.

    Args:
      model: compiled model.
      substeps: engine steps a tick.
      iterations: solver iterations in place of the model's. Fewer are faster and soon wrong: a single one puts
        joint velocities of the ant off by 10 rad/s within a tick.
      ls_iterations: line-search iterations in place of the model's; 4 change nothing measurable and save most.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        substeps: int,
        iterations: int | None = None,
        ls_iterations: int | None = None,
    ):
        with third_party():
            from mujoco import mjx  # slow to import, and needed by this backend alone

        self.model = model
        self.substeps = substeps
        with third_party():
            mjx_model = mjx.put_model(model)
            option = mjx_model.opt.replace(
                iterations=iterations or mjx_model.opt.iterations,
                ls_iterations=ls_iterations or mjx_model.opt.ls_iterations,
            )
            self._model = mjx_model.replace(opt=option)
            self._data = mjx.make_data(self._model)
        self._mjx_step = mjx.step

    def init(self, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> PhysicsState:
        """Make the state from which an episode starts."""
        return PhysicsState(qpos=qpos, qvel=qvel, qacc_warmstart=jnp.zeros_like(qvel))

    def step(self, state: PhysicsState, ctrl: Float[Array, " nu"]) -> PhysicsState:
        """Advance by one tick under constant controls."""

        def substep(state: PhysicsState, _: None) -> tuple[PhysicsState, None]:
            data = self._data.replace(
                qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart, ctrl=ctrl
            )
            data = self._mjx_step(self._model, data)
            return PhysicsState(qpos=data.qpos, qvel=data.qvel, qacc_warmstart=data.qacc_warmstart), None

        with third_party():
            return jax.lax.scan(substep, state, length=self.substeps)[0]
