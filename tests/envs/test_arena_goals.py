"""Goals of the arenas: where they are drawn, who draws them, and when an episode of training is cut."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ants import placed, start, task

from taic_jax.config import PPOConfig, SACConfig
from taic_jax.envs import ArenaTask, AutoReset, UnknownNameError, make_env
from taic_jax.envs.arenas import PUSH, outside
from taic_jax.envs.robots import ROBOTS
from taic_jax.options.execution import IdentityExecutor
from taic_jax.rl import ppo, sac


def test_uniform_goals_fill_the_maze_and_are_observed():
    state = start("ant_maze", 2000, goal="uniform")
    goal = np.asarray(state.physics.goal)
    assert goal.min() >= -4 and goal.max() <= 20
    in_the_bar = (goal[:, 0] < 12) & (goal[:, 1] > 4) & (goal[:, 1] < 12)
    assert not in_the_bar.any()
    # Two corridors of 24 x 8 m, and what joins them, 8 x 8 m.
    np.testing.assert_allclose((goal[:, 0] > 12).mean(), 3 / 7, atol=0.04)
    np.testing.assert_allclose((goal[:, 1] < 4).mean(), 3 / 7, atol=0.04)
    np.testing.assert_allclose(state.obs[:, 29:31], goal - state.physics.qpos[:, :2], atol=1e-5)
    np.testing.assert_allclose(
        state.physics.closest, np.linalg.norm(goal - state.physics.qpos[:, :2], axis=1), rtol=1e-5
    )
    evaluated = jax.jit(jax.vmap(AutoReset(task("ant_maze", goal="uniform")[0]).evaluated.reset))
    np.testing.assert_array_equal(evaluated(jax.random.split(jax.random.key(1), 3)).physics.goal, [(0, 16)] * 3)


def test_near_goal_is_straight_ahead_and_the_fixed_one_behind_a_wall():
    """Walls between start and goal, and what is paid for standing at the goal and at the start."""
    for goal, expected, hidden in (("near", (16.0, 0.0), False), ("fixed", (0.0, 16.0), True)):
        env, _, step = task("ant_maze", goal=goal)
        assert env.arena.goal == expected
        way = np.zeros((100, env.model.nq)) + np.linspace(0, 1, 100)[:, None] * np.resize((*expected, 0), env.model.nq)
        assert (outside(env.arena, way) > 0) == hidden
        state = step(placed(start("ant_maze", 2, goal=goal), [[*expected, 0.55], [0, 0, 0.55]]), jnp.zeros((2, 8)))
        np.testing.assert_allclose(state.reward, [0, -16], atol=0.1)
        np.testing.assert_array_equal(state.metrics["success"], [1, 0])
    with pytest.raises(UnknownNameError, match="goal"):
        ArenaTask("ant_push", PUSH, ROBOTS["brax"]["ant"], goal="near")


@pytest.mark.parametrize(("name", "height"), [("ant_push", None), ("ant_fall", 4.5)])
def test_drawn_goals_are_where_an_ant_can_be(name, height):
    """Of the push: not in its three solids. Of the fall: on the two platforms, at their height."""
    goal = np.asarray(start(name, 500, goal="uniform").physics.goal)
    arena = task(name)[0].arena
    x, y = goal[:, 0], goal[:, 1]
    within = [(x > a) & (x < c) & (y > b) & (y < d) for a, b, c, d in arena.solids]
    if height is None:
        assert goal.shape[1] == 2 and not np.any(within)
        assert min(((x < -4) & (y < 12)).mean(), ((x > 4) & (y > 4)).mean(), (y > 12).mean()) > 0.05
    else:
        assert np.all(goal[:, 2] == height) and np.all(within[0] | within[1]) and min(w.mean() for w in within) > 0.2


@pytest.mark.parametrize("name", ["ant_push", "ant_fall"])
def test_mixed_goals_and_starts_are_drawn_in_half_of_the_episodes(name):
    """And each without the other; a start has at least 1.1 m to walls, edges and the block, its noise included."""
    state, arena = start(name, 400, goal="mixed"), task(name)[0].arena
    drawn = (np.asarray(state.physics.goal) != np.array(arena.goal, np.float32)).any(axis=1)
    place = np.asarray(state.physics.qpos[:, :2])
    moved = np.abs(place).max(axis=1) > 0.11
    assert 0.4 < drawn.mean() < 0.6 and 0.4 < moved.mean() < 0.6 and 0.15 < (drawn & moved).mean() < 0.35
    np.testing.assert_allclose(state.obs[:, 27:29], place)
    np.testing.assert_allclose(state.obs[:, 29:31], np.asarray(state.physics.goal)[:, :2] - place, atol=1e-5)

    def gap(box):
        low, high = np.array(box).reshape(2, 2)
        return np.maximum(low - place, place - high).max(axis=1)  # negative inside

    (x, y, _), (half_x, half_y, _) = arena.block.centre, arena.block.half
    gaps = np.stack([gap(box) for box in arena.solids])
    walls = -gaps.min(axis=0) if arena.ground else gaps.min(axis=0)
    assert np.min(walls[moved]) > 1.09 and np.max(gap(arena.room)[moved]) < -1.09
    assert gap((x - half_x, y - half_y, x + half_x, y + half_y))[moved].min() > 1.09
    assert min(place[moved].min(axis=0)) < -2 and place[moved][:, 1].max() > arena.goal[1] - 3, "from end to end"
    evaluated = jax.jit(jax.vmap(AutoReset(task(name, goal="mixed")[0]).evaluated.reset))
    assert np.abs(evaluated(jax.random.split(jax.random.key(1), 50)).physics.qpos[:, :2]).max() < 0.11


def test_an_ant_on_its_back_is_cut_after_40_ticks_in_training_alone():
    for training in (True, False):
        env = make_env("ant_maze", "mujoco")
        env = env if training else env.evaluated
        step = jax.jit(jax.vmap(env.step))
        state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2))
        over = state.physics.qpos.at[0, 3:7].set(jnp.array([0.0, 1.0, 0.0, 0.0])).at[0, 2].set(0.6)
        state = state.replace(physics=state.physics.replace(qpos=over))
        cut = []
        for _ in range(41):
            state = step(state, jnp.zeros((2, 8)))
            cut.append(np.asarray(state.truncated))
        assert not np.any(cut[:39]) and not np.any(state.terminated)
        assert np.asarray(cut)[39].tolist() == [training, False]


def test_training_begins_at_ticks_apart():
    """Whatever the learner; an evaluated episode and a task that ends by itself begin at their first tick."""
    configs = {ppo: PPOConfig(num_envs=8), sac: SACConfig(num_envs=8, capacity=64)}
    for learner, config in configs.items():
        for name, apart in (("ant_maze", True), ("ant_turn", False)):
            init = jax.jit(partial(learner.init, config, task(name)[0], IdentityExecutor(8)))
            ticks = np.asarray(init(jax.random.key(0)).running.env.tick)
            assert (len(set(ticks.tolist())) > 4) == apart and (ticks.any() or not apart)
