"""The running robots: starts, rewards and ends against MuJoCo's own engine and Gym's formulas."""

import functools
import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from taic_jax.envs import PhysicsState, make_env

NAMES = ("half_cheetah", "ant", "hopper", "walker2d")
# From Gym's sources, version 1: sizes of obs and action, seconds a tick, weight of |a|^2, bonus for health.
GYM = {
    "half_cheetah": (17, 6, 0.05, 0.1, 0.0),
    "ant": (27, 8, 0.05, 0.5, 1.0),
    "hopper": (11, 3, 0.008, 1e-3, 1.0),
    "walker2d": (17, 6, 0.008, 1e-3, 1.0),
}
MASSES = {"half_cheetah": 14.0, "ant": 0.911, "hopper": 15.82, "walker2d": 23.677}


@functools.cache
def task(name: str):
    """Return the task on MuJoCo's C engine, and its jitted functions over a batch."""
    env = make_env(name, "mujoco")
    return env, jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))


def states_at(name: str, qpos, qvel):
    """Return a batch of states there, with a cold solver."""
    env, reset, _ = task(name)
    state = reset(jax.random.split(jax.random.key(0), len(qpos)))
    physics = PhysicsState(
        jnp.array(qpos, jnp.float32), jnp.array(qvel, jnp.float32), jnp.zeros((len(qpos), env.model.nv))
    )
    return state.replace(physics=physics)


@pytest.mark.parametrize("name", NAMES)
def test_sizes_and_times_are_gyms(name):
    env, *_ = task(name)
    assert (env.observation_size, env.action_size) == GYM[name][:2]
    assert env.proprioceptive_size == env.observation_size
    assert env.episode_length == 1000
    assert env.dt == pytest.approx(GYM[name][2])


