"""Running statistics against NumPy, reward scaling against a loop."""

import jax
import numpy as np
import pytest

from taic_jax.rl import normalize

rng = np.random.default_rng(0)
update, normalized, scale_rewards = (
    jax.jit(function) for function in (normalize.update, normalize.normalize, normalize.scale_rewards)
)


def test_statistics_of_several_batches_are_numpys():
    batches = [rng.normal(3.0, [1.0, 10.0, 0.1], size=(*shape, 3)) for shape in ((4, 5), (1, 2), (30, 5))]
    statistics = normalize.init((3,))
    for batch in batches:
        statistics = update(statistics, batch.astype(np.float32))
    everything = np.concatenate([batch.reshape(-1, 3) for batch in batches])
    np.testing.assert_allclose(statistics.mean, everything.mean(axis=0), rtol=1e-4)
    np.testing.assert_allclose(statistics.std, everything.std(axis=0), rtol=1e-4)
    x = np.asarray([[3.0, 3.0, 3.0], [4.0, -4e9, 4.0]], np.float32)
    expected = np.clip((x - everything.mean(axis=0)) / everything.std(axis=0), -10.0, 10.0)
    np.testing.assert_allclose(normalized(statistics, x), expected, rtol=1e-3, atol=1e-3)


def test_nothing_seen_changes_nothing():
    x = np.asarray([1.0, -2.0], np.float32)
    np.testing.assert_array_equal(normalized(normalize.init((2,)), x), x)


@pytest.mark.parametrize("unit", [1.0, 0.01])
def test_rewards_are_divided_by_the_deviation_of_the_discounted_return(unit):
    scale, gamma, B = normalize.init_reward_scale(2), np.float32(0.9), 2
    running, totals = np.zeros(B), []
    for T in (6, 4):  # the discounted return carries over from one rollout to the next
        reward, done = rng.normal(0.0, unit, (T, B)).astype(np.float32), rng.random((T, B)) < 0.3
        scale, scaled = scale_rewards(scale, reward, done, gamma)
        for t in range(T):
            running = gamma * running + reward[t]
            totals.append(running)
            running = np.where(done[t], 0.0, running)
        np.testing.assert_allclose(scaled, reward / np.std(totals), rtol=1e-4)
        np.testing.assert_allclose(scale.discounted_return, running, rtol=1e-5, atol=1e-6 * unit)


def test_scaled_rewards_are_bounded():
    """One reward of 100 among 400 ticks is 20 deviations of 5 away."""
    reward = np.zeros((400, 1), np.float32)
    reward[7] = 100.0
    done = np.ones_like(reward, bool)
    _, scaled = scale_rewards(normalize.init_reward_scale(1), reward, done, np.float32(0.9))
    assert scaled[7, 0] == 10.0 and np.delete(scaled, 7).any() == 0


def test_statistics_carried_over_weigh_as_much_as_documented():
    """The first two of three entries are carried into four; then the new task's observations are taken in."""
    known = update(normalize.init((3,)), rng.normal([5.0, -2.0, 9.0], [2.0, 0.5, 1.0], (4000, 3)).astype(np.float32))
    carried = jax.jit(normalize.carry_over, static_argnums=(1, 2))(known, 2, 4)
    mean, std = np.append(known.mean[:2], [0, 0]), np.append(known.std[:2], [1, 1])
    np.testing.assert_array_equal(carried.mean, mean)
    np.testing.assert_array_equal(carried.std, std)
    x = rng.normal(1.0, 3.0, (500, 4)).astype(np.float32)
    after = update(carried, x)
    total = normalize.CARRIED + len(x)
    new_mean = (normalize.CARRIED * mean + x.sum(axis=0)) / total
    square = (normalize.CARRIED * (std**2 + mean**2) + np.square(x).sum(axis=0)) / total
    np.testing.assert_allclose(after.mean, new_mean, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(after.std, np.sqrt(square - new_mean**2), rtol=1e-3)
