"""The interface of a physics backend."""

import abc

import jax.numpy as jnp
import mujoco
from jax import Array
from jaxtyping import Float

from taic_jax.envs.base import PhysicsState


class Physics(abc.ABC):
    """A model's dynamics as a pure, unbatched function of a small state; a tick has `substeps` engine steps."""

    def __init__(self, model: mujoco.MjModel, substeps: int):
        self.model, self.substeps = model, substeps

    def init(self, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> PhysicsState:
        """Make the state from which an episode starts; needs no forward pass."""
        return PhysicsState(qpos=qpos, qvel=qvel, qacc_warmstart=jnp.zeros_like(qvel))

    @abc.abstractmethod
    def step(self, state: PhysicsState, ctrl: Float[Array, " nu"]) -> PhysicsState:
        """Advance by one tick, i.e. all its substeps, under constant controls."""
