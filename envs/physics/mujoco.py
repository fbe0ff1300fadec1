"""MuJoCo's C engine on all cores, called from inside a jitted program."""

import functools
import os
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np
from jax import Array
from jaxtyping import Float

from taic_jax.envs.base import PhysicsState

# The state that MuJoCo integrates, in the order of its state rows (time, of no consequence here, precedes them).
_PACKED = (
    mujoco.mjtState.mjSTATE_QPOS,
    mujoco.mjtState.mjSTATE_QVEL,
    mujoco.mjtState.mjSTATE_WARMSTART,
    mujoco.mjtState.mjSTATE_CTRL,
)
# After these warnings MuJoCo has put the simulation back to its initial pose.
_DIVERGED = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]


class MujocoPhysics:
    """A batched host callback over `mujoco.batch.Batch`.

    It is pure: what stays in the engine between calls is scratch. Each call overwrites every state field that
    `mj_step` reads (qpos, qvel, qacc_warmstart, ctrl; the models have no actuator states, mocap bodies or
    plugins, forces are never applied, and time enters neither forces nor constraints), so the result depends on
    the arguments alone, at any number of threads. A simulation that diverges comes back as NaN. All leading axes (seeds, environments) become one call of the
    engine. Calls are serialised: a `Batch` serves one caller at a time.

    Args:
      model: compiled model.
      substeps: engine steps a tick.
      num_threads: threads that step simulations; 0 takes one per physical core.

    Raises:
      ValueError: if the model has state that `PhysicsState` does not carry.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int, num_threads: int = 0):
        if model.na or model.nhistory or model.nmocap or model.npluginstate or model.neq:
            raise ValueError("MujocoPhysics carries qpos and qvel only: no activations, mocap, plugins or equalities")
        self.model = model
        self.substeps = substeps
        self.num_threads = num_threads or num_physical_cores()
        self._lock = threading.Lock()
        self._batches: dict[int, tuple[mujoco.batch.Batch, np.ndarray]] = {}

    def init(self, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> PhysicsState:
        """Make the state from which an episode starts."""
        return PhysicsState(qpos=qpos, qvel=qvel, qacc_warmstart=jnp.zeros_like(qvel))

    def step(self, state: PhysicsState, ctrl: Float[Array, " nu"]) -> PhysicsState:
        """Advance by one tick under constant controls."""
        nq, nv = self.model.nq, self.model.nv
        packed = jnp.concatenate([state.qpos, state.qvel, state.qacc_warmstart, ctrl])
        out = jax.ShapeDtypeStruct((nq + 2 * nv,), jnp.float32)
        after = jax.pure_callback(self._step, out, packed, vmap_method="broadcast_all")
        return PhysicsState(qpos=after[:nq], qvel=after[nq : nq + nv], qacc_warmstart=after[nq + nv :])

    def _step(self, packed: Float[Array, "*batch n"]) -> Float[np.ndarray, "*batch m"]:
        """Step all simulations on the host. NumPy only: to call JAX in a callback can deadlock."""
        packed = np.asarray(packed)
        simulations = packed.reshape(-1, packed.shape[-1])
        with self._lock:
            batch, rows = self._batch(len(simulations))
            rows[...] = simulations
            batch.step(nstep=self.substeps)
            after = rows[:, : self.model.nq + 2 * self.model.nv].astype(np.float32)
            if batch.warning.any():
                after[batch.warning[:, _DIVERGED, 1].any(axis=1)] = np.nan
                batch.warning[:] = 0
        return after.reshape(*packed.shape[:-1], -1)

    def _batch(self, num_simulations: int) -> tuple[mujoco.batch.Batch, np.ndarray]:
        """Return the engine for that many simulations and a live view of its packed state rows."""
        if num_simulations not in self._batches:
            batch = mujoco.batch.Batch(self.model, num_simulations, min(self.num_threads, num_simulations))
            start = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_TIME)
            size = mujoco.mj_stateSize(self.model, functools.reduce(lambda a, b: a | b, _PACKED))
            self._batches[num_simulations] = batch, batch.state[:, start : start + size]
        return self._batches[num_simulations]


def num_physical_cores() -> int:
    """Count the physical cores this process may use; hyperthreads of one core count once."""
    if not hasattr(os, "sched_getaffinity"):
        return os.cpu_count() or 1
    cores = set()
    for cpu in os.sched_getaffinity(0):
        siblings = Path(f"/sys/devices/system/cpu/cpu{cpu}/topology/thread_siblings_list")
        cores.add(siblings.read_text() if siblings.exists() else cpu)
    return len(cores)
