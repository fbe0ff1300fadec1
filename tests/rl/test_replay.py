"""The replay buffer of decisions: semi-Markov transitions against plain code, and a bounded buffer row by row."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Counting, Repeat

from taic_jax.envs import AutoReset
from taic_jax.envs.base import Goals
from taic_jax.rl import replay
from taic_jax.rl.replay import Transition
from taic_jax.rl.rollout import Rollout, rollout, start

B, D, GAMMA = 3, 1, 0.9
GOALS = (
    Goals(  # the achieved goal is ten times the observation; a tick is rewarded by the distance, and one near ends it
        1,
        lambda obs: 10 * obs,
        lambda obs, goal: obs + 1000 * goal,
        lambda achieved, goal: (-jnp.abs(achieved - goal)[0], jnp.abs(achieved - goal)[0] < 1),
    )
)


def collected(env, executor, rounds: int, ticks: int) -> tuple[Rollout, Transition]:
    """Return ticks [T, B] of several rollouts, and the transitions completed on the way."""
    wrapped, pending = AutoReset(env), replay.init_pending(B, 1, D, executor.length, 1)
    running = start(wrapped, executor, B, jax.random.key(0))
    parts = []
    for round_ in range(rounds):
        decide = lambda obs, noise: (noise, noise[:, 0])  # noqa: E731
        running, now = rollout(wrapped, executor, decide, running, jax.random.key(round_), ticks)
        pending, transitions = jax.jit(lambda p, t: replay.complete(p, t, GAMMA, GOALS))(pending, now)
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
            np.testing.assert_array_equal(got.trail[t, b, :k], 10 * ticks.final_obs[first : t + 1, b])
            done = ticks.terminated[:t, b] | ticks.truncated[:t, b]
            assert (got.ticks[t, b], got.episode[t, b]) == (k, done.sum())
            checked += 1
    assert checked >= 5 * 4 * B / length and (ticks.terminated | ticks.truncated).any()


def rows(first: int, count: int, b: int, episode=0.0) -> Transition:
    """Return transitions [count, b] whose entries are their number, from `first` on."""
    x = jnp.arange(first, first + count * b, dtype=jnp.float32).reshape(count, b)
    trail, ones = jnp.stack([x, x + 0.5], axis=-1)[..., None], jnp.ones_like(x)
    return Transition(
        x[..., None], x[..., None] + 0.1, x + 0.2, x + 0.3, x[..., None] + 0.4, trail, 2 * ones, episode * ones
    )


LIKE = replay.init_pending(3, 1, D, 2, 1)


def test_the_buffer_keeps_the_newest_chosen_transitions_of_each_environment():
    buffer, chosen = replay.init(21, LIKE), np.random.default_rng(0).random((9, 2, 3)) < 0.7
    kept: list[list[float]] = [[], [], []]
    add = jax.jit(replay.add)
    for round_, which in enumerate(chosen):
        buffer = add(buffer, rows(6 * round_, 2, 3), which)
        for t, b in np.argwhere(which):
            kept[b].append(6 * round_ + 3 * t + b)
        for b in range(3):
            newest = np.full(7, np.nan)
            for place, number in enumerate(kept[b]):
                newest[place % 7] = number
            filled = ~np.isnan(newest)
            assert buffer.count[b] == len(kept[b])
            np.testing.assert_allclose(buffer.rows[b, filled, 0], newest[filled])
            offsets = buffer.rows[b, filled] - buffer.rows[b, filled, :1]
            np.testing.assert_allclose(offsets[:, :5], [[0, 0.1, 0.2, 0.3, 0.4]] * filled.sum(), atol=1e-5)
            assert not buffer.rows[b, ~filled].any()
    assert min(map(len, kept)) > 7


def test_samples_are_uniform_over_the_rows_that_are_filled():
    sample = jax.jit(lambda buffer, key: replay.sample(buffer, key, 6000, LIKE)[0])
    for count in (3, 5, 9):
        chosen = jnp.ones((count, 3), bool).at[1:, 1].set(False)  # the second environment has one transition
        buffer = replay.add(replay.init(15, LIKE), rows(0, count, 3), chosen)
        batch = sample(buffer, jax.random.key(0))
        values, counts = np.unique(batch.obs, return_counts=True)
        expected = [[3 * t + b for t in range(count)][-5:] for b in (0, 2)]
        np.testing.assert_array_equal(values, sorted([1, *expected[0], *expected[1]]))
        assert counts.min() > 0.8 * 6000 / len(values)
        for name, offset in (("option", 0.1), ("reward", 0.2), ("discount", 0.3), ("next_obs", 0.4)):
            np.testing.assert_allclose(np.ravel(getattr(batch, name)) - np.ravel(batch.obs), offset, atol=1e-5)


def test_the_later_transition_is_of_the_same_environment_and_episode_and_at_most_the_horizon_later():
    buffer = replay.init(3 * 40, LIKE)
    for episode in range(8):
        buffer = replay.add(buffer, rows(300 * episode, 8, 3, episode=float(episode)), jnp.ones((8, 3), bool))
    batch, later = jax.jit(lambda key: replay.sample(buffer, key, 20000, LIKE, horizon=5))(jax.random.key(0))
    leap = (later.obs - batch.obs)[:, 0] / 3
    np.testing.assert_array_equal(batch.episode, later.episode)
    assert set(leap.tolist()) == {0, 1, 2, 3, 4, 5}
    first = batch.obs[:, 0] % 300 < 3  # of an episode: every leap is possible
    counts = np.unique(leap[first], return_counts=True)[1]
    assert counts.min() > 0.8 * counts.mean()
    assert set(np.asarray(batch.episode).tolist()) == {3.0, 4.0, 5.0, 6.0, 7.0}


def test_a_relabelled_transition_has_the_rewards_for_the_goal_achieved_later():
    trail = jnp.array([[[0.0], [10], [20], [30]]])
    batch = Transition(*(jnp.array(x)[None] for x in ([1.0], [0.5], 7.0, 0.1, [2.0])), trail, *jnp.full((2, 1), 3.0))
    later = batch.replace(trail=trail + 20.0, ticks=jnp.full(1, 2.0))  # it achieved 30 at its end
    relabelled = jax.jit(lambda batch, later: replay.relabelled(batch, later, GAMMA, GOALS))
    got = relabelled(batch, later)
    np.testing.assert_allclose(got.reward, [-30 - GAMMA * 20 - GAMMA**2 * 10], rtol=1e-5)
    np.testing.assert_allclose(got.discount, [GAMMA**3], rtol=1e-5)
    np.testing.assert_allclose([got.obs, got.next_obs], [[[30001.0]], [[30002.0]]])
    got = relabelled(batch, batch.replace(ticks=jnp.full(1, 2.0)))  # its own second tick, which ends it
    np.testing.assert_allclose(got.reward, [-10.0], rtol=1e-5)
    assert got.discount == 0.0 and got.option == 0.5


def test_a_row_has_the_numbers_that_plans_of_memory_count():
    observation_size, option_size, length, goal_size = 5, 2, 3, 4
    pending = replay.init_pending(B, observation_size, option_size, length, goal_size)
    size = replay.row_size(observation_size, option_size, length, goal_size)
    assert replay.init(30, pending).rows.shape == (B, 10, size)
