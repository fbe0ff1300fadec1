"""MuJoCo's C engine on all cores, called from inside a jitted program."""

import os
import threading
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np
from jax import Array
from jax.experimental.buffer_callback import buffer_callback
from jaxtyping import Float

from taic_jax.envs.base import PhysicsState
from taic_jax.envs.physics.base import Physics
from taic_jax.envs.physics.watchdog import Watchdog

# What a call sends, in the order of MuJoCo's state rows, where only the time precedes it.
_SENT = (
    mujoco.mjtState.mjSTATE_QPOS.value
    | mujoco.mjtState.mjSTATE_QVEL.value
    | mujoco.mjtState.mjSTATE_WARMSTART.value
    | mujoco.mjtState.mjSTATE_CTRL.value
)
# After these warnings MuJoCo has put the simulation back to its initial pose.
_DIVERGED = [
    mujoco.mjtWarning.mjWARN_BADQPOS.value,
    mujoco.mjtWarning.mjWARN_BADQVEL.value,
    mujoco.mjtWarning.mjWARN_BADQACC.value,
]
PATIENCE = 60.0
"""Seconds after which a call that has not returned is told; the longest of ours take a tenth of one."""
LATE = (
    f"the physics has not returned for {PATIENCE:.0f} s. If it never does: end the process (kill -9), go on from the "
    "last checkpoint (--resume), and should it happen again, step with one thread (--env.num-threads 1)"
)


class MujocoPhysics(Physics):
    """A host callback over `mujoco.batch.Batch`; all leading axes (seeds, environments) are one engine call.

    It is pure: what the engine keeps between calls is scratch. Each call overwrites every state field that
    `mj_step` reads (qpos, qvel, qacc_warmstart, ctrl). The others never change: models with activations,
    mocap bodies, plugins or equalities are refused, no forces are applied, and the time enters no force. So
    the result depends on the arguments alone, at any number of threads. A simulation that diverges comes back
    as NaN. Calls are serialised, since a `Batch` serves one caller at a time.

    Args:
      model: compiled model.
      substeps: engine steps a tick.
      num_threads: threads that step simulations; 0 takes one per physical core.

    Raises:
      ValueError: if the model has state that `PhysicsState` does not carry.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int, num_threads: int = 0):
        if model.na or model.nhistory or model.nmocap or model.nplugin or model.neq:
            raise ValueError("the model must have no activations, mocap bodies, plugins or equalities")
        super().__init__(model, substeps)
        self.num_threads = num_threads or num_physical_cores()
        self._lock = threading.Lock()
        self._watchdog = Watchdog(PATIENCE, LATE)
        self._batches: dict[int, tuple[mujoco.batch.Batch, np.ndarray]] = {}

    def step(self, state: PhysicsState, ctrl: Float[Array, " nu"]) -> PhysicsState:
        """Advance by one tick under constant controls."""
        nq, nv = self.model.nq, self.model.nv
        sent = jnp.concatenate([state.qpos, state.qvel, state.qacc_warmstart, ctrl])
        shape = jax.ShapeDtypeStruct((nq + 2 * nv,), jnp.float32)
        after = jax.lax.platform_dependent(
            sent,
            cpu=buffer_callback(self._step_buffer, shape, vmap_method="broadcast_all"),
            default=lambda sent: jax.pure_callback(self._step_copy, shape, sent, vmap_method="broadcast_all"),
        )
        return state.replace(qpos=after[:nq], qvel=after[nq : nq + nv], qacc_warmstart=after[nq + nv :])

    def _step_buffer(self, context: Any, after: Any, sent: Any) -> None:
        """Step in XLA's own memory: on CPU, where `pure_callback` takes ten times as long to hand arrays over."""
        self._step(np.asarray(sent), np.asarray(after))

    def _step_copy(self, sent: Float[Array, "*batch n"]) -> Float[np.ndarray, "*batch m"]:
        """Step simulations whose state comes from an accelerator."""
        after = np.empty((*sent.shape[:-1], self.model.nq + 2 * self.model.nv), np.float32)
        self._step(np.asarray(sent), after)
        return after

    def _step(self, sent: Float[np.ndarray, "*batch n"], after: Float[np.ndarray, "*batch m"]) -> None:
        """Step all simulations on the host. NumPy only: to call JAX in a callback can deadlock."""
        sent, after = sent.reshape(-1, sent.shape[-1]), after.reshape(-1, after.shape[-1])
        with self._lock:
            batch, rows = self._batch(len(sent))
            rows[...] = sent
            with self._watchdog:
                batch.step(nstep=self.substeps)
            after[...] = rows[:, : after.shape[-1]]
            if batch.warning.any():  # [simulations, kinds, (last info, count)]
                after[batch.warning[:, _DIVERGED, 1].any(axis=1)] = np.nan
                batch.warning[...] = 0

    def _batch(self, num_simulations: int) -> tuple[mujoco.batch.Batch, np.ndarray]:
        """Return the engine for so many simulations, and the part of its state rows that calls overwrite."""
        if num_simulations not in self._batches:
            batch = mujoco.batch.Batch(self.model, num_simulations, min(self.num_threads, num_simulations))
            start = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_TIME.value)
            stop = start + mujoco.mj_stateSize(self.model, _SENT)
            self._batches[num_simulations] = batch, batch.state[:, start:stop]
        return self._batches[num_simulations]


def num_physical_cores() -> int:
    """Count the physical cores this process may use; the hyperthreads of a core count once."""
    if not hasattr(os, "sched_getaffinity"):
        return os.cpu_count() or 1
    cores = set()
    for cpu in os.sched_getaffinity(0):
        siblings = Path(f"/sys/devices/system/cpu/cpu{cpu}/topology/thread_siblings_list")
        cores.add(siblings.read_text() if siblings.exists() else cpu)
    return len(cores)
