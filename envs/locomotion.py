"""Running tasks with the semantics of Gym's MuJoCo environments, version 1, on the MJCF that Brax ships."""

import dataclasses
import importlib.util
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Float, Key

from taic_jax.envs.base import Env, PhysicsState, State
from taic_jax.envs.physics import make_physics

_METRICS = ("forward_reward", "healthy_reward", "control_cost", "x_velocity")


@dataclasses.dataclass(frozen=True)
class Robot:
    """What a running task takes from its body: the model, and the constants of Gym's reward, start and end.

    `name` is the task's and the MJCF file's.
    """

    name: str
    num_unobserved: int  # leading entries of qpos left out of obs: the place on the ground
    control_cost: float  # weight of |action|^2
    healthy_reward: float = 0.0  # a tick
    healthy_height: tuple[float, float] = (-math.inf, math.inf)  # m; outside it the episode ends
    height_index: int = 1  # entry of qpos that is the torso's height
    substeps: int = 5
    reset_noise: float = 0.1  # half-width on qpos (uniform), standard deviation on qvel (normal)
    episode_length: int = 1000  # ticks
    iterations: int | None = None  # of MJX's solver; None for the model's own
    ls_iterations: int | None = 4  # of its line search


HALF_CHEETAH = Robot("half_cheetah", num_unobserved=1, control_cost=0.1)
ANT = Robot(
    "ant",
    num_unobserved=2,
    control_cost=0.5,
    healthy_reward=1.0,
    healthy_height=(0.2, 1.0),
    height_index=2,
)


class Locomotion(Env):
    """Run along x: reward = dx/dt + healthy_reward - control_cost |a|^2 each tick.

    Observation: qpos without the place on the ground, then qvel. Positions are read from qpos, which, unlike
    the world positions of bodies, is current after a step. A simulation that diverges ends the episode in its
    last finite state.

    Args:
      robot: the body's description.
      backend: see `make_physics`.
      num_threads: see `make_physics`.
    """

    def __init__(self, robot: Robot, backend: str = "auto", num_threads: int = 0):
        self.robot = robot
        self.name = robot.name
        self.model = load_brax_model(robot.name)
        self.physics = make_physics(
            self.model,
            robot.substeps,
            backend,
            num_threads,
            iterations=robot.iterations,
            ls_iterations=robot.ls_iterations,
        )
        self.action_size = self.model.nu
        self.observation_size = self.model.nq - robot.num_unobserved + self.model.nv
        self.proprioceptive_size = self.observation_size
        self.episode_length = robot.episode_length
        self.dt = self.model.opt.timestep * robot.substeps
        self._init_qpos = jnp.asarray(initial_qpos(self.model), jnp.float32)

    def reset(self, key: Key[Array, ""]) -> State:
        """Start near the initial pose, with Gym's noise."""
        # One draw, turned normal for the velocities: hashing is most of a reset, to compile and to run.
        nq, above_minus_one = self.model.nq, float(np.nextafter(np.float32(-1.0), np.float32(0.0)))
        uniform = jax.random.uniform(key, (nq + self.model.nv,), minval=above_minus_one)
        normal = math.sqrt(2.0) * jax.scipy.special.erfinv(uniform[nq:])
        scale = self.robot.reset_noise
        physics = self.physics.init(self._init_qpos + scale * uniform[:nq], scale * normal)
        zero, no = jnp.zeros(()), jnp.zeros((), bool)
        return State(
            physics=physics,
            obs=self._observe(physics),
            reward=zero,
            terminated=no,
            truncated=no,
            metrics=dict.fromkeys(_METRICS, zero),
        )

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Simulate one tick and pay for it."""
        before, after = state.physics, self.physics.step(state.physics, action)
        finite = jnp.all(jnp.isfinite(jnp.concatenate([after.qpos, after.qvel])))
        after = jax.tree.map(lambda new, old: jnp.where(finite, new, old), after, before)
        velocity = (after.qpos[0] - before.qpos[0]) / self.dt
        healthy_reward = jnp.float32(self.robot.healthy_reward)
        control_cost = self.robot.control_cost * jnp.sum(action**2)
        low, high = self.robot.healthy_height
        height = after.qpos[self.robot.height_index]
        metrics = {
            "forward_reward": velocity,
            "healthy_reward": healthy_reward,
            "control_cost": control_cost,
            "x_velocity": velocity,
        }
        return state.replace(
            physics=after,
            obs=self._observe(after),
            reward=velocity + healthy_reward - control_cost,
            terminated=~finite | (height < low) | (height > high),
            truncated=jnp.zeros((), bool),
            metrics=metrics,
        )

    def render(self, physics: PhysicsState, *, height: int = 240, width: int = 320) -> np.ndarray:
        """Draw with MuJoCo's renderer, from the tracking camera."""
        from taic_jax.envs.rendering import render_mujoco

        return render_mujoco(self.model, physics.qpos, height=height, width=width)

    def _observe(self, physics: PhysicsState) -> Float[Array, " S"]:
        return jnp.concatenate([physics.qpos[self.robot.num_unobserved :], physics.qvel])


def load_brax_model(name: str) -> mujoco.MjModel:
    """Compile a robot from the MJCF in the brax package, found without importing brax (which is slow)."""
    brax = importlib.util.find_spec("brax")
    if brax is None or brax.origin is None:
        raise ModuleNotFoundError("the robots' MJCF comes with the package brax, which is not installed")
    spec = mujoco.MjSpec.from_file(str(Path(brax.origin).parent / "envs" / "assets" / f"{name}.xml"))
    # MuJoCo deprecates the attribute `settotalmass`, with a warning; this is the replacement it asks for.
    total_mass, spec.compiler.settotalmass = spec.compiler.settotalmass, -1
    model = spec.compile()
    if total_mass > 0:
        mujoco.mj_setTotalmass(model, total_mass)
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def initial_qpos(model: mujoco.MjModel) -> Float[np.ndarray, " nq"]:
    """Return the pose that the model's custom numeric `init_qpos` holds, else its default pose."""
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, "init_qpos")
    return model.qpos0 if index < 0 else model.numeric("init_qpos").data
