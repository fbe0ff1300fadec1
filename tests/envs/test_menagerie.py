"""Robots of MuJoCo Menagerie, on a robot of our own in a checkout: no network is used."""

import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from quadruped import HOME, MASS, MOTOR, write_checkout

from taic_jax import run
from taic_jax.envs import MissingExtraError, ModelError, UnknownNameError, make_env
from taic_jax.envs.headings import FAR

pytest.importorskip("mujoco_menagerie")
KEYS = jax.random.split(jax.random.key(0), 8)
GO2 = "menagerie:unitree_go2"


@pytest.fixture(scope="module", autouse=True)
def checkout(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MENAGERIE_ROOT", str(write_checkout(tmp_path_factory.mktemp("menagerie"))))
        yield


@pytest.fixture(scope="module")
def go2(checkout):
    env = make_env(GO2, "mujoco")
    return env, jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))


def test_observation_and_heading_are_those_of_locomotion(go2):
    env, reset, _ = go2
    assert (env.observation_size, env.proprioceptive_size, env.action_size) == (17 + 18, 17 + 18, 12)
    assert (env.dt, env.episode_length, env.proprioception, len(env.views)) == (0.02, 1000, GO2, 1)
    state, place = reset(KEYS), env.heading
    np.testing.assert_array_equal(state.obs, np.hstack([state.physics.qpos[:, 2:], state.physics.qvel]))
    np.testing.assert_array_equal(state.obs[:, place.quaternion : place.quaternion + 4], state.physics.qpos[:, 3:7])
    np.testing.assert_array_equal(state.obs[:, place.velocity : place.velocity + 2], state.physics.qvel[:, :2])
    np.testing.assert_allclose(state.physics.qpos, np.tile(HOME, (8, 1)), atol=0.02)
    assert np.asarray(state.physics.qpos).std(axis=0).min() > 0.005, "every start is another"


def test_actions_are_targets_about_home_within_the_limits_of_the_servos(go2):
    """By the engine alone: home + 0.5 rad at an action of 1, five substeps of 4 ms."""
    env, reset, step = go2
    state = reset(KEYS[:2])
    action = jax.random.uniform(jax.random.key(1), (2, 12), minval=-1.0).at[:, 0].set(1.0)
    after, model = step(state, action), env.model
    assert model.opt.timestep == 0.004
    for row in range(2):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = state.physics.qpos[row], state.physics.qvel[row]
        targets = np.array(HOME[7:]) + 0.5 * np.asarray(action[row])
        assert targets[0] == 0.5
        data.ctrl[:] = np.clip(targets, *np.tile([[-0.3, -1.4, -2.6], [0.3, 3.2, -0.9]], 4))
        for _ in range(5):
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(after.physics.qpos[row], data.qpos, atol=1e-5)


def test_home_is_where_it_stands(go2):
    _, reset, step = go2
    state = reset(KEYS)
    for _ in range(100):
        state = step(state, jnp.zeros((8, 12)))
        assert not state.terminated.any()
    assert np.asarray(state.physics.qpos[:, 2]).min() > 0.2


def test_reward_is_speed_and_health_less_action_by_hand(go2):
    _, reset, step = go2
    state = reset(KEYS)
    state = state.replace(physics=state.physics.replace(qvel=state.physics.qvel.at[:, 0].set(1.0)))
    after = step(state, jnp.full((8, 12), 0.5))
    speed = (after.physics.qpos[:, 0] - state.physics.qpos[:, 0]) / 0.02
    assert np.asarray(speed).min() > 0.3
    np.testing.assert_allclose(after.reward, speed + 1.0 - 0.05 * 12 * 0.25, atol=1e-4)


@pytest.mark.parametrize(
    ("height", "tilt", "ends"),
    [(0.28, 0.0, False), (0.15, 0.0, True), (0.6, 0.0, True), (0.4, 0.7, False), (0.4, -0.7, False), (0.4, 0.9, True)],
)
def test_it_ends_below_and_above_its_heights_and_beyond_its_tilt(go2, height, tilt, ends):
    """Heights are fractions of home's, 0.28 m; the tilt counts about any axis, and at any yaw."""
    _, reset, step = go2
    state, quaternions = reset(KEYS), np.zeros((8, 4))
    for row, (axis, yaw) in enumerate([(a, y) for a in ([1, 0, 0], [0, 1, 0]) for y in (0.0, 1.0, 2.0, 3.0)]):
        tilted, turn = np.zeros(4), np.zeros(4)
        mujoco.mju_axisAngle2Quat(tilted, np.array(axis, float), tilt)
        mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), yaw)
        mujoco.mju_mulQuat(quaternions[row], turn, tilted)
    qpos = state.physics.qpos.at[:, 2].set(height).at[:, 3:7].set(jnp.array(quaternions, jnp.float32))
    still = state.replace(physics=state.physics.replace(qpos=qpos, qvel=jnp.zeros_like(state.physics.qvel)))
    np.testing.assert_array_equal(step(still, jnp.zeros((8, 12))).terminated, ends)


