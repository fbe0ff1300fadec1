"""MuJoCo's C engine on all cores, called from inside a jitted program."""

import functools
import hashlib
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import mujoco.batch
import numpy as np
import psutil
from jax import Array
from jaxtyping import Float

from taic_jax.envs.base import Physics, PhysicsState
from taic_jax.envs.physics.host_call import HostFunction
from taic_jax.envs.physics.watchdog import Watchdog

# Contents of a call, in the order of MuJoCo's state rows, where only the time precedes it.
_STATE, _WARNING = mujoco.mjtState, mujoco.mjtWarning
_CARRIED = _STATE.mjSTATE_QPOS, _STATE.mjSTATE_QVEL, _STATE.mjSTATE_ACT, _STATE.mjSTATE_WARMSTART
_SENT = sum(x.value for x in (*_CARRIED, _STATE.mjSTATE_CTRL))
# After these warnings MuJoCo has put the simulation back to its initial pose.
_DIVERGED = [x.value for x in (_WARNING.mjWARN_BADQPOS, _WARNING.mjWARN_BADQVEL, _WARNING.mjWARN_BADQACC)]
PATIENCE = 60.0
"""Seconds after which a call that has not returned is reported; our longest calls take a tenth of a second."""
LATE = (
    f"the physics has not returned for {PATIENCE:.0f} s. If it never does: end the process (kill -9), go on from the "
    "last checkpoint (--resume), and should it happen again, step with one thread (--env.num-threads 1)"
)


class MujocoPhysics(Physics):
    """A host call of `mujoco.batch.Batch`; all leading axes (seeds, environments) are one engine call.

    It is pure: the result depends on the arguments alone, at any number of threads. Each call overwrites every state
    field that `mj_step` reads (qpos, qvel, act, qacc_warmstart, ctrl). The others never change: equalities are active
    or not as in the model, no forces are applied, and the time enters no force. A simulation that diverges returns NaN.
    Later changes of the model have no effect. For arguments and errors see `make_physics`.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int, num_threads: int = 0, *, sensors: bool = False):
        super().__init__(model, substeps, sensors)
        self.num_threads = num_threads or max(1, num_physical_cores() // jax.local_device_count())
        saved = np.empty(mujoco.mj_sizeModel(model), np.uint8)
        mujoco.mj_saveModel(model, None, saved)
        self.engine = _engine(saved.tobytes(), substeps, self.num_threads, sensors)

    def step(self, state: PhysicsState, ctrl: Float[Array, " nu"]) -> PhysicsState:
        model = self.model
        act = [] if state.act is None else [state.act]
        sent = jnp.concatenate([state.qpos, state.qvel, *act, state.qacc_warmstart, ctrl])
        after = self.engine.call(sent, size=self.engine.num_returned)
        ends = np.cumsum([model.nq, model.nv, model.na, model.nv])
        qpos, qvel, act, warmstart, sensordata = jnp.split(after, ends)
        read = {"act": act if model.na else None, "sensordata": sensordata if self.sensors else None}
        return state.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart, **read)


class Engine:
    """Steps of a model's simulations on the host, any number in one call, from any number of threads.

    The name is of this engine's host call alone, and nothing else changes its model.
    """

    def __init__(self, name: str, model: mujoco.MjModel, substeps: int, num_threads: int, sensors: bool):
        self._num_carried = mujoco.mj_stateSize(model, sum(x.value for x in _CARRIED))
        self.num_returned = self._num_carried + (model.nsensordata if sensors else 0)
        self.call = HostFunction(name, self.step)
        self._model, self._substeps, self._num_threads = model, substeps, num_threads
        self._watchdog = Watchdog(PATIENCE, LATE)
        self._idle: dict[int, list[mujoco.batch.Batch]] = {}
        first = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_TIME.value)
        self._sent = slice(first, first + mujoco.mj_stateSize(model, _SENT))

    def step(self, sent: Float[np.ndarray, "*batch n"], after: Float[np.ndarray, "*batch m"]) -> None:
        """Step all simulations. NumPy only: to call JAX here can deadlock."""
        sent, after = sent.reshape(-1, sent.shape[-1]), after.reshape(-1, after.shape[-1])
        idle = self._idle.setdefault(len(sent), [])
        try:
            batch = idle.pop()  # a batch serves one caller at a time
        except IndexError:
            batch = mujoco.batch.Batch(self._model, len(sent), min(self._num_threads, len(sent)))
            batch.bind("sensordata")  # before its first call, or it reads 0
        rows = batch.state[:, self._sent]
        rows[...] = sent
        with self._watchdog:
            batch.step(nstep=self._substeps)
        after[:, : self._num_carried] = rows[:, : self._num_carried]
        if self.num_returned > self._num_carried:
            after[:, self._num_carried :] = batch.sensordata
        if batch.warning.any():  # [simulations, kinds, (last info, count)]
            after[batch.warning[:, _DIVERGED, 1].any(axis=1)] = np.nan
            batch.warning[...] = 0
        idle.append(batch)


@functools.cache
def _engine(model: bytes, substeps: int, num_threads: int, sensors: bool) -> Engine:
    """Return the engine of a saved model: one a process, since compiled programs call it by its name."""
    digest = hashlib.sha256(model).hexdigest()[:16]
    loaded = mujoco.MjModel.from_binary_path("model.mjb", {"model.mjb": model})
    name = f"taic_jax_mujoco_{digest}_{substeps}_{num_threads}{'_sensors' if sensors else ''}"
    return Engine(name, loaded, substeps, num_threads, sensors)


def num_physical_cores() -> int:
    """Count the physical cores of this process; the hyperthreads of a core count once."""
    if not hasattr(os, "sched_getaffinity"):
        return psutil.cpu_count(logical=False) or 1
    cores = set()
    for cpu in os.sched_getaffinity(0):
        siblings = Path(f"/sys/devices/system/cpu/cpu{cpu}/topology/thread_siblings_list")
        cores.add(siblings.read_text() if siblings.exists() else cpu)
    return len(cores)