@pytest.mark.parametrize("name", NAMES)
def test_model_is_the_one_brax_ships(name, monkeypatch, tmp_path):
    """`load_brax_model` avoids a deprecated attribute; loading the file itself, which warns, agrees."""
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning to a file in the working folder
    folder = Path(importlib.util.find_spec("brax").origin).parent
    ours = task(name)[0].model
    theirs = mujoco.MjModel.from_xml_path(str(folder / f"envs/assets/{name}.xml"))
    for field in ("body_mass", "body_inertia", "dof_invweight0", "geom_size", "jnt_range", "actuator_gear"):
        np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))
    assert mujoco.mj_getTotalmass(ours) == pytest.approx(MASSES[name], abs=1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_tick_and_reward_are_those_of_the_engine_in_double_precision(name):
    """Gym-v1: x from qpos[0], the torso's height from its body, velocities of the planar walkers clipped at 10."""
    env, _, step = task(name)
    _, _, dt, weight, health = GYM[name]
    rng = np.random.default_rng(0)
    data, actions = mujoco.MjData(env.model), rng.uniform(-1, 1, (8, env.action_size)).astype(np.float32)
    start = np.array(env.model.qpos0)
    if name == "ant":
        start = np.array([0, 0, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1.0])
    qpos = (start + rng.uniform(-0.1, 0.1, (8, env.model.nq))).astype(np.float32)
    qvel = rng.normal(0, 8.0 if name in ("hopper", "walker2d") else 0.1, (8, env.model.nv)).astype(np.float32)
    after = step(states_at(name, qpos, qvel), actions)
    clipped = 0
    for i in range(8):
        mujoco.mj_resetData(env.model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[i], qvel[i], actions[i]
        for _ in range(round(dt / env.model.opt.timestep)):
            mujoco.mj_step(env.model, data)
        mujoco.mj_kinematics(env.model, data)
        obs = np.concatenate([data.qpos[2 if name == "ant" else 1 :], data.qvel])
        if name in ("hopper", "walker2d"):
            obs[0] = data.body("torso").xpos[2]
            clipped += np.sum(np.abs(data.qvel) > 10)
            obs[-env.model.nv :] = np.clip(data.qvel, -10, 10)
        forward = (data.qpos[0] - float(qpos[i, 0])) / dt
        cost = weight * float(np.sum(actions[i].astype(np.float64) ** 2))
        np.testing.assert_allclose(after.obs[i], obs, rtol=1e-5, atol=2e-5)
        np.testing.assert_allclose(after.reward[i], forward + health - cost, atol=1e-4)
        metrics = {key: value[i] for key, value in after.metrics.items()}
        np.testing.assert_allclose(metrics["forward_reward"], forward, atol=1e-4)
        np.testing.assert_allclose(metrics["x_velocity"], forward, atol=1e-4)
        np.testing.assert_allclose(metrics["control_cost"], cost, rtol=1e-5)
        assert metrics["healthy_reward"] == health
    assert clipped or name not in ("hopper", "walker2d"), "no velocity is large enough to be clipped"


@pytest.mark.parametrize(
    ("name", "entry", "ends"),
    [
        ("hopper", ("qpos", 1), [(-0.4, False), (-0.6, True), (2.0, False)]),  # height 1.25 + this, above 0.7
        ("hopper", ("qpos", 2), [(0.19, False), (0.21, True), (-0.21, True)]),
        ("hopper", ("qvel", 3), [(99.0, False), (101.0, True)]),
        ("walker2d", ("qpos", 1), [(-0.4, False), (-0.5, True), (0.7, False), (0.8, True)]),
        ("walker2d", ("qpos", 2), [(0.95, False), (1.05, True), (-1.05, True)]),
        ("walker2d", ("qvel", 3), [(101.0, False)]),
    ],
)
def test_walkers_end_where_gym_ends_them(name, entry, ends):
    env = task(name)[0].env
    field, index = entry
    for value, ended in ends:
        state = {"qpos": np.zeros(env.model.nq, np.float32), "qvel": np.zeros(env.model.nv, np.float32)}
        state[field][index] = value
        physics = PhysicsState(jnp.array(state["qpos"]), jnp.array(state["qvel"]), jnp.zeros(env.model.nv))
        assert bool(env._is_healthy(physics)) != ended, (entry, value)


def test_ant_ends_outside_its_healthy_heights():
    """A tick of free fall is 1.2 cm; on its back, the ant touches nothing."""
    env, _, step = task("ant")
    qpos = np.tile(env.env._init_qpos, (5, 1))
    qpos[:, 2], qpos[:, 3:7] = [0.19, 0.22, 0.55, 1.0, 1.03], [0.0, 1.0, 0.0, 0.0]
    after = step(states_at("ant", qpos, np.zeros((5, env.model.nv))), jnp.zeros((5, 8)))
    np.testing.assert_array_equal(after.terminated, [True, False, False, False, True])
    np.testing.assert_array_equal(after.metrics["healthy_reward"], np.ones(5))  # to the last, as in Gym


def test_cheetah_never_ends():
    env, _, step = task("half_cheetah")
    qpos = np.zeros((2, env.model.nq))
    qpos[1, 1:3] = 3.0, 3.1  # high up, upside down
    after = step(states_at("half_cheetah", qpos, np.zeros((2, env.model.nv))), jnp.zeros((2, 6)))
    assert not after.terminated.any()


@pytest.mark.parametrize("name", NAMES)
def test_divergence_ends_the_episode_in_the_last_finite_state(name, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    env, _, step = task(name)
    state = states_at(name, np.tile(env.env._init_qpos, (2, 1)), np.zeros((2, env.model.nv)))
    state = state.replace(physics=state.physics.replace(qvel=state.physics.qvel.at[0, 0].set(1e12)))
    after = step(state, jnp.zeros((2, env.action_size)))
    np.testing.assert_array_equal(after.terminated, [True, False])
    np.testing.assert_array_equal(after.metrics["unstable"], [1.0, 0.0])
    np.testing.assert_array_equal(after.physics.qpos[0], state.physics.qpos[0])
    assert after.metrics["forward_reward"][0] == 0.0 and np.isfinite(after.obs).all()
    again = step(state, jnp.zeros((2, env.action_size)))
    np.testing.assert_array_equal(after.obs, again.obs)


@pytest.mark.parametrize("name", ["hopper", "walker2d"])
def test_walkers_start_with_gyms_small_noise(name):
    env, reset, _ = task(name)
    physics = reset(jax.random.split(jax.random.key(0), 4000)).physics
    noise = np.concatenate([np.asarray(physics.qpos) - np.asarray(env.env._init_qpos), physics.qvel], axis=1)
    assert np.abs(noise).max() <= 5e-3 + 1e-7
    np.testing.assert_allclose(noise.std(0), 5e-3 / np.sqrt(3), rtol=0.04)  # uniform on +-0.005


@pytest.mark.parametrize("name", ["half_cheetah", "ant"])
def test_starts_have_gyms_noise(name):
    env, reset, _ = task(name)
    physics = reset(jax.random.split(jax.random.key(0), 4000)).physics
    qpos = np.asarray(physics.qpos) - np.asarray(env.env._init_qpos)
    assert np.abs(qpos).max() <= 0.1 + 1e-6
    np.testing.assert_allclose(qpos.std(0), 0.1 / np.sqrt(3), rtol=0.04)  # uniform on +-0.1
    np.testing.assert_allclose(qpos.mean(0), 0, atol=0.005)
    qvel = np.asarray(physics.qvel)
    np.testing.assert_allclose(qvel.std(0), 0.1, rtol=0.05)
    np.testing.assert_allclose((qvel**4).mean(0) / qvel.var(0) ** 2, 3, rtol=0.25)  # a normal's kurtosis
    noise = np.corrcoef(np.concatenate([qpos, qvel], axis=1).T)
    assert np.abs(noise - np.eye(len(noise))).max() < 0.08, "independent"


def test_ant_starts_in_the_pose_that_brax_gives():
    np.testing.assert_allclose(task("ant")[0].env._init_qpos, [0, 0, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1])
