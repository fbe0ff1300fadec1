"""The four rooms: walls, key, rewards, starts, goals and pictures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from taic_jax.envs import AutoReset, FourRooms, TimeLimit, check_contract, make_env
from taic_jax.envs.grid import CELLS, FREE, GOAL, KEY, LOWER_LEFT

UP, DOWN, LEFT, RIGHT = range(4)
ENV = FourRooms()
STEP, RESET = jax.jit(ENV.step), jax.jit(ENV.reset)


def state_at(position):
    """Return a state of the walker there, without the key."""
    state = RESET(jax.random.key(0))
    return state.replace(physics=state.physics.replace(position=jnp.array(position)))


def walk(position, *moves):
    """Return the states after each of so many moves in a direction."""
    state, states = state_at(position), []
    for direction, count in moves:
        for _ in range(count):
            state = STEP(state, jax.nn.one_hot(direction, 4))
            states.append(state)
    return states


def test_four_rooms_hang_together_by_four_hallways():
    """Rooms of 25, 30, 25 and 20 cells, and as many hallways."""
    hallways, rooms, todo = {(6, 9), (2, 6), (9, 5), (6, 2)}, [], {(int(x), int(y)) for x, y in CELLS}
    assert len(todo) == 104 and hallways < todo and not FREE[[0, -1]].any() and not FREE[:, [0, -1]].any()
    todo -= hallways
    while todo:
        room = frontier = {min(todo)}
        while frontier:
            near = {(x + dx, y + dy) for x, y in frontier for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1))}
            frontier = near & todo - room
            room = room | frontier
        rooms.append(room)
        todo -= room
    assert [len(room) for room in rooms] == [25, 25, 20, 30]  # from the left, and from below
    assert tuple(KEY) in rooms[1] and tuple(GOAL) in rooms[2]
    assert {(int(x), int(y)) for x, y in LOWER_LEFT} == rooms[0]


@pytest.mark.parametrize(
    ("position", "direction", "expected"),
    [
        ((3, 3), UP, (3, 4)),
        ((3, 3), DOWN, (3, 2)),
        ((3, 3), LEFT, (2, 3)),
        ((3, 3), RIGHT, (4, 3)),
        ((1, 1), LEFT, (1, 1)),  # the outer wall
        ((1, 1), DOWN, (1, 1)),
        ((11, 11), RIGHT, (11, 11)),
        ((11, 11), UP, (11, 11)),
        ((5, 3), RIGHT, (5, 3)),  # the wall between rooms
        ((5, 2), RIGHT, (6, 2)),  # a hallway
        ((6, 2), UP, (6, 2)),
        ((2, 5), UP, (2, 6)),
        ((9, 6), DOWN, (9, 5)),
        ((7, 9), LEFT, (6, 9)),
    ],
)
def test_a_move_is_one_cell_unless_a_wall_is_there(position, direction, expected):
    after = walk(position, (direction, 1))[0]
    np.testing.assert_array_equal(after.physics.position, expected)
    np.testing.assert_allclose(after.obs[:2], (np.array(expected) - 6) / 5, atol=1e-6)


def test_of_any_vector_the_largest_entry_counts():
    after = STEP(state_at((3, 3)), jnp.array([-0.9, -0.2, -0.3, -0.5]))
    np.testing.assert_array_equal(after.physics.position, [3, 2])


def test_the_way_by_the_key_to_the_goal():
    """From (1, 1) ten moves to the key at (2, 10), and sixteen back through two hallways to the goal at (9, 3)."""
    states = walk((1, 1), (RIGHT, 1), (UP, 9), (DOWN, 8), (RIGHT, 7), (UP, 1))
    has_key = [float(state.metrics["has_key"]) for state in states]
    assert has_key == [0.0] * 9 + [1.0] * 17
    assert [float(state.reward) for state in states] == [0.0] * 25 + [1.0]
    assert [bool(state.terminated) for state in states] == [False] * 25 + [True]
    assert [float(states[i].metrics["distance"]) for i in (0, 9, 17, 24, 25)] == [9.0, 14.0, 8.0, 1.0, 0.0]
    np.testing.assert_allclose(states[8].obs, [-0.8, 0.6, 0, -0.8, 0.8, 0.6, -0.6], atol=1e-6)
    np.testing.assert_allclose(states[9].obs, [-0.8, 0.8, 1, -0.8, 0.8, 0.6, -0.6], atol=1e-6)
    assert not any(state.truncated for state in states)


def test_without_the_key_the_goal_does_not_count():
    states = walk((1, 1), (UP, 1), (RIGHT, 8), (UP, 1), (LEFT, 1))
    np.testing.assert_array_equal(states[-2].physics.position, GOAL)
    assert states[-2].metrics["distance"] == 0.0
    assert not any(state.terminated or state.reward or state.metrics["success"] for state in states)


def test_an_episode_without_the_goal_earns_nothing_and_lasts_200_ticks():
    env = make_env("four_rooms")
    actions = jnp.zeros((200, 4)).at[:, LEFT].set(1.0)
    states = jax.jit(lambda: jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, env.reset(jax.random.key(1)), actions))()
    assert not states[1].reward.any() and not states[1].terminated.any()
    assert np.flatnonzero(states[1].truncated).tolist() == [199]


def test_starts_and_goals_are_drawn_uniformly():
    keys = jax.random.split(jax.random.key(0), 20_000)
    start = jax.jit(jax.vmap(ENV.reset))(keys)
    cells, counts = np.unique(np.asarray(start.physics.position), axis=0, return_counts=True)
    np.testing.assert_array_equal(cells, LOWER_LEFT)
    assert counts.min() > 650 and counts.max() < 950  # 800 each, and a standard deviation of 28
    assert not start.metrics["has_key"].any() and (np.asarray(start.physics.goal) == GOAL).all()
    env = make_env("four_rooms_random")
    assert env.observation_size == make_env("four_rooms").observation_size == 7
    start = jax.jit(jax.vmap(env.reset))(keys)
    assert start.metrics["has_key"].all() and (start.metrics["distance"] > 0).all() and not start.terminated.any()
    for drawn in (start.physics.position, start.physics.goal):
        cells, counts = np.unique(np.asarray(drawn), axis=0, return_counts=True)
        np.testing.assert_array_equal(cells, CELLS)
        assert counts.min() > 120 and counts.max() < 265  # 192 each, and a standard deviation of 14
    correlation = np.corrcoef(start.physics.position.T, start.physics.goal.T)[:2, 2:]
    assert np.abs(correlation).max() < 0.05, "start and goal are independent, but for being different"


def test_the_reward_of_the_goals_is_the_environments_own():
    env = FourRooms(random_ends=True)
    goals = env.goals
    assert goals and goals.size == 2 and ENV.goals is None

    def tick(state, key):
        state = env.step(state, jax.random.uniform(key, (4,)))
        return state, state

    keys = jax.random.split(jax.random.key(1), (2, 64))
    start = jax.vmap(env.reset)(keys[0])
    run = jax.jit(jax.vmap(lambda state, key: jax.lax.scan(tick, state, jax.random.split(key, 200))[1]))
    states = run(start, keys[1])
    obs = states.obs.reshape(-1, 7)
    reward, terminated = jax.vmap(goals.reward)(jax.vmap(goals.achieved)(obs), obs[:, 5:])
    np.testing.assert_array_equal(reward, states.reward.reshape(-1))
    np.testing.assert_array_equal(terminated, states.terminated.reshape(-1))
    assert 0 < terminated.sum() < len(obs) // 2
    # A walk with another goal: the one achieved counts, its neighbour does not.
    aimed = goals.aim(obs[0], goals.achieved(obs[1]))
    np.testing.assert_array_equal(aimed, [*obs[0, :5], *obs[1, :2]])
    for difference, counts in ((0.0, 1.0), (0.2, 0.0), (-0.2, 0.0)):
        for axis in range(2):
            goal = goals.achieved(obs[0]).at[axis].add(difference)
            assert goals.reward(goals.achieved(obs[0]), goal)[0] == counts


@pytest.mark.parametrize("name", ["four_rooms", "four_rooms_random"])
def test_the_contract_holds_and_wrappers_say_that_actions_are_discrete(name):
    env = make_env(name)
    assert env.name == name
    for each in (env, AutoReset(env), AutoReset(env).evaluated, TimeLimit(AutoReset(env), 3)):
        assert each.discrete is True and each.action_size == 4
        check_contract(each)
    assert make_env("nav2d").discrete is AutoReset(make_env("nav2d")).discrete is False


def where(frame, color):
    """Return the mean place (x from the left, y from below, in cells) of a colour in a square frame, None if absent."""
    near = np.abs(frame.astype(int) - color).max(axis=2) < 12
    if near.sum() < 20:
        return None
    rows, columns = np.nonzero(near)
    size = len(frame)
    return [(columns.mean() / size - 0.02) / 0.96 * 11 + 0.5, (0.98 - rows.mean() / size) / 0.96 * 11 + 0.5]


def test_the_picture_shows_goal_walker_and_the_key_until_it_is_fetched():
    states = walk((1, 9), (RIGHT, 1), (UP, 1), (RIGHT, 2))
    physics = jax.tree.map(lambda *leaves: np.stack(leaves), *[state.physics for state in states])
    before, *_, after = ENV.render(physics, height=220, width=220)
    # Discs of 60 % colour on the floor, #f4f1ea.
    gold, green = (0.6 * np.array(color) + 0.4 * np.array([244, 241, 234]) for color in ((217, 154, 28), (58, 157, 93)))
    red = np.array([209, 73, 91])
    for frame in (before, after):
        np.testing.assert_allclose(where(frame, green), GOAL, atol=0.1)
    np.testing.assert_allclose(where(before, gold), KEY, atol=0.1)
    assert where(after, gold) is None
    np.testing.assert_allclose(where(before, red), [2, 9], atol=0.6)


def test_the_path_begins_anew_where_an_episode_does():
    """A jump, and a new goal without one: less is drawn than of the longer path."""
    start = RESET(jax.random.key(0)).physics
    cells, other = np.array([[2, 1], [3, 1], [4, 1], [4, 2], [4, 3]]), np.array([[9, 3]] * 3 + [[9, 9]] * 2)

    def ink(position, goal):
        physics = start.replace(position=position, goal=goal, has_key=np.ones(len(position), bool))
        frame = ENV.render(physics, height=220, width=220)[-1].astype(int)
        return int((frame[..., 0] - frame[..., 1] > 60).sum())  # reddish

    whole, new_goal = ink(cells, np.array([[9, 9]] * 5)), ink(cells, other)
    jump = ink(np.concatenate([cells[:3], [[4, 4], [4, 5]]]), np.array([[9, 9]] * 5))
    assert new_goal < whole - 30 and jump < whole - 30
