"""The navigation room: walls, rewards, starts, and maps as data."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from taic_jax.envs import AutoReset, Navigation, make_env
from taic_jax.envs.navigation import BASE_MAP, TRAP, inside

ENV = Navigation()
STEP = jax.jit(ENV.step)


def state_at(env: Navigation, position):
    """Return a state of the point there."""
    state = jax.jit(env.reset)(jax.random.key(0))
    return state.replace(physics=state.physics.replace(position=jnp.array(position)))


@pytest.mark.parametrize(
    ("position", "action", "expected"),
    [
        ((1.0, 5.0), (1.0, -0.5), (1.2, 4.9)),  # free: 0.2 s at 1 m/s and -0.5 m/s
        ((4.7, 2.0), (1.0, 1.0), (4.7, 2.2)),  # along the long wall: x cancelled, y kept
        ((4.7, 2.0), (-1.0, 1.0), (4.5, 2.2)),  # away from it
        ((5.0, 4.1), (0.0, -1.0), (5.0, 4.1)),  # down onto the lower wall, in the gap
        ((5.0, 5.9), (0.5, 1.0), (5.1, 5.9)),  # up under the upper wall: slides in x
        ((1.9, 1.9), (1.0, 1.0), (2.1, 1.9)),  # a block's corner: x first, then y is cancelled
        ((1.9, 2.1), (1.0, -1.0), (1.9, 1.9)),  # the same corner from the side: x cancelled, then y free
        ((9.95, 0.05), (1.0, -1.0), (10.0, 0.0)),  # into the room's corner: clipped
        ((4.8, 9.0), (1.0, 0.0), (5.0, 9.0)),  # through the upper gap
    ],
)
def test_moves_and_slides(position, action, expected):
    after = STEP(state_at(ENV, position), jnp.array(action))
    np.testing.assert_allclose(after.physics.position, expected, atol=1e-6)
    np.testing.assert_allclose(after.obs, np.array(expected) / 5 - 1, atol=1e-6)


def test_never_inside_a_wall():
    """500 points, 200 ticks of persistent pushing in random directions, on the random task."""
    env = make_env("nav2d_random")

    def tick(state, key):
        action = jnp.sign(jax.random.normal(key, (500, 2))) * jax.random.uniform(key, (500, 2), minval=0.2)
        state = jax.lax.fori_loop(0, 4, lambda _, state: jax.vmap(env.step)(state, action), state)
        return state, state.physics.position

    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 500))
    keys = jax.random.split(jax.random.key(1), 50)
    _, path = jax.jit(lambda state: jax.lax.scan(tick, state, keys))(state)
    x, y = np.moveaxis(np.asarray(path), -1, 0)
    for x_low, y_low, x_high, y_high in BASE_MAP:
        assert not ((x_low <= x) & (x <= x_high) & (y_low <= y) & (y <= y_high)).any()
    assert x.min() >= 0 and y.min() >= 0 and x.max() <= 10 and y.max() <= 10
    assert np.ptp(x) == 10.0, "they do reach the borders"


def test_straight_way_to_the_goal():
    """From x = 1 to within 0.5 m of x = 9 are 7.5 m: 38 ticks of 0.2 m, so 37 times -1, then +100."""
    env = make_env("nav2d")
    step, state, total = jax.jit(env.step), env.reset(jax.random.key(0)), 0.0
    for tick in range(1, 39):
        assert not state.terminated and state.metrics["success"] == 0.0
        state = step(state, jnp.array([1.0, 0.0]))
        total += float(state.reward)
        np.testing.assert_allclose(state.metrics["distance_to_goal"], 8 - 0.2 * tick, atol=1e-5)
    assert state.terminated and not state.truncated
    assert state.metrics["success"] == 1.0 and total == 63.0


def test_idling_costs_one_a_tick_until_the_time_limit():
    env = make_env("nav2d")
    step, state, total = jax.jit(env.step), env.reset(jax.random.key(0)), 0.0
    for _ in range(200):
        assert not state.truncated
        state = step(state, jnp.zeros(2))
        total += float(state.reward)
    assert total == -200.0 and state.truncated and not state.terminated


def test_fixed_task_starts_where_the_paper_evaluates():
    state = make_env("nav2d").reset(jax.random.key(3))
    np.testing.assert_allclose(state.obs, [-0.8, 0.0], atol=1e-6)
    assert state.metrics["distance_to_goal"] == 8.0


def test_random_task_draws_free_points_uniformly():
    env = make_env("nav2d_random")
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 20_000))
    for points, observed in (
        (state.physics.position, state.obs[:, :2]),
        (state.physics.goal, state.obs[:, 2:]),
    ):
        np.testing.assert_allclose(observed, points / 5 - 1, atol=1e-6)
        assert not jax.vmap(inside, (0, None, None))(points, env.walls, np.ones(4, bool)).any()
        # Free space: 100 - 1.6 - 1.0 - 1.5 - 0.6 = 95.3 m^2, of which left of the wall 48 - 1.5 = 46.5, and
        # in its two gaps 0.4 * (2 + 1.5) = 1.4.
        x = np.asarray(points[:, 0])
        np.testing.assert_allclose((x < 4.8).mean(), 46.5 / 95.3, atol=0.015)
        np.testing.assert_allclose(((x > 4.8) & (x < 5.2)).mean(), 1.4 / 95.3, atol=0.004)
    correlation = np.corrcoef(state.physics.position.T, state.physics.goal.T)
    assert np.abs(correlation - np.eye(4)).max() < 0.05, "start and goal are independent"


def test_map_is_data_within_one_program():
    """A traced map blocks the way, and frees it again, without a second compilation."""
    traces = []

    @jax.jit
    def way(walls):
        traces.append(walls)
        env = Navigation(walls)
        return env.step(state_at(ENV, (6.9, 5.0)), jnp.array([1.0, 0.0])).physics.position[0]

    blocked = jnp.concatenate([jnp.asarray(BASE_MAP[:3]), jnp.array([[7.0, 3.0, 7.4, 7.0]])])
    np.testing.assert_allclose([way(jnp.asarray(BASE_MAP)), way(blocked)], [7.1, 6.9], atol=1e-6)
    assert len(traces) == 1


def test_the_room_changes_after_so_many_episodes_of_each_environment():
    """Straight ahead: two episodes reach the goal, then the trap holds the point, in one program, for each alone."""
    env = AutoReset(make_env("nav2d", change_after=2))
    start = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 2))

    def tick(state, t):
        # The second environment waits ten ticks before its first move.
        state = jax.vmap(env.step)(state, jnp.array([[1.0, 0.0], [jnp.where(t < 10, 0.0, 1.0), 0.0]]))
        return state, (state.terminated, state.truncated, state.metrics["changed"], state.physics.position)

    ticks = jax.jit(lambda state: jax.lax.scan(tick, state, jnp.arange(2 * 38 + 10 + 200)))(start)[1]
    terminated, truncated, changed, position = jax.tree.map(np.asarray, ticks)
    for env_index, wait in ((0, 0), (1, 10)):
        assert np.flatnonzero(terminated[:, env_index]).tolist() == [37 + wait, 75 + wait]
        assert np.flatnonzero(truncated[:, env_index]).tolist() == [275 + wait]
        assert changed[: 76 + wait, env_index].sum() == 0 and changed[76 + wait : 276 + wait, env_index].all()
        # 1.8 m behind the gap's end at 5.2 m, less than one move of 0.2 m before the wall at 7 m.
        np.testing.assert_allclose(position[150, env_index], [6.9, 5.0], atol=0.1)


def test_only_the_upper_gap_leads_through_the_changed_room():
    """Flood the room's raster from the start: the goal is reached in both rooms, but not through the trap."""

    def ways(walls):
        axis = np.arange(0.05, 10, 0.1)
        x, y = np.meshgrid(axis, axis, indexing="ij")
        free = ~np.any([(a <= x) & (x <= c) & (b <= y) & (y <= d) for a, b, c, d in walls], axis=0)
        reached, frontier, steps = {(10, 50)}, [(10, 50)], 0
        while frontier and (90, 50) not in reached:
            near = {(i + di, j + dj) for i, j in frontier for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1))}
            near = {(i, j) for i, j in near - reached if 0 <= i < 100 and 0 <= j < 100 and free[i, j]}
            reached, frontier, steps = reached | near, list(near), steps + 1
        return steps if (90, 50) in reached else None

    no_upper_gap = np.array([[4.8, 8.5, 5.2, 10.0]], np.float32)
    assert ways(BASE_MAP) == 80
    assert ways(np.concatenate([BASE_MAP, TRAP])) > 120
    assert ways(np.concatenate([BASE_MAP, TRAP, no_upper_gap])) is None
