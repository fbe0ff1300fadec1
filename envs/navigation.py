"""Navigation of a point in a room of 10 m by 10 m with rectangular obstacles."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import Bool, Float, Int, Key

from taic_jax.envs.base import Env, Goals, State
from taic_jax.envs.plans import Plan

ROOM = 10.0  # m, side of the room
MAX_SPEED = 1.0  # m/s on each axis
GOAL_RADIUS = 0.5  # m
REWARDS = np.float32(100), np.float32(-1)  # of a tick at the goal, and of any other
CELL = 0.1  # m, raster from which free points are drawn
START, GOAL = (1.0, 5.0), (9.0, 5.0)  # m, of the task with fixed ends

# Rectangles (x_low, y_low, x_high, y_high) in m: a wall with gaps at y in [4, 6] and [8.5, 10]; two blocks.
# Walls are thicker than the 0.2 m of a tick, so nothing tunnels.
BASE_MAP = np.array(
    [[4.8, 0.0, 5.2, 4.0], [4.8, 6.0, 5.2, 8.5], [2.0, 2.0, 3.0, 3.5], [7.0, 8.0, 8.0, 8.6]], np.float32
)
# The sudden change of section 4.1, figure 4: a pocket behind the wall's lower gap. The shortest way ends 1.8 m behind
# that gap; only the upper one still leads to the goal.
TRAP = np.array([[7.0, 3.0, 7.4, 7.0], [5.2, 2.8, 7.4, 3.2], [5.2, 6.8, 7.4, 7.2]], np.float32)


class NavigationState(struct.PyTreeNode):
    """The point's position and goal, and its number of episodes."""

    position: Array  # [2] m
    goal: Array  # [2] m
    episode: Array  # [] int32, episodes of this environment that ended before


