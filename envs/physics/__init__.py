"""Physics as a pure function of a small state, on interchangeable backends."""

from typing import Protocol

import jax
from jax import Array
from jaxtyping import Float
from mujoco import MjModel

from taic_jax.envs.base import PhysicsState
from taic_jax.envs.errors import UnknownNameError
from taic_jax.envs.physics.mjx import MjxPhysics
from taic_jax.envs.physics.mujoco import MujocoPhysics

BACKENDS = ("auto", "mujoco", "mjx")


class Physics(Protocol):
    """What a task asks of a backend."""

    def init(self, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> PhysicsState:
        """Make the state at rest from which an episode starts; costs no forward pass."""
        ...

    def step(self, state: PhysicsState, ctrl: Float[Array, " nu"]) -> PhysicsState:
        """Advance by one tick, i.e. all its substeps, under constant controls."""
        ...


def make_physics(
    model: MjModel,
    substeps: int,
    backend: str = "auto",
    num_threads: int = 0,
    *,
    iterations: int | None = None,
    ls_iterations: int | None = None,
) -> Physics:
    """Load a model on a backend.

    Args:
      model: compiled model.
      substeps: engine steps a tick.
      backend: `mujoco` (C engine, host threads), `mjx` (JAX), or `auto`: `mujoco` where JAX runs on CPU, else `mjx`.
      num_threads: threads of the `mujoco` backend; 0 takes one per physical core.
      iterations: solver iterations on `mjx`, None for the model's own.
      ls_iterations: line-search iterations on `mjx`, None for the model's own.

    Raises:
      UnknownNameError: if there is no such backend.
    """
    if backend not in BACKENDS:
        raise UnknownNameError("backend", backend, BACKENDS)
    if backend == "auto":
        backend = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    if backend == "mujoco":
        return MujocoPhysics(model, substeps, num_threads)
    return MjxPhysics(model, substeps, iterations, ls_iterations)
