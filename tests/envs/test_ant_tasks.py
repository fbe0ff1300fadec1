"""The turning ant, and the ants in HIRO's arenas: geometry, rewards, observations and contacts."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from ants import placed, start, task

from taic_jax.envs import AutoReset, UnknownNameError, make_env
from taic_jax.envs.arenas import outside
from taic_jax.envs.orientation import heading, upside_down, wrapped
from taic_jax.envs.third_party import third_party

ARENAS = ("ant_maze", "ant_push", "ant_fall")


def yaw_quaternion(yaw):
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)], np.float32)


@pytest.mark.parametrize("yaw", [-3.0, -1.0, 0.0, 0.7, 3.1])
def test_heading_is_the_yaw_of_the_x_axis(yaw):
    np.testing.assert_allclose(heading(jnp.array(yaw_quaternion(yaw))), yaw, atol=1e-6)
    rotation, tilted = np.zeros(9), np.array([0.8, 0.3, -0.2, 0.4])
    mujoco.mju_quat2Mat(rotation, tilted / np.linalg.norm(tilted))
    expected = np.arctan2(rotation[3], rotation[0])
    np.testing.assert_allclose(heading(jnp.array(tilted / np.linalg.norm(tilted), jnp.float32)), expected, atol=1e-6)


def test_angles_are_wrapped():
    np.testing.assert_allclose(wrapped(jnp.array([3.2, -3.2, 0.1])), [3.2 - 2 * np.pi, 2 * np.pi - 3.2, 0.1], atol=1e-6)


def test_turning_ant_is_paid_for_turning_left():
    """Spinning at 4 rad/s through the heading's jump at pi, in the air: yaw rate + 1 - 0.5 |a|^2 each tick."""
    _, _, step = task("ant_turn")
    state = start("ant_turn")
    qpos = np.tile(task("ant_turn")[0].env._init_qpos, (2, 1))
    qpos[:, 2], qpos[:, 3:7] = 0.9, yaw_quaternion(3.0)
    qvel = np.zeros((2, 14), np.float32)
    qvel[:, 5] = 4.0, -4.0
    state = state.replace(physics=state.physics.replace(qpos=jnp.array(qpos), qvel=jnp.array(qvel)))
    after = step(state, jnp.full((2, 8), 0.0))
    np.testing.assert_allclose(after.metrics["yaw_rate"], [4.0, -4.0], rtol=0.05)
    np.testing.assert_allclose(after.reward, after.metrics["yaw_rate"] + 1, atol=1e-5)
    np.testing.assert_allclose(after.metrics["turns"], after.metrics["yaw_rate"] * 0.05 / (2 * np.pi), rtol=1e-4)
    again = step(after, jnp.full((2, 8), 0.5))
    np.testing.assert_allclose(again.reward, again.metrics["yaw_rate"] + 1 - 0.5 * 8 * 0.25, atol=1e-5)
    np.testing.assert_allclose(
        again.metrics["turns"], after.metrics["turns"] + again.metrics["yaw_rate"] * 0.05 / (2 * np.pi), rtol=1e-3
    )


def test_turning_ant_observes_and_ends_like_the_ant():
    state, ant = start("ant_turn"), start("ant")
    np.testing.assert_array_equal(state.obs, ant.obs)
    fallen = placed(state, [[0, 0, 1.1], [0, 0, 0.6]])
    np.testing.assert_array_equal(task("ant_turn")[2](fallen, jnp.zeros((2, 8))).terminated, [True, False])


