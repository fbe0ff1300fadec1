"""`model="gym"` against Gymnasium's own environments, version 5: tick by tick, and over whole episodes."""

import functools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from taic_jax.envs import AutoReset, PhysicsState, make_env

TICKS, EPISODES, ENVS = 250, 50, 50
THEIRS = {
    "half_cheetah": ("HalfCheetah-v5", {}),
    "ant": ("Ant-v5", {"contact_cost_weight": 0.0, "include_cfrc_ext_in_observation": False}),
    "hopper": ("Hopper-v5", {}),
    "walker2d": ("Walker2d-v5", {}),
}
# Gymnasium's ant takes its speed from the torso's world position, which lags behind qpos by part of an engine
# step; the others read qpos. Over a trajectory the difference cancels.
REWARD_TOLERANCE = {"half_cheetah": 1e-4, "ant": 0.1, "hopper": 1e-4, "walker2d": 1e-4}


@functools.cache
def task(name: str):
    env = make_env(name, "mujoco", model="gym")
    return env, jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))


@functools.cache
def trajectory(name: str) -> dict[str, np.ndarray]:
    """Return what Gymnasium makes of random actions: states before each tick, and what came of them."""
    env_id, options = THEIRS[name]
    env = gymnasium.make(env_id, **options).unwrapped
    rows, rng = [], np.random.default_rng(0)
    env.reset(seed=0)
    for _ in range(TICKS):
        before = {key: getattr(env.data, key).astype(np.float32) for key in ("qpos", "qvel", "qacc_warmstart")}
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        x_before = env.data.qpos[0]
        obs, reward, terminated, _, info = env.step(action)
        rows.append(
            {**before, "action": action, "obs": obs, "reward": reward, "terminated": terminated,
             "lag": (env.data.qpos[0] - x_before) / env.dt - info["x_velocity"]}
        )  # fmt: skip
        if terminated:
            env.reset()
    env.close()
    return {key: np.array([row[key] for row in rows]) for key in rows[0]}


@pytest.mark.parametrize("name", THEIRS)
def test_every_tick_of_a_trajectory_equals_gymnasiums(name):
    env, reset, step = task(name)
    theirs = trajectory(name)
    state = reset(jax.random.split(jax.random.key(0), TICKS))
    physics = PhysicsState(*(jnp.array(theirs[key]) for key in ("qpos", "qvel", "qacc_warmstart")))
    ours = step(state.replace(physics=physics), jnp.array(theirs["action"]))
    assert env.observation_size == theirs["obs"].shape[1]
    # Inputs are rounded to single precision, and contacts amplify that.
    error = np.abs(np.asarray(ours.obs) - theirs["obs"]) / (1 + np.abs(theirs["obs"]))
    assert error.max() < 1e-4 and np.median(error) < 1e-6
    np.testing.assert_allclose(ours.reward, theirs["reward"] + theirs["lag"], atol=1e-4)
    np.testing.assert_allclose(ours.reward, theirs["reward"], atol=REWARD_TOLERANCE[name])
    np.testing.assert_array_equal(ours.terminated, theirs["terminated"])
    assert theirs["terminated"].any() or name == "half_cheetah"


def their_episodes(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return returns and lengths of episodes of a random policy in Gymnasium."""
    env_id, options = THEIRS[name]
    env, rng = gymnasium.make(env_id, **options), np.random.default_rng(1)
    returns, lengths = np.zeros(EPISODES), np.zeros(EPISODES)
    for episode in range(EPISODES):
        env.reset(seed=episode)
        ended = False
        while not ended:
            _, reward, terminated, truncated, _ = env.step(rng.uniform(-1, 1, env.action_space.shape))
            returns[episode] += reward
            lengths[episode] += 1
            ended = terminated or truncated
    env.close()
    return returns, lengths


def our_episodes(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the same of ours, of the first episode of each environment."""
    env = AutoReset(task(name)[0])
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(2), ENVS))

    def tick(state, key):
        state = jax.vmap(env.step)(state, jax.random.uniform(key, (ENVS, env.action_size), minval=-1.0))
        return state, (state.reward, state.terminated | state.truncated)

    keys = jax.random.split(jax.random.key(3), 1000)
    rewards, ended = jax.tree.map(np.asarray, jax.jit(lambda s: jax.lax.scan(tick, s, keys)[1])(state))
    first = np.cumsum(ended, axis=0) - ended == 0
    return (rewards * first).sum(axis=0), first.sum(axis=0)


@pytest.mark.parametrize("name", THEIRS)
def test_episodes_of_a_random_policy_are_distributed_like_gymnasiums(name):
    for ours, theirs in zip(our_episodes(name), their_episodes(name), strict=True):
        assert scipy.stats.ks_2samp(ours, theirs).pvalue > 1e-3
        error = np.sqrt(ours.var() / len(ours) + theirs.var() / len(theirs))
        assert abs(ours.mean() - theirs.mean()) <= 4 * error + 1e-9


@pytest.mark.parametrize("name", THEIRS)
def test_health_is_paid_by_gymnasiums_rule(name):
    """Version 5 does not pay it at the tick that ends the episode."""
    _, reset, step = task(name)
    theirs = trajectory(name)
    physics = PhysicsState(*(jnp.array(theirs[key]) for key in ("qpos", "qvel", "qacc_warmstart")))
    ours = step(reset(jax.random.split(jax.random.key(0), TICKS)).replace(physics=physics), jnp.array(theirs["action"]))
    expected = 0 if name == "half_cheetah" else ~theirs["terminated"]
    np.testing.assert_array_equal(ours.metrics["healthy_reward"], expected)
