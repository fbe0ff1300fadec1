"""Tasks of robots with a free root: to turn, and to reach a goal in a maze, behind a block or over a chasm."""

import copy
import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Key

from taic_jax.envs.arenas import Arena, furnish, is_open
from taic_jax.envs.base import Goals, PhysicsState, State
from taic_jax.envs.errors import UnknownNameError
from taic_jax.envs.locomotion import Locomotion, Outcome
from taic_jax.envs.orientation import heading, upside_down, wrapped
from taic_jax.envs.rendering import render_mujoco
from taic_jax.envs.robots import Robot

SUCCESS_RADIUS = 5.0  # m, of HIRO
PATIENCE = 40  # ticks on the back after which an arena cuts an episode of training
CANDIDATES = 32  # for a place that is drawn, of which the first is taken where a robot can be
BODY_WIDTH = 1.2  # m from walls at a start that is drawn


class TurningState(PhysicsState):
    """The simulation, and the ant's turns."""

    turns: Array  # [] since the start of the episode, left is positive


class AntTurn(Locomotion):
    """Turn left: the reward of `ant` with the yaw rate in rad/s in place of the forward speed."""

    def _begin(self, physics: PhysicsState) -> TurningState:
        return TurningState(**vars(physics), turns=jnp.zeros(()))

    def _advance(self, before: TurningState, after: TurningState) -> TurningState:
        angle = wrapped(heading(after.qpos[3:7]) - heading(before.qpos[3:7]))
        return after.replace(turns=before.turns + angle / (2 * jnp.pi))

    def _progress(self, before: TurningState, after: TurningState) -> Outcome:
        rate = 2 * jnp.pi * (after.turns - before.turns) / self.dt
        return rate, {"yaw_rate": rate, "turns": after.turns}


class ArenaState(PhysicsState):
    """The simulation, the goal, and the episode's record."""

    goal: Array  # [2] or [3] m
    closest: Array  # [] m, smallest distance to the goal so far
    on_back: Array  # [] int32, ticks on the back without a break