@pytest.mark.parametrize(
    ("name", "goal", "height", "size"),
    [("ant_maze", (0, 16), 0.75, 31), ("ant_push", (0, 19), 0.75, 34), ("ant_fall", (0, 27, 4.5), 4.75, 35)],
)
def test_observation_is_the_ants_then_position_goal_and_block(name, goal, height, size):
    env = task(name)[0]
    state, ant = start(name, 4), start("ant", 4)
    assert (env.observation_size, env.proprioceptive_size, env.action_size) == (size, 27, 8)
    torso, obs = np.asarray(state.physics.qpos[:, :3]), np.asarray(state.obs)
    np.testing.assert_allclose(torso, np.tile([0, 0, height], (4, 1)), atol=0.101)
    np.testing.assert_allclose(obs[:, 0], torso[:, 2] - (4 if name == "ant_fall" else 0), atol=1e-6)
    np.testing.assert_allclose(obs[:, 1:13], state.physics.qpos[:, 3:15])
    np.testing.assert_allclose(obs[:, 13:27], state.physics.qvel[:, :14])
    np.testing.assert_allclose(obs[:, :27], ant.obs, atol=0.6)  # the same pose; only the noise differs
    np.testing.assert_allclose(obs[:, 27:29], torso[:, :2])
    ends = 29 + len(goal)
    np.testing.assert_allclose(obs[:, 29:ends], np.array(goal) - torso[:, : len(goal)], atol=1e-5)
    if name != "ant_maze":
        block = {"ant_push": (0, 8, 2), "ant_fall": (8, 8, 6)}[name]
        np.testing.assert_allclose(obs[:, ends:], np.array(block) - torso, atol=1e-5)
        assert (state.physics.qpos[:, 15:] == 0).all() and (state.physics.qvel[:, 14:] == 0).all(), "no noise"


@pytest.mark.parametrize("name", ["ant_headings", *ARENAS])
def test_no_ant_is_thrown_over_by_its_start(name):
    _, _, step = task(name)
    state = start(name, 64)
    for _ in range(40):
        state = step(state, jnp.zeros((64, 8)))
        assert not jax.vmap(upside_down)(state.physics.qpos[:, 3:7]).any()


def test_block_is_where_its_joints_put_it():
    for name, expected in (("ant_push", (3, 8 - 2, 2)), ("ant_fall", (8, 8 + 3, 6 - 2))):
        env = task(name)[0]
        qpos = env.env._init_qpos.at[15:].set(jnp.array([3.0, -2.0]))
        np.testing.assert_allclose(env.block_position(qpos), expected)
        data = mujoco.MjData(env.model)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(env.model, data)
        np.testing.assert_allclose(data.body("block").xpos, expected, atol=1e-6)


@pytest.mark.parametrize("name", ARENAS)
def test_reward_is_the_distance_and_nothing_ends_the_episode(name):
    env, _, step = task(name)
    goal = np.array(env.arena.goal, np.float32)
    lying = [[*goal[:2], 0.3, 0, 1, 0, 0], [goal[0], goal[1] - 4.9, 0.3, 1, 0, 0, 0], [*goal[:2] - 7, 3.0, 1, 0, 0, 0]]
    lying += [[goal[0], goal[1] - 5.5, 0.3, 1, 0, 0, 0]]
    lying = [[x, y, z + env.arena.ground, *quaternion] for x, y, z, *quaternion in lying]
    after = step(placed(start(name, 4), lying), jnp.ones((4, 8)))
    distance = np.linalg.norm(np.asarray(after.physics.qpos)[:, : len(goal)] - goal, axis=1)
    np.testing.assert_allclose(after.reward, -distance, rtol=1e-5)
    np.testing.assert_allclose(after.metrics["distance"], distance, rtol=1e-5)
    np.testing.assert_array_equal(after.metrics["success"], distance < 5)
    np.testing.assert_array_equal(after.metrics["success"], [1, 1, 0, 0])
    np.testing.assert_array_equal(after.metrics["upside_down"], [1, 0, 0, 0])
    assert not after.terminated.any() and not after.truncated.any()


def test_closest_approach_is_remembered_within_an_episode():
    _, _, step = task("ant_maze")
    state = start("ant_maze", 1)
    least = state.physics.closest
    for y, expected in ((0.0, 16.0), (10.0, 6.0), (3.0, 6.0)):
        state = step(placed(state, [[0.0, y, 0.6]]), jnp.zeros((1, 8)))
        least = jnp.minimum(least, state.metrics["distance"])  # at the end of a tick
        np.testing.assert_allclose(state.metrics["closest_approach"], expected, atol=0.1)
        np.testing.assert_array_equal(state.metrics["closest_approach"], least)