class Navigation(Env):
    """Reach the goal: reward +100 there, which ends the episode, and -1 at every other tick.

    The action is the velocity. A move along one axis that would end inside an obstacle is cancelled, so the
    point slides along walls. Observation: position / 5 - 1, and a random goal likewise.

    Args:
      walls: rectangles in m; may be traced, so that a program can change the map without recompiling.
      random_ends: draw start and goal uniformly from free space each episode, and observe the goal.
      change_after: episodes of each environment after which `TRAP` stands in the room too; 0 for never.
    """

    action_size = 2
    proprioceptive_size = 2
    proprioception = "point"
    episode_length = 200
    dt = 0.2

    def __init__(
        self, walls: Float[Array | np.ndarray, "R 4"] = BASE_MAP, random_ends: bool = False, change_after: int = 0
    ):
        self.name = "nav2d_random" if random_ends else "nav2d"
        self.observation_size = 4 if random_ends else 2
        self.random_ends, self.change_after = random_ends, change_after
        self.walls = jnp.concatenate([jnp.asarray(walls), TRAP]) if change_after else jnp.asarray(walls)
        since = [0] * len(walls) + [change_after] * len(TRAP)  # the first episode of each wall
        self._since = np.array(since[: len(self.walls)], np.int32)
        if random_ends:
            self._cells, self._num_cells = free_cells(self.walls)

    def reset(self, key: Key[Array, ""]) -> State:
        """Put the point on its start."""
        return self._start(key, jnp.zeros((), jnp.int32))

    def restart(self, key: Key[Array, ""], ended: NavigationState) -> State:
        """Put the point on its start, in the room of the next episode."""
        return self._start(key, ended.episode + 1)

    def _start(self, key: Key[Array, ""], episode: Int[Array, ""]) -> State:
        position, goal = jnp.array(START), jnp.array(GOAL)
        if self.random_ends:
            position, goal = jax.vmap(self._free_point)(jax.random.uniform(key, (2, 3)))
        physics = NavigationState(position, goal, episode)
        return State.first(physics, self._observe(physics), self._metrics(physics))

    def step(self, state: State, action: Float[Array, " 2"]) -> State:
        """Move by one tick, first along x, then along y."""
        x, y = state.physics.position
        new_x, new_y = jnp.clip(state.physics.position + MAX_SPEED * self.dt * action, 0.0, ROOM)
        standing = self._standing(state.physics.episode[None])
        x = jnp.where(inside(jnp.stack([new_x, y]), self.walls, standing), x, new_x)
        y = jnp.where(inside(jnp.stack([x, new_y]), self.walls, standing), y, new_y)
        physics = state.physics.replace(position=jnp.stack([x, y]))
        metrics = self._metrics(physics)
        success = metrics["success"] > 0
        reward = jnp.where(success, *REWARDS)
        flags = {"terminated": success, "truncated": jnp.zeros((), bool)}
        return state.replace(physics=physics, obs=self._observe(physics), reward=reward, metrics=metrics, **flags)

    @property
    def goals(self) -> Goals | None:
        """Positions, if the goal is observed."""
        if not self.random_ends:
            return None

        def reward(achieved: Array, goal: Array) -> tuple[Array, Array]:
            success = jnp.linalg.norm(goal - achieved) <= GOAL_RADIUS / (ROOM / 2)
            return jnp.where(success, *REWARDS), success

        return Goals(2, lambda obs: obs[:2], lambda obs, goal: jnp.concatenate([obs[:2], goal]), reward)

    def render(self, physics: NavigationState, *, height: int = 240, width: int = 320) -> np.ndarray:
        """Draw room, obstacles, start, goal, and the episode's path; a move too long for a tick is a reset."""
        plan = Plan(0.0, ROOM, height, width)
        patches = [plan.add_solid(*wall) for wall in np.asarray(self.walls).tolist()]
        target = plan.add_disc(GOAL_RADIUS, "#3a9d5d")
        position, goal = np.asarray(physics.position), np.asarray(physics.goal)
        standing = self._standing(np.asarray(physics.episode)[:, None])

        def arrange(t: int) -> None:
            for patch, stands in zip(patches, standing[t], strict=True):
                patch.set_visible(stands)
            target.set_center(goal[t])

        moves = np.abs(np.diff(position, axis=0, prepend=position[:1])).max(axis=1)
        return plan.film(position, moves > 1.01 * MAX_SPEED * self.dt, arrange)

    def _observe(self, physics: NavigationState) -> Float[Array, " S"]:
        points = [physics.position, physics.goal] if self.random_ends else [physics.position]
        return jnp.concatenate(points) / (ROOM / 2) - 1.0

    def _metrics(self, physics: NavigationState) -> dict[str, Array]:
        distance = jnp.linalg.norm(physics.goal - physics.position)
        metrics = {"distance_to_goal": distance, "success": (distance <= GOAL_RADIUS).astype(jnp.float32)}
        if self.change_after:
            metrics["changed"] = (physics.episode >= self.change_after).astype(jnp.float32)
        return metrics

    def _standing(self, episode: Int[Array | np.ndarray, "*T 1"]) -> Bool[Array | np.ndarray, "*T R"]:
        """Return for each episode the walls that stand."""
        return self._since <= episode

    def _free_point(self, uniform: Float[Array, " 3"]) -> Float[Array, " 2"]:
        """Map [0, 1)^3 to free space, uniformly and without rejections: a cell, then a place in it."""
        cell = self._cells[(uniform[0] * self._num_cells).astype(jnp.int32)]
        return cell + CELL * uniform[1:]


def inside(
    point: Float[Array, " 2"], walls: Float[Array, "R 4"], standing: Bool[Array | np.ndarray, " R"]
) -> Bool[Array, ""]:
    """Return whether a point lies in any of the standing rectangles; their edges belong to them."""
    return jnp.any(standing & jnp.all((walls[:, :2] <= point[None]) & (point[None] <= walls[:, 2:]), axis=1))


@jax.jit
def free_cells(walls: Float[Array, "R 4"]) -> tuple[Float[Array, "M 2"], Array]:
    """Raster the room; return the cells' lower corners, those of free cells first, and the number of free ones."""
    axis = CELL * jnp.arange(round(ROOM / CELL), dtype=jnp.float32)
    corners = jnp.stack(jnp.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    low, high = walls[None, :, :2], walls[None, :, 2:]
    touches = jnp.any(jnp.all((corners[:, None] <= high) & (low <= corners[:, None] + CELL), axis=2), axis=1)
    return corners[jnp.argsort(touches, stable=True)], jnp.sum(~touches, dtype=jnp.float32)
