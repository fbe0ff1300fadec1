"""The arenas as MuJoCo built them: how large the free ground is, and what can be reached on it, by flood fill."""

import functools
from collections import deque

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from taic_jax.envs import make_env
from taic_jax.envs.orientation import upside_down

CELL = 1.0  # m; every edge is at a multiple of it


@functools.cache
def boxes(name: str, block: tuple[float, float] = (0.0, 0.0)) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the lowest and the highest corner of every box, the block moved along its slides, and of the room."""
    model = make_env(name, "mujoco").model
    data = mujoco.MjData(model)
    if model.nq > 15:
        data.qpos[15:] = block
    mujoco.mj_kinematics(model, data)
    walls = {side: data.geom(side).xpos for side in ("west", "south", "east", "north")}
    low, high = np.append(walls["west"][0], walls["south"][1]), np.append(walls["east"][0], walls["north"][1])
    result = {"room": (low, high)}
    for i in range(model.ngeom):
        if model.geom(i).type[0] == mujoco.mjtGeom.mjGEOM_BOX:
            half = model.geom(i).size
            result[model.geom(i).name] = data.geom(i).xpos - half, data.geom(i).xpos + half
    return result


def ground(name: str, block: tuple[float, float] = (0.0, 0.0)) -> dict[tuple[float, float], float]:
    """Return the height of the ground at the middle of every cell of the room."""
    solids = boxes(name, block)
    (x_low, y_low), (x_high, y_high) = solids["room"]
    heights = {}
    for x in np.arange(x_low + CELL / 2, x_high, CELL):
        for y in np.arange(y_low + CELL / 2, y_high, CELL):
            over = [high[2] for low, high in (solids[name] for name in solids if name != "room")
                    if low[0] < x < high[0] and low[1] < y < high[1]]  # fmt: skip
            heights[float(x), float(y)] = float(max(over, default=0.0))
    return heights


def distances(name: str, block: tuple[float, float] = (0.0, 0.0)) -> dict[tuple[float, float], float]:
    """Return the way in m to every cell that is reached from the start without climbing or falling 0.2 m."""
    heights = ground(name, block)
    start = (0.5, 0.5)
    ways, queue = {start: 0.0}, deque([start])
    while queue:
        x, y = queue.popleft()
        for cell in ((x + CELL, y), (x - CELL, y), (x, y + CELL), (x, y - CELL)):
            if cell not in ways and cell in heights and abs(heights[cell] - heights[x, y]) < 0.2:
                ways[cell] = ways[x, y] + CELL
                queue.append(cell)
    return ways


# HIRO's: rooms of 24 x 24 and 16 x 32 m, corridors 8 m wide.
@pytest.mark.parametrize(
    ("name", "low", "high", "level", "area"),
    [
        ("ant_maze", (-4, -4), (20, 20), 0.0, 24 * 24 - 16 * 8),
        ("ant_push", (-12, -4), (12, 20), 0.0, 24 * 24 - 3 * 64 - 64),
        ("ant_fall", (-4, -4), (12, 28), 4.0, 2 * 16 * 16 // 2 + 16 * 8 - 64),
    ],
)
def test_rooms_and_free_ground_have_hiros_sizes(name, low, high, level, area):
    np.testing.assert_allclose(boxes(name)["room"], (low, high))
    free = [cell for cell, height in ground(name).items() if height == level]
    assert len(free) * CELL**2 == area
    assert ground(name)[0.5, 0.5] == level


def test_the_mazes_goals_are_16_m_off_and_the_way_to_the_fixed_one_goes_round():
    ways = distances("ant_maze")
    assert ways[16.5, 0.5] == 16 and ways[0.5, 16.5] == 12 + 16 + 12
    assert make_env("ant_maze", "mujoco").arena.near_goal == (16.0, 0.0)


def test_the_goal_behind_the_block_is_reached_once_it_is_pushed_aside():
    """From the room's west side, which is reached; pushed ahead the block fills the goal's chamber."""
    goal, west = (0.5, 18.5), (-7.5, 8.5)
    assert goal not in distances("ant_push") and west in distances("ant_push")
    assert distances("ant_push", (8.0, 0.0))[goal] == 18
    assert goal not in distances("ant_push", (0.0, 8.0))


def test_the_goal_behind_the_chasm_is_reached_over_the_block_alone():
    goal, before, behind = (0.5, 26.5), (-1.5, 2.5), (8.5, 20.5)
    ways = distances("ant_fall")
    assert before in ways and goal not in ways and behind not in ways
    over = distances("ant_fall", (8.0, -4.0))
    assert over[goal] == 26 + 2 * 4  # over the block, whose nearest row is 4 m to the side
    assert goal not in distances("ant_fall", (8.0, 0.0))  # in the air over the chasm


@pytest.mark.parametrize("axis", [(1.0, 0.0), (0.0, 1.0), (0.6, -0.8)], ids=str)
@pytest.mark.parametrize("yaw", [0.0, 2.0])
def test_upside_down_is_a_tilt_beyond_a_right_angle_about_any_axis(axis, yaw):
    degrees, turned = np.array([0, 60, 89, 91, 120, 179, 269, 271]), np.zeros((8, 4))
    turn = np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])
    for row, half in zip(turned, np.deg2rad(degrees) / 2, strict=True):
        mujoco.mju_mulQuat(row, np.array([np.cos(half), axis[0] * np.sin(half), axis[1] * np.sin(half), 0.0]), turn)
    result = jax.vmap(upside_down)(jnp.array(turned, jnp.float32))
    np.testing.assert_array_equal(result, [0, 0, 0, 1, 1, 1, 1, 0])
