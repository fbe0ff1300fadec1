"""The replay buffer of decisions: semi-Markov transitions against plain code, and a bounded buffer row by row."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Counting, Repeat

from taic_jax.envs import AutoReset
from taic_jax.rl import replay
from taic_jax.rl.replay import Transition
from taic_jax.rl.rollout import Rollout, rollout, start

B, D, GAMMA = 3, 1, 0.9


def collected(env, executor, rounds: int, ticks: int) -> tuple[Rollout, Transition]:
    """Return ticks [T, B] of several rollouts, and the transitions completed on the way."""
    wrapped, pending = AutoReset(env), replay.init_pending(B, 1, D)
    running = start(wrapped, executor, B, jax.random.key(0))
    parts = []
    for round_ in range(rounds):
        decide = lambda obs, noise: (noise, noise[:, 0])  # noqa: E731
        running, now = rollout(wrapped, executor, decide, running, jax.random.key(round_), ticks)
        pending, transitions = jax.jit(replay.complete)(pending, now, GAMMA)
        parts.append((now, transitions))
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


@pytest.mark.parametrize("truncated", [True, False])
@pytest.mark.parametrize(("length", "noise_size"), [(1, 0), (3, 0), (4, 1)])
def test_a_transition_has_its_options_discounted_rewards_and_the_observation_after_it(truncated, length, noise_size):
    env, executor = Counting(7, truncated=truncated, spread=5), Repeat(length, noise_size=noise_size)
    ticks, got = collected(env, executor, rounds=5, ticks=4)  # options outlast the rounds
    checked = 0
    for b in range(B):
        for t in np.flatnonzero(ticks.ended[:, b]):
            k = int(ticks.duration[t, b])
            first = t - k + 1
            assert ticks.decision[first, b]
            reward = sum(GAMMA**i * ticks.reward[first + i, b] for i in range(k))
            np.testing.assert_allclose(got.reward[t, b], reward, rtol=1e-5)
            np.testing.assert_allclose(got.discount[t, b], 0 if ticks.terminated[t, b] else GAMMA**k, rtol=1e-5)
            np.testing.assert_array_equal(got.obs[t, b], ticks.obs[first, b])
            np.testing.assert_array_equal(got.option[t, b], ticks.option[first, b])
            np.testing.assert_array_equal(got.next_obs[t, b], ticks.final_obs[t, b])
            checked += 1
    assert checked >= 5 * 4 * B / length and (ticks.terminated | ticks.truncated).any()


def rows(first: int, count: int, b: int) -> Transition:
    """Return transitions [count, b] whose entries are their number, from `first` on."""
    x = jnp.arange(first, first + count * b, dtype=jnp.float32).reshape(count, b)
    return Transition(x[..., None], x[..., None] + 0.1, x + 0.2, x + 0.3, x[..., None] + 0.4)


def test_the_buffer_keeps_the_newest_chosen_transitions():
    buffer, chosen, kept = replay.init(7, 1, D), np.random.default_rng(0).random((6, 2, 3)) < 0.4, []
    add = jax.jit(replay.add)
    for round_, which in enumerate(chosen):
        buffer = add(buffer, rows(6 * round_, 2, 3), which)
        kept += [6 * round_ + i for i in np.flatnonzero(which)]
        newest = np.full(7, np.nan)
        for place, number in enumerate(kept):
            newest[place % 7] = number
        filled = ~np.isnan(newest)
        assert buffer.count == len(kept)
        np.testing.assert_allclose(buffer.rows[filled, 0], newest[filled])
        np.testing.assert_allclose(
            buffer.rows[filled] - buffer.rows[filled, :1], [[0, 0.1, 0.2, 0.3, 0.4]] * filled.sum(), atol=1e-5
        )
        assert not buffer.rows[~filled].any()
    assert len(kept) > 10


def test_samples_are_uniform_over_the_rows_that_are_filled():
    like = replay.init_pending(1, 1, D)
    sample = jax.jit(lambda buffer, key: replay.sample(buffer, key, 4000, like))
    for count in (3, 5, 9):
        buffer = replay.add(replay.init(5, 1, D), rows(0, count, 1), jnp.ones((count, 1), bool))
        batch = sample(buffer, jax.random.key(0))
        values, counts = np.unique(batch.obs, return_counts=True)
        np.testing.assert_array_equal(values, np.arange(count)[-5:])
        assert counts.min() > 0.85 * 4000 / len(values)
        for name, offset in (("option", 0.1), ("reward", 0.2), ("discount", 0.3), ("next_obs", 0.4)):
            np.testing.assert_allclose(np.ravel(getattr(batch, name)) - np.ravel(batch.obs), offset, atol=1e-5)
