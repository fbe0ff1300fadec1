"""Physics as a pure function of a small state, on interchangeable backends."""

import jax
from mujoco import MjModel

from taic_jax.envs.base import Physics
from taic_jax.envs.errors import UnknownNameError
from taic_jax.envs.physics.mujoco import MujocoPhysics

__all__ = ["BACKENDS", "MujocoPhysics", "Physics", "make_physics"]

BACKENDS = ("auto", "mujoco", "mjx", "warp")


def make_physics(
    model: MjModel, substeps: int, backend: str = "auto", num_threads: int = 0,
    *, iterations: int | None = None, ls_iterations: int | None = None, sensors: bool = False,
) -> Physics:  # fmt: skip
    """Load a model on a backend.

    Args:
      substeps: engine steps a tick.
      backend: `mujoco` (C engine, host's cores), `mjx` (JAX), `warp` (MJX on MuJoCo Warp, NVIDIA only), or `auto`:
        `mujoco` if JAX runs on CPU, else `mjx`.
      num_threads: of the `mujoco` backend; 0 shares the physical cores between JAX's devices.
      iterations, ls_iterations: of solver and line search on `mjx` and `warp`; None for the model's own.
      sensors: carry what the model's sensors read, as `sensordata`.

    Raises:
      UnknownNameError: there is no such backend.
      MissingExtraError: the backend's package is not installed.
      BackendError: the backend's device is missing.
      ModelError: the model has state that `PhysicsState` cannot carry.
    """
    if backend not in BACKENDS:
        raise UnknownNameError("backend", backend, BACKENDS)
    if backend == "auto":
        backend = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    if backend == "mujoco":
        return MujocoPhysics(model, substeps, num_threads, sensors=sensors)
    from taic_jax.envs.physics.mjx import MjxPhysics  # MJX takes a second to import

    return MjxPhysics(model, substeps, iterations, ls_iterations, sensors=sensors, warp=backend == "warp")
