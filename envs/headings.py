"""Experience for options that steer: to go in a direction that is drawn anew now and then."""

import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Key

from taic_jax.envs.ant_tasks import clear_of_the_floor
from taic_jax.envs.arenas import enclose
from taic_jax.envs.base import PhysicsState, State
from taic_jax.envs.locomotion import Locomotion, Outcome
from taic_jax.envs.orientation import heading, turned, unit, upright, upside_down
from taic_jax.envs.robots import ROBOTS, Robot

HOLD = 60  # ticks of one direction, 3 s of an ant
FAR = 1000.0  # m; nobody gets there


class HeadingsState(PhysicsState):
    """The simulation, and the directions to go in one after another, each for as many ticks."""

    directions: Array  # [N] rad in the world, left is positive
    tick: Array  # [] int32; it starts at random, so that environments turn at different times


class Headings(Locomotion):
    """A robot that is given directions, each for `hold` ticks: `_draw` says which."""

    def __init__(self, name: str, robot: Robot, backend: str, num_threads: int, hold: int = HOLD):
        self.hold, self._num_directions = hold, math.ceil(robot.episode_length / hold) + 1
        super().__init__(name, robot, backend, num_threads)

    def reset(self, key: Key[Array, ""]) -> State:
        """Start with Gym's noise, and draw all directions of the episode."""
        key_body, key_directions, key_tick = jax.random.split(key, 3)
        state = super().reset(key_body)
        tick = jax.random.randint(key_tick, (), 0, self.hold)
        physics = state.physics.replace(directions=self._draw(key_directions), tick=tick)
        return state.replace(physics=physics, obs=self._observe(physics))

    def _draw(self, key: Key[Array, ""]) -> Float[Array, " N"]:
        raise NotImplementedError

    def _begin(self, physics: PhysicsState) -> HeadingsState:
        return HeadingsState(**vars(physics), directions=jnp.zeros(self._num_directions), tick=jnp.zeros((), jnp.int32))

    def _advance(self, before: HeadingsState, after: HeadingsState) -> HeadingsState:
        return after.replace(tick=before.tick + 1)

    def _direction(self, physics: HeadingsState) -> Float[Array, ""]:
        return physics.directions[physics.tick // self.hold]


class CheetahHeadings(Headings):
    """Run forward or backward: the reward of `half_cheetah`, with the speed in the direction.

    Observation: the 17 entries of `half_cheetah`; then 1 to go forward, or -1.
    """

    def __init__(self, backend: str = "auto", num_threads: int = 0):
        super().__init__("half_cheetah_headings", ROBOTS["brax"]["half_cheetah"], backend, num_threads)
        self.proprioception = "half_cheetah"

    def _draw(self, key: Key[Array, ""]) -> Float[Array, " N"]:
        return math.pi * jax.random.bernoulli(key, 0.5, (self._num_directions,)).astype(jnp.float32)

    def _observe(self, physics: HeadingsState) -> Float[Array, " S"]:
        return jnp.append(super()._observe(physics), jnp.cos(self._direction(physics)))

    def _progress(self, before: HeadingsState, after: HeadingsState) -> Outcome:
        along = jnp.cos(self._direction(before)) * (after.qpos[0] - before.qpos[0]) / self.dt
        return along, {"speed_along": along}


class FreeHeadings(Headings):
    """Go in a direction and do not fall: experience for options that steer.

    The root of the robot is free, and its whole body has contacts. The direction is drawn anew every `hold` ticks, from
    the sector about the x axis that the body's views turn into a circle. The reward of a tick is the speed in m/s along
    it, less half the speed across it and the control cost, plus the upward part of the body's own axis: 1 if it is
    level. Only a robot on its back ends the episode. In half of the episodes a light fence stands around the robot,
    which it pushes along: many that never met anything overturn while they push a block.

    Observation: that of `Locomotion`; then, seen from the robot's heading, the direction [2] and the root's horizontal
    velocity [2].
    """

    num_slides = 2  # of the fence

    def reset(self, key: Key[Array, ""]) -> State:
        """Start as every robot that is given directions; the fence is far away in half of the episodes."""
        key, key_fence = jax.random.split(key)
        state = super().reset(key)
        away = jnp.where(jax.random.bernoulli(key_fence), FAR, 0.0)
        return state.replace(physics=state.physics.replace(qpos=state.physics.qpos.at[self.body_nq :].set(away)))

    def _furnish(self, spec: mujoco.MjSpec) -> None:
        enclose(spec, self.robot.pushes)

    def _begin(self, physics: PhysicsState) -> HeadingsState:
        """Take the noise from the fence."""
        return super()._begin(physics.replace(qvel=physics.qvel.at[self.body_nv :].set(0.0)))

    def _draw(self, key: Key[Array, ""]) -> Float[Array, " N"]:
        spread = math.pi / self.robot.sides  # to either side
        return jax.random.uniform(key, (self._num_directions,), minval=-spread, maxval=spread)

    def _start(self) -> Float[np.ndarray, " nq"]:
        return clear_of_the_floor(super()._start(), self.physics.model)

    def _observe(self, physics: HeadingsState) -> Float[Array, " S"]:
        angle, yaw = self._direction(physics), heading(physics.qpos[3:7])
        seen = turned(jnp.stack([unit(angle), physics.qvel[:2]]), -yaw)
        return jnp.concatenate([physics.qpos[2 : self.body_nq], physics.qvel[: self.body_nv], *seen])

    def _is_healthy(self, physics: PhysicsState) -> Bool[Array, ""]:
        return ~upside_down(physics.qpos[3:7])

    def _judge(self, before: HeadingsState, after: HeadingsState, action: Float[Array, " A"]) -> Outcome:
        velocity = (after.qpos[:2] - before.qpos[:2]) / self.dt
        along, across = turned(velocity, -self._direction(before))
        control_cost = self.robot.control_cost * jnp.sum(action**2)
        reward = along - 0.5 * jnp.abs(across) + upright(after.qpos[3:7]) - control_cost
        metrics = {"speed_along": along, "speed_across": jnp.abs(across), "upright": upright(after.qpos[3:7])}
        return reward, metrics
