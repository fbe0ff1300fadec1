"""Options in lockstep ticks: when the policy decides, what runs between, and what is carried over."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import Counting, Repeat, assert_trees_equal

from taic_jax.envs import AutoReset, TimeLimit
from taic_jax.options.execution import IdentityExecutor
from taic_jax.rl.rollout import Rollout, RolloutCarry, count_durations, rollout, start

B, N, END = 4, 3, 7


def draw(obs: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draw options from N(0, 1), many of them outside the bounds of an action."""
    return noise, noise[:, 0]


def look(obs: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Take the observation as option, so that nothing depends on how the noise was drawn."""
    return 0.1 * obs, obs[:, 0]


def run(env, executor, decide, *lengths: int) -> tuple[RolloutCarry, list[Rollout]]:
    """Run successive rollouts and keep the metrics of the state after each tick."""
    env, rollouts = AutoReset(env), []
    running = start(env, executor, B, jax.random.key(0))
    for length in lengths:
        step = jax.jit(partial(rollout, env, executor, decide, length=length, keep=_metrics))
        running, ticks = step(running, jax.random.key(1))
        rollouts.append(jax.device_get(ticks))
    return jax.device_get(running), rollouts


def _metrics(state):
    return state.metrics


@pytest.fixture(scope="module")
def counted() -> tuple[RolloutCarry, Rollout]:
    """Options of 3 ticks in episodes of 7 ticks or fewer."""
    running, (ticks,) = run(Counting(END, truncated=True, spread=5), Repeat(N), draw, 25)
    return running, ticks


def test_options_end_after_their_ticks_or_with_the_episode(counted):
    _, ticks = counted
    done = ticks.terminated | ticks.truncated
    for b in range(B):
        ran = 0
        for t in range(len(done)):
            assert ticks.decision[t, b] == (ran == 0)
            ran += 1
            assert ticks.ended[t, b] == (ran == N or done[t, b])
            ran = 0 if ticks.ended[t, b] else ran
    durations = [np.diff(np.flatnonzero(ticks.decision[:, b])) for b in range(B)]
    assert {k for d in durations for k in d} == {1, 2, N}  # whole options, and options that an episode's end cut


def test_the_action_is_that_of_the_option_decided_on_last(counted):
    _, ticks = counted
    for b in range(B):
        for t in range(len(ticks.decision)):
            decided = max(i for i in range(t + 1) if ticks.decision[i, b])
            np.testing.assert_array_equal(ticks.action[t, b], np.clip(ticks.option[decided, b], -1.0, 1.0))
    assert np.abs(ticks.option).max() > 1.0  # so that the clipping was seen
    np.testing.assert_array_equal(ticks.log_prob, ticks.option[..., 0])


def test_episodes_follow_each_other(counted):
    """The tick that ends an episode keeps its observation in `final_obs`; the next tick sees the new episode's."""
    _, ticks = counted
    done, x = ticks.truncated, ticks.obs[..., 0]
    assert not ticks.terminated.any() and done.sum(axis=0).min() >= 2
    np.testing.assert_array_equal(ticks.final_obs[..., 0], x + 1)
    np.testing.assert_array_equal(ticks.reward, x + 1)
    np.testing.assert_array_equal(ticks.final_obs[..., 0] == END, done)
    np.testing.assert_array_equal(x[1:][~done[:-1]], ticks.final_obs[:-1, :, 0][~done[:-1]])
    assert (x[1:][done[:-1]] < 5).all() and len(np.unique(x[1:][done[:-1]])) > 1  # fresh starts differ


def test_extras_are_of_the_state_after_the_tick(counted):
    _, ticks = counted
    np.testing.assert_array_equal(ticks.extras["last"], ticks.final_obs[..., 0])


def test_returns_add_up_per_episode(counted):
    running, ticks = counted
    for b in range(B):
        total, last = 0.0, np.nan
        for t in range(len(ticks.reward)):
            total += ticks.reward[t, b]
            assert ticks.episode_return[t, b] == total
            total, last = (0.0, total) if ticks.truncated[t, b] else (total, last)
        np.testing.assert_array_equal([running.episode_return[b], running.last_return[b]], [total, last])


def test_no_return_before_an_episode_is_over():
    running, _ = run(Counting(END), Repeat(N), look, END - 1)
    assert np.isnan(running.last_return).all() and (running.episode_return == 21).all()


def test_staggered_episodes_end_at_different_ticks_and_the_first_have_no_return():
    env = AutoReset(TimeLimit(Counting(1000), 40))
    running = start(env, Repeat(N), 16, jax.random.key(0), stagger=True)
    first = np.asarray(running.env.tick)
    assert first.min() >= 0 and first.max() < 40 and len(set(first.tolist())) > 8
    _, ticks = jax.jit(partial(rollout, env, Repeat(N), look, length=90))(running, jax.random.key(1))
    for b, tick in enumerate(first):
        np.testing.assert_array_equal(np.flatnonzero(ticks.truncated[:, b]), np.arange(39 - tick, 90, 40))
    done, total = np.asarray(ticks.truncated), np.asarray(ticks.episode_return)
    whole = np.cumsum(done, axis=0) > 1
    assert (total[done & whole] == 40 * 41 / 2).all() and np.isnan(
        total[:, first > 0][~whole[:, first > 0] & done[:, first > 0]]
    ).all()


def test_two_rollouts_equal_one():
    """A running option, its decision long past, carries over."""
    env, executor = Counting(END, spread=5), Repeat(N)
    one_running, (one,) = run(env, executor, look, 15)
    two_running, parts = run(env, executor, look, 5, 10)
    assert_trees_equal(one_running, two_running)
    joined = jax.tree.map(lambda *x: np.concatenate(x), *parts)
    assert_trees_equal(one.replace(noise=None), joined.replace(noise=None))  # which `look` does not read
    assert not parts[1].decision[0].all()


@pytest.mark.parametrize("at_once", [1, 3, 9])
def test_options_that_begin_a_few_environments_at_a_time_are_those_that_begin_together(at_once):
    env = Counting(END, spread=5)
    runs = [run(env, Repeat(N, noise_size=1, at_once=few), draw, 200) for few in (0, at_once)]
    (running, (ticks,)), (few_running, (few_ticks,)) = runs
    assert set(ticks.decision.sum(axis=1)) == set(range(B + 1))  # from no decision in a tick to all
    assert_trees_equal(running, few_running)
    assert_trees_equal(ticks, few_ticks)


def test_flat_control_decides_at_every_tick_and_takes_one_step_in_each():
    running, (ticks,) = run(Counting(), IdentityExecutor(1), draw, 9)
    assert ticks.decision.all() and ticks.ended.all() and ticks.reward.shape == (9, B)
    np.testing.assert_array_equal(running.env.physics, np.full(B, 9.0))
    np.testing.assert_array_equal(ticks.action, np.clip(ticks.option, -1.0, 1.0))
    np.testing.assert_array_equal(ticks.noise, ticks.option)
    _, (of_one_tick,) = run(Counting(), Repeat(1), draw, 9)
    assert_trees_equal(ticks, of_one_tick)


def recorded(noise_size: int, decide=draw) -> tuple[Repeat, Rollout]:
    """Run options of at most 3 ticks in episodes of 7 or fewer, with or without noise that ends them early."""
    executor = Repeat(N, noise_size=noise_size)
    _, (ticks,) = run(Counting(END, truncated=True, spread=5), executor, decide, 25)
    return executor, ticks


@pytest.mark.parametrize("noise_size", [0, 1])
def test_durations_are_counted_where_options_end(noise_size):
    _, ticks = recorded(noise_size)
    where = np.arange(25)[:, None] < np.array([25, 10, 3, 0])
    for shown, among in ((True, np.ones((25, B), bool)), (where, where)):
        expected = np.zeros(N)
        for b in range(B):
            ran = 0
            for t in range(25):
                ran = 1 if ticks.decision[t, b] else ran + 1
                assert ticks.duration[t, b] == ran
                expected[ran - 1] += ticks.ended[t, b] and among[t, b]
        counts = count_durations(ticks, N, shown if shown is True else jnp.asarray(shown))
        np.testing.assert_array_equal(counts, expected)
        assert counts.dtype == np.float32 and expected.all()


def test_noise_ends_options_early_and_is_not_the_policys():
    """The executor's numbers come after the option's, fresh at every tick and in every environment."""
    _, ticks = recorded(1)
    noise = np.asarray(jax.random.normal(jax.random.key(1), (25, B, 2)))
    done = ticks.truncated
    np.testing.assert_array_equal(ticks.option, noise[..., :1])
    np.testing.assert_array_equal(ticks.ended, (noise[..., 1] > 0) | (ticks.duration == N) | done)
    early = ticks.ended & (ticks.duration < N) & ~done
    assert early.sum() > 10 and (~ticks.ended).sum() > 10
    assert (noise[..., 0] > 0)[early].any() and (noise[..., 0] < 0)[early].any()


def test_without_noise_the_policy_draws_as_it_did(counted):
    _, ticks = counted
    np.testing.assert_array_equal(ticks.option, jax.random.normal(jax.random.key(1), (25, B, 1)))
    assert_trees_equal(recorded(0)[1], ticks)
