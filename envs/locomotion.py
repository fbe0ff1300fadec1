"""Running tasks with the semantics of Gym's MuJoCo environments, and the ant that turns."""

import functools
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Key

from taic_jax.envs.base import Env, Heading, PhysicsState, State
from taic_jax.envs.orientation import upright
from taic_jax.envs.physics import make_physics
from taic_jax.envs.rendering import render_mujoco
from taic_jax.envs.robots import Robot, compile_spec, initial_qpos, load_spec, servo_angles
from taic_jax.envs.views import Views, make_views

Outcome = tuple[Float[Array, ""], dict[str, Array]]  # A reward, or a term of it, and metrics.


class Locomotion(Env):
    """Run along x: reward = dx/dt + healthy_reward - control_cost |a|^2 each tick.

    An action drives the motors, or moves the targets of position servos about the pose of the start (`Robot.reach`).

    Observation: qpos without the place on the ground, then qvel. Positions are those of qpos, which, unlike the world
    positions of bodies, are current after a step. A simulation that diverges ends the episode in its last finite state.
    """

    num_slides = 0  # joints of what the robot pushes: the last entries of qpos and of qvel

    def __init__(self, name: str, robot: Robot, backend: str = "auto", num_threads: int = 0):
        self.name, self.robot = name, robot
        model = self._make_model(drawn=not robot.keyframe)
        solver = {"iterations": robot.iterations, "ls_iterations": robot.ls_iterations}
        self.physics = make_physics(model, robot.substeps, backend, num_threads, **solver)
        self.body_nq, self.body_nv = model.nq - self.num_slides, model.nv - self.num_slides
        self.episode_length = robot.episode_length
        self.action_size = model.nu
        self.dt = model.opt.timestep * robot.substeps
        self._init_qpos = jnp.asarray(self._start(), jnp.float32)
        self._angles = servo_angles(model, self._start()).astype(np.float32) if robot.reach else None
        state = jax.eval_shape(self.reset, jax.random.key(0))
        self.observation_size = state.obs.shape[0]
        self.proprioceptive_size = self.body_nq - robot.num_unobserved + self.body_nv
        self.proprioception = robot.proprioception or name

    @functools.cached_property
    def model(self) -> mujoco.MjModel:
        """The model to draw: that of the physics, with the meshes that nothing touches."""
        return self._make_model(drawn=True)

    @property
    def views(self) -> Views:
        """Views of the robot from each of its equal sides."""
        robot = self.robot
        return make_views(robot.turned_obs, robot.turned_action, robot.sides) if robot.sides > 1 else super().views

    @property
    def heading(self) -> Heading | None:
        """That of a robot whose root is free."""
        if self.physics.model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
            return None
        hidden = self.robot.num_unobserved
        return Heading(3 - hidden, self.body_nq - hidden, self.dt)

    def reset(self, key: Key[Array, ""]) -> State:
        """Start near the initial pose, with Gym's noise."""
        # One draw, turned normal for the velocities: hashing is most of a reset, to compile and to run.
        nq, above_minus_one = self.physics.model.nq, float(np.nextafter(np.float32(-1.0), np.float32(0.0)))
        noise = jax.random.uniform(key, (nq + self.physics.model.nv,), minval=above_minus_one)
        if self.robot.velocity_noise == "normal":
            noise = jnp.concatenate([noise[:nq], math.sqrt(2.0) * jax.scipy.special.erfinv(noise[nq:])])
        noise = self.robot.reset_noise * noise
        physics = self._begin(self.physics.init(self._init_qpos + noise[:nq], noise[nq:]))
        _, metrics = self._judge(physics, physics, jnp.zeros(self.action_size))
        metrics = jax.tree.map(jnp.zeros_like, metrics | {"unstable": jnp.zeros(())})
        return State.first(physics, self._observe(physics), metrics)

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Simulate and reward one tick; an unstable one ends the episode at its start, and metric `unstable` is 1."""
        before, after = state.physics, self.physics.step(state.physics, self._control(action))
        finite = jnp.all(jnp.isfinite(jnp.concatenate([after.qpos, after.qvel])))
        after = self._advance(before, jax.tree.map(lambda new, old: jnp.where(finite, new, old), after, before))
        reward, metrics = self._judge(before, after, action)
        metrics |= {"unstable": (~finite).astype(jnp.float32)}
        flags = {"terminated": ~finite | ~self._is_healthy(after), "truncated": jnp.zeros((), bool)}
        return state.replace(physics=after, obs=self._observe(after), reward=reward, metrics=metrics, **flags)

    def render(self, physics: PhysicsState, *, height: int = 240, width: int = 320) -> np.ndarray:
        """Draw with MuJoCo's renderer, from the tracking camera."""
        return render_mujoco(self.model, physics.qpos, height=height, width=width)

    def _make_model(self, drawn: bool) -> mujoco.MjModel:
        spec = load_spec(self.robot)
        self._furnish(spec)
        spec.compiler.discardvisual = not drawn
        return compile_spec(spec)

    def _furnish(self, spec: mujoco.MjSpec) -> None:
        """Put the robot of a spec where its task is."""

    def _start(self) -> Float[np.ndarray, " nq"]:
        return initial_qpos(self.robot, self.physics.model)

    def _begin(self, physics: PhysicsState) -> PhysicsState:
        """Add a task's own memory to the simulation's state."""
        return physics

    def _control(self, action: Float[Array, " A"]) -> Float[Array, " nu"]:
        """Return the controls: actions of motors, or targets of servos, which the engine clips to their limits."""
        return action if self._angles is None else self._angles + self.robot.reach * action

    def _advance(self, before: PhysicsState, after: PhysicsState) -> PhysicsState:
        """Bring a task's own memory up to date."""
        return after

    def _observe(self, physics: PhysicsState) -> Float[Array, " S"]:
        robot, position = self.robot, physics.qpos
        if robot.root_height:
            position = position.at[robot.height_index].add(robot.root_height)
        limit = robot.velocity_limit
        velocity = physics.qvel if math.isinf(limit) else jnp.clip(physics.qvel, -limit, limit)
        return jnp.concatenate([position[robot.num_unobserved :], velocity])

    def _is_healthy(self, physics: PhysicsState) -> Bool[Array, ""]:
        robot = self.robot
        low, high = robot.healthy_height
        height = physics.qpos[robot.height_index] + robot.root_height
        healthy = (height >= low) & (height <= high)
        if not math.isinf(robot.healthy_angle) and self.heading:
            healthy &= upright(physics.qpos[3:7]) > math.cos(robot.healthy_angle)
        elif not math.isinf(robot.healthy_angle):
            healthy &= jnp.abs(physics.qpos[2]) < robot.healthy_angle
        if not math.isinf(robot.healthy_state):
            rest = jnp.concatenate([physics.qpos[2:], physics.qvel])
            healthy &= jnp.all(jnp.abs(rest) < robot.healthy_state)
        return healthy

    def _judge(self, before: PhysicsState, after: PhysicsState, action: Float[Array, " A"]) -> Outcome:
        """Return the tick's reward and metrics."""
        robot = self.robot
        healthy_reward = jnp.float32(robot.healthy_reward)
        if robot.healthy_reward and not robot.final_healthy_reward:
            healthy_reward = jnp.where(self._is_healthy(after), healthy_reward, 0.0)
        control_cost = robot.control_cost * jnp.sum(action**2)
        progress, metrics = self._progress(before, after)
        metrics |= {"healthy_reward": healthy_reward, "control_cost": control_cost}
        return progress + healthy_reward - control_cost, metrics

    def _progress(self, before: PhysicsState, after: PhysicsState) -> Outcome:
        velocity = (after.qpos[0] - before.qpos[0]) / self.dt
        return velocity, {"forward_reward": velocity, "x_velocity": velocity}
