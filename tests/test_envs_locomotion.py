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

NAMES = ("half_cheetah", "ant")


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


@pytest.mark.parametrize(("name", "sizes"), [("half_cheetah", (17, 6)), ("ant", (27, 8))], ids=("half_cheetah", "ant"))
def test_sizes_and_times_are_gyms(name, sizes):
    env, *_ = task(name)
    assert (env.observation_size, env.action_size) == sizes
    assert env.proprioceptive_size == env.observation_size
    assert env.episode_length == 1000
    assert env.dt == pytest.approx(0.05)


@pytest.mark.parametrize("name", NAMES)
def test_model_is_the_one_brax_ships(name, monkeypatch, tmp_path):
    """`load_brax_model` avoids a deprecated attribute; loading the file itself, which warns, agrees."""
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning to a file in the working folder
    folder = Path(importlib.util.find_spec("brax").origin).parent
    ours = task(name)[0].model
    theirs = mujoco.MjModel.from_xml_path(str(folder / f"envs/assets/{name}.xml"))
    for field in ("body_mass", "body_inertia", "dof_invweight0", "geom_size", "jnt_range", "actuator_gear"):
        np.testing.assert_array_equal(getattr(ours, field), getattr(theirs, field))
    assert mujoco.mj_getTotalmass(ours) == pytest.approx({"half_cheetah": 14.0, "ant": 0.911}[name], abs=1e-3)


@pytest.mark.parametrize("name", NAMES)
def test_tick_and_reward_are_those_of_the_engine_in_double_precision(name):
    """Gym-v1: x from qpos[0], 5 engine steps in 0.05 s; cheetah 0.1 |a|^2, ant 0.5 |a|^2 and 1 for health."""
    env, _, step = task(name)
    rng = np.random.default_rng(0)
    data, actions = mujoco.MjData(env.model), rng.uniform(-1, 1, (8, env.action_size)).astype(np.float32)
    start = np.array(env.model.qpos0)
    if name == "ant":
        start = np.array([0, 0, 0.55, 1, 0, 0, 0, 0, 1, 0, -1, 0, -1, 0, 1.0])
    qpos = (start + rng.uniform(-0.1, 0.1, (8, env.model.nq))).astype(np.float32)
    qvel = rng.normal(0, 0.1, (8, env.model.nv)).astype(np.float32)
    after = step(states_at(name, qpos, qvel), actions)
    for i in range(8):
        mujoco.mj_resetData(env.model, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = qpos[i], qvel[i], actions[i]
        for _ in range(5):
            mujoco.mj_step(env.model, data)
        forward = (data.qpos[0] - float(qpos[i, 0])) / 0.05
        cost = {"half_cheetah": 0.1, "ant": 0.5}[name] * float(np.sum(actions[i].astype(np.float64) ** 2))
        health = {"half_cheetah": 0.0, "ant": 1.0}[name]
        skipped = {"half_cheetah": 1, "ant": 2}[name]
        np.testing.assert_allclose(after.obs[i], np.concatenate([data.qpos[skipped:], data.qvel]), rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(after.reward[i], forward + health - cost, atol=2e-5)
        metrics = {key: value[i] for key, value in after.metrics.items()}
        np.testing.assert_allclose(metrics["forward_reward"], forward, atol=2e-5)
        np.testing.assert_allclose(metrics["x_velocity"], forward, atol=2e-5)
        np.testing.assert_allclose(metrics["control_cost"], cost, rtol=1e-5)
        assert metrics["healthy_reward"] == health


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
    np.testing.assert_array_equal(after.physics.qpos[0], state.physics.qpos[0])
    assert after.metrics["forward_reward"][0] == 0.0 and np.isfinite(after.obs).all()
    again = step(state, jnp.zeros((2, env.action_size)))
    np.testing.assert_array_equal(after.obs, again.obs)


@pytest.mark.parametrize("name", NAMES)
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
