"""Four rooms on a grid, with a key to fetch; the actions are discrete."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import Float, Key

from taic_jax.envs.base import Env, Goals, State
from taic_jax.envs.plans import Plan

# The rooms of Sutton, Precup and Singh (1999), in their outer wall. A cell (x, y) is counted from the lower left.
_MAP = """
#############
#     #     #
#     #     #
#           #
#     #     #
#     #     #
## ####     #
#     ### ###
#     #     #
#     #     #
#           #
#     #     #
#############
""".splitlines()[:0:-1]
FREE = np.array([[place == " " for place in row] for row in _MAP]).T  # [13, 13] by x and y
CELLS = np.argwhere(FREE).astype(np.int32)  # [104, 2]
MIDDLE = 6  # of the grid, on both axes; the outer wall is as far away on each side
LOWER_LEFT = CELLS[(CELLS < MIDDLE).all(axis=1)]  # [25, 2], the room in which the task with a key starts
KEY, GOAL = np.array([2, 10], np.int32), np.array([9, 3], np.int32)  # in the upper left and the lower right room
MOVES = np.array([[0, 1], [0, -1], [-1, 0], [1, 0]], np.int32)  # up, down, left, right


class GridState(struct.PyTreeNode):
    """The walker's cell and its goal, and whether it has the key."""

    position: Array  # [2] int32
    goal: Array  # [2] int32
    has_key: Array  # [] bool


class FourRooms(Env):
    """Reach the goal with the key: reward 1 there, which ends the episode, and 0 at every other tick.

    An action moves one cell up, down, left or right, unless a wall is there; the key is fetched by stepping on it.
    Observation [7]: position, has_key, the key's place, goal; cells / 5 from the middle, so in [-1, 1]. The metric
    `distance` is the number of cells to the goal along both axes, walls ignored.

    Args:
      random_ends: draw start and goal uniformly from all pairs of different free cells each episode, and hold the key
        from the start; else the start alone is drawn, in the lower left room.
    """

    observation_size = 7
    action_size = 4
    discrete = True
    proprioceptive_size = 2
    proprioception = "grid"
    episode_length = 200
    dt = 0.2

    def __init__(self, random_ends: bool = False):
        self.name = "four_rooms_random" if random_ends else "four_rooms"
        self.random_ends = random_ends

    def reset(self, key: Key[Array, ""]) -> State:
        """Put the walker on its start."""
        key_start, key_goal = jax.random.split(key)
        cells = jnp.array(CELLS if self.random_ends else LOWER_LEFT)
        start, goal = jax.random.randint(key_start, (), 0, len(cells)), jnp.array(GOAL)
        if self.random_ends:
            goal = cells[(start + jax.random.randint(key_goal, (), 1, len(cells))) % len(cells)]
        physics = GridState(cells[start], goal, jnp.array(self.random_ends))
        return State.first(physics, self._observe(physics), self._metrics(physics))

    def step(self, state: State, action: Float[Array, " 4"]) -> State:
        """Move by one cell, and take the key if it lies there."""
        x, y = moved = state.physics.position + jnp.array(MOVES)[jnp.argmax(action)]
        position = jnp.where(jnp.array(FREE)[x, y], moved, state.physics.position)
        has_key = state.physics.has_key | jnp.all(position == KEY)
        physics = state.physics.replace(position=position, has_key=has_key)
        metrics = self._metrics(physics)
        flags = {"terminated": metrics["success"] > 0, "truncated": jnp.zeros((), bool)}
        obs, reward = self._observe(physics), metrics["success"]
        return state.replace(physics=physics, obs=obs, reward=reward, metrics=metrics, **flags)

    @property
    def goals(self) -> Goals | None:
        """Cells, if no key is needed."""
        if not self.random_ends:
            return None

        def reward(achieved: Array, goal: Array) -> tuple[Array, Array]:
            success = jnp.all(jnp.abs(goal - achieved) < 0.1)  # half a cell
            return success.astype(jnp.float32), success

        return Goals(2, lambda obs: obs[:2], lambda obs, goal: jnp.concatenate([obs[:5], goal]), reward)

    def render(self, physics: GridState, *, height: int = 240, width: int = 320) -> np.ndarray:
        """Draw rooms, the key until it is fetched, goal, start, and the episode's path; a jump is a reset."""
        plan = Plan(0.5, 2 * MIDDLE - 0.5, height, width)  # without the outer wall
        for x, y in np.argwhere(~FREE[1:-1, 1:-1]) + 1.0:
            plan.add_solid(x - 0.5, y - 0.5, x + 0.5, y + 0.5)
        target, key = plan.add_disc(0.45, "#3a9d5d"), plan.add_disc(0.3, "#d99a1c")
        key.set_center(tuple(KEY))
        position, goal, has_key = (np.asarray(leaf) for leaf in (physics.position, physics.goal, physics.has_key))

        def arrange(t: int) -> None:
            target.set_center(goal[t])
            key.set_visible(not has_key[t])

        record = np.concatenate([position, 2 * goal], axis=1)  # a new goal is a jump too
        jumps = np.abs(np.diff(record, axis=0, prepend=record[:1])).sum(axis=1) > 1
        return plan.film(position, jumps, arrange)

    def _observe(self, physics: GridState) -> Float[Array, " 7"]:
        cells = jnp.stack([physics.position, jnp.array(KEY), physics.goal])
        position, key, goal = (cells - MIDDLE).astype(jnp.float32) / (MIDDLE - 1)
        return jnp.concatenate([position, physics.has_key[None].astype(jnp.float32), key, goal])

    def _metrics(self, physics: GridState) -> dict[str, Array]:
        distance = jnp.sum(jnp.abs(physics.goal - physics.position)).astype(jnp.float32)
        has_key = physics.has_key.astype(jnp.float32)
        return {"success": has_key * (distance == 0).astype(jnp.float32), "distance": distance, "has_key": has_key}