def test_diverged_arena_is_cut_and_not_terminated(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning to a file in the working folder
    _, _, step = task("ant_push")
    state = start("ant_push")
    state = state.replace(physics=state.physics.replace(qvel=state.physics.qvel.at[0, 0].set(1e12)))
    after = step(state, jnp.zeros((2, 8)))
    np.testing.assert_array_equal(after.truncated, [True, False])
    assert not after.terminated.any() and np.isfinite(after.obs).all()


@pytest.mark.parametrize(("name", "total"), [("ant_maze", -16_000), ("ant_push", -19_000), ("ant_fall", -27_000)])
def test_standing_still_returns_the_distance_every_tick(name, total):
    env, _, step = task(name)
    still = placed(start(name, 1), [[0.0, 0.0, env.arena.ground + 0.55]])
    run = jax.jit(lambda s: jax.lax.scan(lambda s, _: ((s := step(s, jnp.zeros((1, 8)))), s.reward), s, length=1000))
    state, rewards = run(still)
    np.testing.assert_allclose(rewards.sum(axis=0), total, rtol=0.01)
    assert state.truncated.all() and not state.terminated.any() and env.episode_length == 1000


@pytest.mark.parametrize("name", ["ant", "ant_maze"])
def test_hiros_body_is_weaker_and_slower(name):
    env = task(name, body="hiro")[0]
    assert env.dt == pytest.approx(0.1) and env.episode_length == 500 and env.proprioception == "hiro_ant"
    assert env.model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
    np.testing.assert_array_equal(env.model.actuator_gear[:, 0], 30)
    np.testing.assert_allclose(start(name, 50, body="hiro").physics.qpos.mean(0)[:3], [0, 0, 0.75], atol=0.04)


@pytest.mark.parametrize("body", ["gym", "hiro"])
def test_an_ant_in_the_maze_moves_as_the_one_outside_it(body):
    """In the air, under the same actions; on the floor capsules and spheres choose other axes of friction."""
    alone, inside = start("ant", 4, body=body), start("ant_maze", 4, body=body)
    qpos, qvel = alone.physics.qpos.at[:, 2].add(5.0), alone.physics.qvel
    alone, inside = (s.replace(physics=s.physics.replace(qpos=qpos, qvel=qvel)) for s in (alone, inside))
    for action in np.random.default_rng(0).uniform(-1, 1, (8, 4, 8)).astype(np.float32):
        alone, inside = task("ant", body=body)[2](alone, action), task("ant_maze", body=body)[2](inside, action)
        np.testing.assert_allclose(inside.obs[:, :27], alone.obs, atol=1e-3)


def test_unknown_bodies_and_goals_are_told_the_nearest():
    for options in ({"body": "hero"}, {"goal": "unifrom"}):
        with pytest.raises(UnknownNameError, match=r"did you mean '(hiro|uniform)'"):
            make_env("ant_maze", "mujoco", **options)


@pytest.mark.parametrize(("name", "most"), [("ant_maze", 150), ("ant_push", 257), ("ant_fall", 228)])
def test_possible_contacts_stay_few_and_are_all_between_the_right_bodies(name, most):
    with third_party():
        from mujoco import mjx

        model = task(name)[0].model
        assert mjx.make_data(model, impl="jax")._impl.contact.dist.shape[0] <= most
    ant = {i for i in range(model.ngeom) if model.geom_bodyid[i] > 0 and model.geom(i).name != "block_0"}
    body = {i for i in ant if model.geom(i).contype[0]}
    assert len(ant) == 17 and len(body) == 13, "the ant's feet are the ends of its ankles"
    for i in range(model.ngeom):
        meets = [j for j in body if model.geom(j).contype[0] & model.geom(i).conaffinity[0]]
        assert len(meets) == (0 if i in ant else 13), model.geom(i).name


def driven(name: str, backend: str, torso: tuple, velocity: tuple, ticks: int):
    """Return the path of qpos [ticks, nq] of an ant that is driven: its legs hang, its torso gets that speed.

    At the block's stop it lets go, as a walking ant does at each stride: pressed against the stop, a block of
    0.1 kg hangs there by friction alone.
    """
    env = make_env(name, backend)
    state = env.reset(jax.random.key(0))
    physics = state.physics
    qpos = env.env._init_qpos.at[:3].set(jnp.array(torso))
    state = state.replace(physics=physics.replace(qpos=qpos, qvel=jnp.zeros_like(physics.qvel)))

    def tick(state, _):
        speed = jnp.where(state.physics.qpos[15] < 7.97, jnp.array(velocity), -0.1 * jnp.array(velocity))
        qvel = state.physics.qvel.at[:2].set(speed).at[3:6].set(0.0)
        state = env.step(state.replace(physics=state.physics.replace(qvel=qvel)), jnp.zeros(8))
        return state, state.physics.qpos

    return np.asarray(jax.jit(lambda s: jax.lax.scan(tick, s, length=ticks)[1])(state)), env


@pytest.mark.parametrize("backend", ["mujoco", "mjx"])
@pytest.mark.parametrize(
    ("name", "torso", "velocity"),
    [("ant_push", (-6.0, 8.0, 0.6), (2.0, 0.0)), ("ant_fall", (8.0, 2.0, 4.6), (0.0, 2.0))],
)
def test_ant_pushes_the_block_to_its_stop(name, torso, velocity, backend):
    """Eight metres at 2 m/s take 80 ticks; in ant_fall the block then drops flush with the platforms."""
    qpos, env = driven(name, backend, torso, velocity, 160)
    along, other = qpos[:, 15], qpos[:, 16]
    assert np.isfinite(qpos).all() and np.abs(np.diff(along)).max() < 0.3
    assert abs(along[-1] - 8.0) < 0.05, along[::10]
    if name == "ant_push":
        assert np.abs(other).max() < 0.3, "it was pushed straight"
    else:
        assert abs(env.block_position(jnp.array(qpos[-1]))[2] + 2.0 - 4.0) < 0.02, "its top is flush"
        assert np.abs(other[along < 7.8]).max() < 0.15, "on the way it neither sinks nor jumps"


@pytest.mark.parametrize("backend", ["mujoco", "mjx"])
def test_block_in_the_chasm_carries_the_ant(backend):
    env = make_env("ant_fall", backend)
    state = env.reset(jax.random.key(0))
    qpos = env.env._init_qpos.at[:3].set(jnp.array([8.0, 16.0, 4.6])).at[15:].set(jnp.array([8.0, -4.0]))
    state = state.replace(physics=state.physics.replace(qpos=qpos))
    run = jax.jit(
        lambda s: jax.lax.scan(lambda s, _: ((s := env.step(s, jnp.zeros(8))), s.physics.qpos), s, length=200)
    )
    path = np.asarray(run(state)[1])
    assert path[:, 2].min() > 4.2, "the torso stays a leg's height above the block"
    assert np.abs(path[:, 16] + 4.0).max() < 0.02 and np.abs(path[:, 15] - 8.0).max() < 0.05


@pytest.mark.parametrize("name", ARENAS)
def test_random_ants_stay_inside_and_blocks_within_their_limits(name):
    env = AutoReset(make_env(name, "mujoco"))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 32))

    def tick(state, key):
        action = jax.random.uniform(key, (32, 8), minval=-1.0)
        return (state := jax.vmap(env.step)(state, action)), state.physics.qpos

    keys = jax.random.split(jax.random.key(1), 300)
    qpos = np.asarray(jax.jit(lambda s: jax.lax.scan(tick, s, keys)[1])(state))
    assert outside(env.arena, qpos) == 0 and np.isfinite(qpos).all()
