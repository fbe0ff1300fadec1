"""The cart pole of the learners' tests has Gymnasium's dynamics."""

import gymnasium
import jax
import numpy as np
from cart_pole import CartPole

from taic_jax.envs import check_contract


def test_the_dynamics_are_gymnasiums():
    """Under random actions, and under one that drives the cart out; float32 against float64."""
    env, theirs = CartPole(), gymnasium.make("CartPole-v1").unwrapped
    check_contract(env)
    reset, step = jax.jit(env.reset), jax.jit(env.step)
    rng, ends = np.random.default_rng(0), []
    for seed in range(4):
        state = reset(jax.random.key(seed))
        theirs.reset(seed=seed)
        theirs.state = np.array(state.physics, np.float64)
        if seed == 3:
            state = state.replace(physics=np.array([2.3, 3.0, 0.0, 0.0], np.float32))
            theirs.state = np.array(state.physics, np.float64)
        for _ in range(100):
            action = int(rng.integers(2))
            state = step(state, np.eye(2, dtype=np.float32)[action])
            obs, reward, terminated, _, _ = theirs.step(action)
            np.testing.assert_allclose(state.obs, obs, rtol=1e-4, atol=1e-5)
            assert (float(state.reward), bool(state.terminated)) == (reward, terminated)
            if terminated:
                ends.append(float(abs(state.obs[0])))
                break
    assert len(ends) == 4 and max(ends[:3]) < 2.4 < ends[3], "the pole falls three times, and the cart leaves once"


def test_starts_are_drawn():
    starts = jax.vmap(CartPole().reset)(jax.random.split(jax.random.key(0), 1000)).obs
    assert 0.048 < np.abs(starts).max() <= 0.05 and (np.abs(starts.mean(axis=0)) < 0.004).all()
