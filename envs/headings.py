"""Experience for options that steer: to go in a direction that is drawn anew now and then."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Key

from taic_jax.envs.ant_tasks import clear_of_the_floor, heading, turned, unit, upright, upside_down
from taic_jax.envs.arenas import ANT_QPOS, ANT_QVEL, enclose
from taic_jax.envs.base import PhysicsState, State
from taic_jax.envs.locomotion import Locomotion, Outcome
from taic_jax.envs.robots import ROBOTS, Robot, compile_spec, load_spec, with_body, with_contacts

HOLD = 60  # ticks of one direction
SPREAD = math.pi / 4  # rad, greatest angle of an ant's direction to the x axis: the body's views cover the rest
FAR = 1000.0  # m; ants do not get there


class HeadingsState(PhysicsState):
    """The simulation, and the directions to go in one after another, each for `HOLD` ticks."""

    directions: Array  # [N] rad in the world, left is positive
    tick: Array  # [] int32; it starts at random, so that environments turn at different times


class Headings(Locomotion):
    """A robot that is given directions: `_draw` says which."""

    def __init__(self, name: str, robot: Robot, backend: str, num_threads: int):
        self._num_directions = math.ceil(robot.episode_length / HOLD) + 1
        super().__init__(name, robot, backend, num_threads)

    def reset(self, key: Key[Array, ""]) -> State:
        """Start with Gym's noise, and draw all directions of the episode."""
        key_body, key_directions, key_tick = jax.random.split(key, 3)
        state = super().reset(key_body)
        tick = jax.random.randint(key_tick, (), 0, HOLD)
        physics = state.physics.replace(directions=self._draw(key_directions), tick=tick)
        return state.replace(physics=physics, obs=self._observe(physics))

    def _draw(self, key: Key[Array, ""]) -> Float[Array, " N"]:
        raise NotImplementedError

    def _begin(self, physics: PhysicsState) -> HeadingsState:
        return HeadingsState(**vars(physics), directions=jnp.zeros(self._num_directions), tick=jnp.zeros((), jnp.int32))

    def _advance(self, before: HeadingsState, after: HeadingsState) -> HeadingsState:
        return after.replace(tick=before.tick + 1)

    def _direction(self, physics: HeadingsState) -> Float[Array, ""]:
        return physics.directions[physics.tick // HOLD]


class CheetahHeadings(Headings):
    """Run forward or backward: the reward of `half_cheetah`, with the speed in the direction.

    Observation: the 17 entries of `half_cheetah`; then 1 to go forward, or -1.
    """

    def __init__(self, backend: str = "auto", num_threads: int = 0):
        super().__init__("half_cheetah_headings", ROBOTS["brax"]["half_cheetah"], backend, num_threads)
        self.proprioceptive_size = self.observation_size - 1
        self.proprioception = "half_cheetah"

    def _draw(self, key: Key[Array, ""]) -> Float[Array, " N"]:
        return math.pi * jax.random.bernoulli(key, 0.5, (self._num_directions,)).astype(jnp.float32)

    def _observe(self, physics: HeadingsState) -> Float[Array, " S"]:
        return jnp.append(super()._observe(physics), jnp.cos(self._direction(physics)))

    def _progress(self, before: HeadingsState, after: HeadingsState) -> Outcome:
        along = jnp.cos(self._direction(before)) * (after.qpos[0] - before.qpos[0]) / self.dt
        return along, {"speed_along": along}


class AntHeadings(Headings):
    """Go in a direction and do not fall: experience for options that steer.

    The direction is within 45 degrees of the x axis, and is drawn anew every three seconds. The reward of a tick is the
    speed in m/s along it, less half the speed across it and the control cost, plus the upward part of the torso's own
    axis: 1 if it is level. Only an ant on its back ends the episode. In half of the episodes a light fence stands
    around the ant, which it pushes along: who has met nothing falls over the first block.

    Observation: the 27 entries of `ant`; then, seen from the ant's heading, the direction [2] and the torso's
    horizontal velocity [2].
    """

    def __init__(self, body: str = "gym", backend: str = "auto", num_threads: int = 0):
        ant = dataclasses.replace(ROBOTS["brax"]["ant"], control_cost=0.1)  # at 0.5 it hardly dares to walk
        robot = with_contacts(with_body(ant, body), "body")
        super().__init__("ant_headings", robot, backend, num_threads)
        self.proprioceptive_size = ANT_QPOS - robot.num_unobserved + ANT_QVEL

    def reset(self, key: Key[Array, ""]) -> State:
        """Start as every robot that is given directions; the fence is far away in half of the episodes."""
        key, key_fence = jax.random.split(key)
        state = super().reset(key)
        away = jnp.where(jax.random.bernoulli(key_fence), FAR, 0.0)
        return state.replace(physics=state.physics.replace(qpos=state.physics.qpos.at[ANT_QPOS:].set(away)))

    def _make_model(self) -> mujoco.MjModel:
        spec = load_spec(self.robot)
        enclose(spec)
        return compile_spec(spec)

    def _begin(self, physics: PhysicsState) -> HeadingsState:
        """Take the noise from the fence."""
        return super()._begin(physics.replace(qvel=physics.qvel.at[ANT_QVEL:].set(0.0)))

    def _draw(self, key: Key[Array, ""]) -> Float[Array, " N"]:
        return jax.random.uniform(key, (self._num_directions,), minval=-SPREAD, maxval=SPREAD)

    def _start(self) -> Float[np.ndarray, " nq"]:
        return clear_of_the_floor(super()._start(), self.model)

    def _observe(self, physics: HeadingsState) -> Float[Array, " S"]:
        angle, yaw = self._direction(physics), heading(physics.qpos[3:7])
        seen = turned(jnp.stack([unit(angle), physics.qvel[:2]]), -yaw)
        return jnp.concatenate([physics.qpos[2:ANT_QPOS], physics.qvel[:ANT_QVEL], *seen])

    def _is_healthy(self, physics: PhysicsState) -> Bool[Array, ""]:
        return ~upside_down(physics.qpos[3:7])

    def _judge(self, before: HeadingsState, after: HeadingsState, action: Float[Array, " A"]) -> Outcome:
        velocity = (after.qpos[:2] - before.qpos[:2]) / self.dt
        along, across = turned(velocity, -self._direction(before))
        control_cost = self.robot.control_cost * jnp.sum(action**2)
        reward = along - 0.5 * jnp.abs(across) + upright(after.qpos[3:7]) - control_cost
        metrics = {"speed_along": along, "speed_across": jnp.abs(across), "upright": upright(after.qpos[3:7])}
        return reward, metrics