class ArenaTask(Locomotion):
    """Reach the goal of an arena: reward = -distance in m at each tick; only the time limit ends the episode.

    A fall does not: as every reward is negative, it would pay to fall. A simulation that diverges is truncated, not
    terminated, in its last finite state; in training so is a robot that lies on its back.

    Observation: that of `Locomotion`, heights from the ground of the start, so that options learnt there apply; then
    the position [2], the way to the goal [2 or 3], and the way to a block [3].

    Args:
      robot: with a free root, and contacts of its body; options learnt with the same robot apply.
      goal: `fixed`; `near`, if the arena has one; or, as in HIRO's maze, `uniform` in training, over all places where
        a robot can be, and fixed in evaluation; `mixed` draws it in half of the episodes, and the start in half.

    Raises:
      UnknownNameError: there is no such goal.
    """

    staggered = True

    def __init__(
        self, name: str, arena: Arena, robot: Robot, goal: str = "fixed", backend: str = "auto", num_threads: int = 0
    ):
        goals = ("fixed", *(("near",) if arena.near_goal else ()), "uniform", "mixed")
        if goal not in goals:
            raise UnknownNameError("goal", goal, goals)
        if goal == "near":
            arena = dataclasses.replace(arena, goal=arena.near_goal)
        self.arena, self.goal = arena, goal
        self.patience: int | None = PATIENCE
        self.num_slides = len(arena.block.slides) if arena.block else 0
        super().__init__(name, robot, backend, num_threads)

    @property
    def evaluated(self) -> "ArenaTask":
        """This arena with its fixed goal, and whole episodes."""
        arena = copy.copy(self)
        arena.goal, arena.patience = "fixed", None
        return arena

    @property
    def goals(self) -> Goals:
        """Positions of the torso, with its height where the goal has one."""
        first, size = self.proprioceptive_size, len(self.arena.goal)

        def achieved(obs: Array) -> Array:
            return jnp.append(obs[first : first + 2], obs[0] + self.arena.ground)[:size]

        def aim(obs: Array, goal: Array) -> Array:
            return obs.at[first + 2 : first + 2 + size].set(goal - achieved(obs))

        def reward(achieved: Array, goal: Array) -> tuple[Array, Array]:
            return -jnp.linalg.norm(goal - achieved), jnp.zeros((), bool)

        return Goals(size, achieved, aim, reward)

    def reset(self, key: Key[Array, ""]) -> State:
        """Start near the origin with Gym's noise, the block at its place; or in training where it is drawn."""
        key_body, key_goal = jax.random.split(key)
        state = super().reset(key_body)
        if self.goal not in ("uniform", "mixed"):
            return state
        key_goal, key_start, key_drawn = jax.random.split(key_goal, 3)
        place, start = self._draw(key_goal), self._draw(key_start, BODY_WIDTH) + state.physics.qpos[:2]
        if self.goal == "mixed":
            drawn = jax.random.bernoulli(key_drawn, 0.5, (2,))
            place = jnp.where(drawn[0], place, state.physics.goal[:2])
            qpos = state.physics.qpos.at[:2].set(jnp.where(drawn[1], start, state.physics.qpos[:2]))
            state = state.replace(physics=state.physics.replace(qpos=qpos))
        physics = state.physics.replace(goal=state.physics.goal.at[:2].set(place))
        physics = physics.replace(closest=self._distance(physics))
        return state.replace(physics=physics, obs=self._observe(physics))

    def _draw(self, key: Key[Array, ""], width: float = 0.0) -> Float[Array, " 2"]:
        """Draw a place where a robot can be, or start."""
        low, high = jnp.array(self.arena.room).reshape(2, 2)
        places = jax.random.uniform(key, (CANDIDATES, 2), minval=low, maxval=high)
        return places[jnp.argmax(jax.vmap(lambda place: is_open(self.arena, place, width))(places))]

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Simulate one tick and measure the distance."""
        state = super().step(state, action)
        cut = state.terminated
        if self.patience:
            cut |= state.physics.on_back >= self.patience
        return state.replace(terminated=jnp.zeros((), bool), truncated=cut)

    def render(self, physics: ArenaState, *, height: int = 240, width: int = 320) -> np.ndarray:
        """Draw the arena with MuJoCo's renderer, from above."""
        goal = np.asarray(physics.goal)
        if goal.shape[1] == 2:
            goal = np.concatenate([goal, np.full((len(goal), 1), 0.5, goal.dtype)], axis=1)
        return render_mujoco(self.model, physics.qpos, height=height, width=width, camera="arena", site=goal)

    def _furnish(self, spec: mujoco.MjSpec) -> None:
        furnish(spec, self.arena, self.robot.pushes)

    def _start(self) -> Float[np.ndarray, " nq"]:
        return clear_of_the_floor(super()._start(), self.physics.model)

    def _begin(self, physics: PhysicsState) -> ArenaState:
        """Take the noise from the block, and start the record of distances."""
        qpos = jnp.concatenate([physics.qpos[: self.body_nq], self._init_qpos[self.body_nq :]])
        physics = physics.replace(qpos=qpos, qvel=physics.qvel.at[self.body_nv :].set(0.0))
        goal, closest, on_back = jnp.array(self.arena.goal), jnp.zeros(()), jnp.zeros((), jnp.int32)
        start = ArenaState(**vars(physics), goal=goal, closest=closest, on_back=on_back)
        return start.replace(closest=self._distance(start))

    def _advance(self, before: ArenaState, after: ArenaState) -> ArenaState:
        on_back = jnp.where(upside_down(after.qpos[3:7]), before.on_back + 1, 0)
        return after.replace(closest=jnp.minimum(before.closest, self._distance(after)), on_back=on_back)

    def _distance(self, physics: ArenaState) -> Float[Array, ""]:
        return jnp.linalg.norm(physics.goal - physics.qpos[: physics.goal.shape[0]])

    def _observe(self, physics: ArenaState) -> Float[Array, " S"]:
        torso = physics.qpos[:3]
        body = physics.qpos[2 : self.body_nq].at[0].add(-self.arena.ground)
        entries = [body, physics.qvel[: self.body_nv], torso[:2], physics.goal - torso[: physics.goal.shape[0]]]
        if self.arena.block:
            entries.append(self.block_position(physics.qpos) - torso)
        return jnp.concatenate(entries)

    def block_position(self, qpos: Float[Array, " nq"]) -> Float[Array, " 3"]:
        """Return the block's centre in m."""
        block = self.arena.block
        axes = jnp.array([slide.axis for slide in block.slides], jnp.float32)
        return jnp.array(block.centre, jnp.float32) + qpos[self.body_nq :] @ axes

    def _is_healthy(self, physics: PhysicsState) -> Bool[Array, ""]:
        return jnp.ones((), bool)

    def _judge(self, before: ArenaState, after: ArenaState, action: Float[Array, " A"]) -> Outcome:
        distance = self._distance(after)
        flags = {"success": distance < SUCCESS_RADIUS, "upside_down": upside_down(after.qpos[3:7])}
        metrics = {name: flag.astype(jnp.float32) for name, flag in flags.items()}
        return -distance, metrics | {"distance": distance, "closest_approach": after.closest}


def clear_of_the_floor(qpos: Float[np.ndarray, " n"], model: mujoco.MjModel) -> Float[np.ndarray, " nq"]:
    """Return a robot's pose at the height of the model's default pose, and whatever else moves in that pose.

    At Brax's height of 0.55 m Gym's noise puts legs into the floor, which throws ants up, and every seventh over.
    """
    return np.concatenate([qpos[:2], model.qpos0[2:3], qpos[3:], model.qpos0[len(qpos) :]])
