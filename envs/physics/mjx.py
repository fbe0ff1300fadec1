"""MuJoCo in JAX (MJX): the same models on GPU and TPU; on NVIDIA's, also by MuJoCo Warp."""

import importlib.util

import jax
import mujoco
from jax import Array
from jaxtyping import Float

from taic_jax.envs.base import Physics, PhysicsState
from taic_jax.envs.errors import BackendError, MissingExtraError
from taic_jax.envs.third_party import third_party

with third_party():
    from mujoco import mjx


# Warp keeps the contacts of all simulations of a call in one pool, and constraint rows by simulation.
# Both sizes are estimates for 8192 simulations; 4096 ants fit on a GPU.
_WARP_CAPACITY = {"naconmax": 32 * 8192, "njmax": 200}


class MjxPhysics(Physics):
    """Steps of MJX on a template `mjx.Data`, of which only `PhysicsState` and the controls change.

    Fewer solver iterations are faster and soon wrong: with one, the ant's joint velocities are off by 10 rad/s within a
    tick. Of the line search, 4 iterations change nothing measurable. For arguments and errors see `make_physics`.
    """

    def __init__(
        self, model: mujoco.MjModel, substeps: int, iterations: int | None = None, ls_iterations: int | None = None,
        *, sensors: bool = False, warp: bool = False,
    ):  # fmt: skip
        if warp:
            _require_warp()
        super().__init__(model, substeps, sensors)
        impl = "warp" if warp else "jax"
        with third_party():
            mjx_model = mjx.put_model(model, impl=impl)
            settings = {"iterations": iterations, "ls_iterations": ls_iterations}
            option = mjx_model.opt.replace(**{name: value for name, value in settings.items() if value})
            if warp:  # or each step that takes all its iterations prints a line for every simulation
                option = option.tree_replace({"_impl.warn_overflow": 0})
            self._model = mjx_model.replace(opt=option)
            self._data = mjx.make_data(model, impl=impl, **(_WARP_CAPACITY if warp else {}))

    def step(self, state: PhysicsState, ctrl: Float[Array, " nu"]) -> PhysicsState:
        def substep(state: PhysicsState, _: None) -> tuple[PhysicsState, None]:
            act = {} if state.act is None else {"act": state.act}
            data = self._data.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart, **act)
            data = mjx.step(self._model, data.replace(ctrl=ctrl))
            carried = {"qpos": data.qpos, "qvel": data.qvel, "qacc_warmstart": data.qacc_warmstart}
            act = None if state.act is None else data.act
            return state.replace(**carried, act=act, sensordata=data.sensordata if self.sensors else None), None

        with third_party():
            return jax.lax.scan(substep, state, length=self.substeps)[0]


def _require_warp() -> None:
    if importlib.util.find_spec("warp") is None:
        raise MissingExtraError("warp-lang", "warp")
    if jax.default_backend() not in ("gpu", "cuda"):
        raise BackendError("warp", f"an NVIDIA GPU, and JAX runs on {jax.default_backend()}")
    import warp

    warp.config.log_level = warp.LOG_WARNING  # below, it prints a line for each kernel that it loads