def test_pictures_show_what_nothing_touches(go2):
    """The engine steps a model without the shell; masses are the same."""
    env, _, _ = go2
    drawn, stepped = env.model, env.physics.model
    assert drawn.ngeom == stepped.ngeom + 1 and mujoco.mj_name2id(drawn, mujoco.mjtObj.mjOBJ_GEOM, "shell") >= 0
    np.testing.assert_array_equal(drawn.body_mass, stepped.body_mass)
    assert drawn.camera("track").mode[0] == mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM


def test_directions_come_from_everywhere_and_the_fence_has_a_tenth_of_the_weight():
    """The body has one view. Each direction lasts 3 s."""
    env = make_env(f"{GO2}_headings", "mujoco")
    assert (env.observation_size, env.proprioceptive_size, env.proprioception) == (35 + 4, 35, GO2)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 64))
    directions = np.asarray(state.physics.directions)
    assert directions.shape == (64, 8) and directions.min() < -3.0 < 3.0 < directions.max()
    assert np.asarray(state.physics.tick).max() in range(100, 150)
    fence = np.asarray(state.physics.qpos[:, 19:])
    assert set(np.unique(fence)) == {0.0, FAR} and not np.asarray(state.physics.qvel[:, 18:]).any()
    model = env.physics.model
    np.testing.assert_allclose(model.body("fence").mass, 0.1 * MASS, rtol=1e-6)
    np.testing.assert_allclose(model.dof_damping[18:], MASS, rtol=1e-6)
    floor, side = model.geom("floor"), model.geom("fence_0")
    assert not floor.contype & side.conaffinity and not side.contype & floor.conaffinity
    state, step = jax.tree.map(lambda x: x[:16], state), jax.jit(jax.vmap(env.step))
    for _ in range(50):
        state = step(state, jnp.zeros((16, 12)))
    assert np.asarray(state.physics.qpos[:, 2]).min() > 0.2, "it stands"


def test_the_maze_is_the_ants_and_stops_the_body():
    env = make_env(f"{GO2}_maze", "mujoco")
    assert (env.observation_size, env.proprioceptive_size, env.episode_length) == (35 + 4, 35, 2500)
    state, step = jax.jit(env.reset)(KEYS[0]), jax.jit(env.step)
    np.testing.assert_allclose(state.physics.qpos, HOME, atol=0.02)
    place = np.asarray(state.physics.qpos[:2])
    np.testing.assert_allclose(state.obs[35:], [*place, *([0, 16] - place)], atol=1e-6)
    for push in ((0.0, 2.0), (-2.0, 0.0)):  # against the solid at y = 4, then the wall at x = -4
        for _ in range(300):
            qvel = state.physics.qvel.at[:2].set(jnp.array(push)).at[3:6].set(0.0)
            qpos = state.physics.qpos.at[3:7].set(jnp.array([1.0, 0, 0, 0]))
            state = step(state.replace(physics=state.physics.replace(qpos=qpos, qvel=qvel)), jnp.zeros(12))
        x, y = state.physics.qpos[:2]
        assert (3.5 < y < 4.0) if push[1] else (-4.0 < x < -3.5)
    assert make_env(f"{GO2}_maze", "mujoco", goal="near").arena.goal == (16.0, 0.0)


def test_the_end_of_a_folders_name_will_do_and_a_wrong_one_gets_the_nearest():
    assert make_env("menagerie:go2", "mujoco").proprioception == GO2
    for name in ("menagerie:unitree_go3", "menagerie:unitree_go3_maze"):
        with pytest.raises(UnknownNameError, match=r"^unknown robot 'menagerie:unitree_go3': did you mean '.*_go[12]'"):
            make_env(name)
    with pytest.raises(UnknownNameError, match="unknown robot 'menagerie:franka_emika_panda'"):
        make_env("menagerie:franka_emika_panda")  # an arm


MOCAP = '<worldbody> <body name="hand" mocap="true"> <geom size="0.1" contype="0"/> </body> </worldbody>'
BAD_MODELS = {
    "pose": ({"keyframe": "lying"}, "model menagerie:unitree_go2: got keyframes lying, expected one of home, standing"),
    "motors": ({"actuator": MOTOR}, "model go2: got actuator 0, expected position servos of joints alone"),
    "mocap": ({"more": MOCAP}, "model go2: got mocap bodies, which the state of the physics cannot carry"),
    "broken": ({"more": "<oh>"}, "model menagerie:unitree_go2: XML"),
}


@pytest.mark.parametrize("case", BAD_MODELS)
def test_a_model_that_does_not_fit_is_refused_in_one_line(case, tmp_path, monkeypatch, capsys):
    changes, says = BAD_MODELS[case]
    monkeypatch.setenv("MENAGERIE_ROOT", str(write_checkout(tmp_path, **changes)))
    monkeypatch.chdir(tmp_path)
    assert run.main(["--env.name", GO2, "--collect.env", "", "--run-dir", "new"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"taic_jax: error: {says}") and error.count("\n") == 1, error
    assert not (tmp_path / "new").exists()


def test_without_a_network_and_without_the_package_one_line_says_so(monkeypatch, tmp_path):
    monkeypatch.delenv("MENAGERIE_ROOT")
    monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("MENAGERIE_BASE_URL", (tmp_path / "nowhere").as_uri())
    with pytest.raises(ModelError, match=r"^model menagerie:unitree_go2: .*not found; expected a network, or a check"):
        make_env(GO2)
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'taic-jax\[menagerie\]'$"):
        make_env(GO2)
