"""Soft actor-critic over decisions: its losses by hand, its bookkeeping, and tasks whose answer is known."""

import dataclasses
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from point_maze import PointMaze
from probes import Constant, Counting, Observed, OneOf, Repeat, Sign, TwoStep, draw
from scipy import stats

import taic_jax as taic
from taic_jax.config import SACConfig
from taic_jax.networks import Critics, SquashedPolicy
from taic_jax.options.execution import IdentityExecutor
from taic_jax.rl import sac
from taic_jax.rl.replay import Transition
from taic_jax.types import as_arrays

CONFIG = SACConfig(
    num_envs=8, rollout_length=16, update_every=2, warmup=256, capacity=4096, batch_size=64, hidden_sizes=(32, 32),
    learning_rate=3e-3, temperature=1e-3, tau=0.05,
)  # fmt: skip
FLAT, S, D, M = IdentityExecutor(1), 3, 2, 16


def test_options_are_drawn_from_the_squashed_policy():
    rng, policy = np.random.default_rng(0), SquashedPolicy(D, (4,))
    params = policy.init(jax.random.key(0), S, 3.0)
    params = params.replace(actor=jax.tree.map(lambda x: 0.4 * draw(rng, *x.shape), params.actor))
    obs, noise = draw(rng, M, S), draw(rng, M, D)
    mean, _ = policy.draw(params, obs, 0.0, noise)
    one, density = policy.draw(params, obs, 1.0, noise)
    half, _ = policy.draw(params, obs, 0.5, noise)
    loc, before = (np.arctanh(np.asarray(x, float) / 3) for x in (mean, one))
    scale = (before - loc) / np.asarray(noise)
    assert (scale > 0).all() and np.std(scale) > 0.1  # it depends on the state
    np.testing.assert_allclose(np.arctanh(np.asarray(half, float) / 3), loc + 0.5 * scale * noise, rtol=1e-2, atol=1e-3)
    log_prob = stats.norm.logpdf(before, loc, scale) - np.log(1 - np.tanh(before) ** 2)
    np.testing.assert_allclose(density, log_prob.sum(axis=1), rtol=1e-2, atol=1e-2)


@pytest.fixture
def learnt():
    """Return what is learnt with random parameters of every network, a batch, and noise."""
    rng, config = np.random.default_rng(1), as_arrays(dataclasses.replace(CONFIG, hidden_sizes=(4,), temperature=0.5))
    policy, critics = SquashedPolicy(D, (4,)), Critics((4,), layer_norm=True)
    actor, params = policy.init(jax.random.key(0), S, 3.0), critics.init(jax.random.key(1), S, D)
    scatter = partial(jax.tree.map, lambda x: draw(rng, *x.shape))
    values = actor.replace(actor=scatter(actor.actor)), scatter(params), jnp.log(0.5), scatter(params)
    more = jnp.zeros((M, 1, 0)), jnp.ones(M), jnp.zeros(M)
    batch = Transition(draw(rng, M, S), draw(rng, M, D), draw(rng, M), jnp.abs(draw(rng, M)), draw(rng, M, S), *more)
    return config, policy, critics, sac.Learnt(*values, None), batch, draw(rng, 2, M, D)


@pytest.mark.parametrize("pessimism", [1.0, 0.25])
def test_the_target_is_semi_markov_and_the_gradients_of_the_three_losses_do_not_mix(learnt, pessimism):
    config, policy, critics, learnt, batch, noise = learnt
    config = as_arrays(dataclasses.replace(config, pessimism=pessimism))

    def both(values):
        return pessimism * values.min(axis=0) + (1 - pessimism) * values.mean(axis=0)

    target = sac.semi_markov_target(config, policy, critics, learnt, 0.5, batch, noise[0])
    option, log_prob = policy.draw(learnt.policy, batch.next_obs, 1.0, noise[0])
    value = both(critics.values(learnt.targets, batch.next_obs, option / 3)) - 0.5 * log_prob
    np.testing.assert_allclose(target, batch.reward + batch.discount * value, rtol=1e-4)

    def critic_loss(params):
        errors = critics.values(params, batch.obs, batch.option / 3) - target[None]
        return jnp.mean(errors[0] ** 2) + jnp.mean(errors[1] ** 2)

    def actor_loss(actor):
        option, log_prob = policy.draw(learnt.policy.replace(actor=actor), batch.obs, 1.0, noise[1])
        return jnp.mean(0.5 * log_prob - both(critics.values(learnt.critics, batch.obs, option / 3)))

    params = learnt.policy.actor, learnt.critics, learnt.log_temperature
    got, terms = jax.grad(sac.sac_loss, has_aux=True)(params, config, Repeat(3, D), learnt, batch, noise)
    expected = jax.grad(actor_loss)(params[0]), jax.grad(critic_loss)(params[1])
    for x, y in zip(jax.tree.leaves(got[:2]), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-5)
    _, log_prob = policy.draw(learnt.policy, batch.obs, 1.0, noise[1])
    np.testing.assert_allclose(got[2], -(log_prob.mean() - D), rtol=1e-4)  # falls while the entropy exceeds -D
    np.testing.assert_allclose(terms[:2], [critic_loss(params[1]), actor_loss(params[0])], rtol=1e-4)
    np.testing.assert_allclose(terms[3:], [-log_prob.mean(), 0.5], rtol=1e-4)


def test_targets_follow_the_critics_and_the_step_is_adams_first(learnt):
    config, _, _, learnt, batch, _ = learnt
    params = learnt.policy.actor, learnt.critics, learnt.log_temperature
    learnt = learnt.replace(optimizer=sac.make_optimizer().init(params))
    after, _ = sac.update(dataclasses.replace(config, batch_size=M), Repeat(3, D), learnt, batch, jax.random.key(0))
    for old, target, new, critic in zip(
        *(jax.tree.leaves(x) for x in (learnt.targets, learnt.critics, after.targets, after.critics)), strict=True
    ):
        np.testing.assert_allclose(new, 0.95 * old + 0.05 * critic, rtol=1e-4, atol=1e-6)
        assert np.abs(critic - target).max() <= 3e-3 * 1.001
    np.testing.assert_allclose(abs(after.log_temperature - learnt.log_temperature), 3e-3, rtol=1e-3)
    assert after.policy.bound == 3.0


def test_the_prior_weight_takes_the_place_of_the_temperature(learnt):
    config, policy, _, learnt, batch, noise = learnt
    option, log_prob = policy.draw(learnt.policy, batch.obs, 1.0, noise[1])
    np.testing.assert_allclose(sac.cost(config, 3.0, 0.5, option, log_prob), 0.5 * log_prob, rtol=1e-5)
    near = as_arrays(dataclasses.replace(config, prior_weight=0.2))
    prior = stats.norm.logpdf(np.asarray(option, float)).sum(axis=1)
    density = np.asarray(log_prob, float) - D * np.log(3)  # of the option itself
    np.testing.assert_allclose(
        sac.cost(near, 3.0, 0.5, option, log_prob), 0.2 * (density - prior), rtol=1e-3, atol=1e-4
    )


def train(env, executor, ticks: int, **changes):
    config = dataclasses.replace(CONFIG, **changes)
    run = jax.jit(partial(taic.train, config, env, executor, ticks=ticks))
    return run(jax.random.key(0))


@pytest.mark.parametrize("every", [0.0, 0.5, 2.0])
def test_the_number_of_gradient_steps_is_that_of_decisions_after_the_warm_up(every, monkeypatch):
    """Adam's own count of steps is the witness; three ticks an option leave a rest in each round."""
    config, env, executor = as_arrays(dataclasses.replace(CONFIG, updates_per_decision=every)), Counting(5), Repeat(3)
    step = jax.jit(partial(sac.iterate, config, env, executor, 5))
    state, ended, learnt_from = sac.init(config, env, executor, jax.random.key(0)), 0, 0
    for iteration in range(5):
        state, _, ticks = step(state)
        ended += int(ticks.ended.sum())
        learnt_from += int(ticks.ended.sum()) if iteration * 128 >= CONFIG.warmup else 0
        assert state.replay.count.sum() == ended
        assert int(state.learnt.optimizer.count) == math.floor(every * learnt_from + 1e-3)
    assert learnt_from > 100


@pytest.mark.parametrize("decays", [False, True])
def test_the_step_size_decays_to_zero_over_the_stage(decays):
    """By the first critics' change in Adam's first step, which is the step size: half of it half-way, then none."""
    config = as_arrays(dataclasses.replace(CONFIG, warmup=0, updates_per_decision=0.05, learning_rate_decay=decays))
    env, changes = Counting(5), []
    for iteration in (0, 2, 4):
        state = sac.init(config, env, Repeat(3), jax.random.key(0)).replace(iteration=jnp.int32(iteration))
        after = sac.iterate(config, env, Repeat(3), 4, state)[0]
        assert int(after.learnt.optimizer.count) > 0
        leaves = zip(*(jax.tree.leaves(x.learnt.critics) for x in (state, after)), strict=True)
        changes.append(max(float(jnp.abs(a - b).max()) for a, b in leaves))
    first, half, none = changes
    assert first > 0 and half == pytest.approx(0.5 * first if decays else first, rel=0.1)
    assert none == (0.0 if decays else pytest.approx(first, rel=0.1))


def test_options_are_uniform_before_the_warm_up_is_over():
    config, env = as_arrays(dataclasses.replace(CONFIG, num_envs=64)), Counting(5)
    state = sac.init(config, env, Repeat(3), jax.random.key(0))
    step = jax.jit(partial(sac.iterate, config, env, Repeat(3), 5))
    state, _, ticks = step(state)
    drawn = np.asarray(ticks.option)[np.asarray(ticks.decision)]
    assert stats.kstest(drawn[:, 0], stats.uniform(-3, 6).cdf).pvalue > 0.01
    _, _, ticks = step(state)
    drawn = np.asarray(ticks.option)[np.asarray(ticks.decision)]
    assert stats.kstest(drawn[:, 0], stats.uniform(-3, 6).cdf).pvalue < 1e-6


@pytest.mark.parametrize("relabel", [0, 4])
def test_statistics_see_the_goals_of_hindsight(relabel):
    config, env, executor = as_arrays(dataclasses.replace(CONFIG, relabel=relabel)), PointMaze(), Repeat(3, 2)
    state = sac.init(config, env, executor, jax.random.key(0))
    state, _, ticks = jax.jit(partial(sac.iterate, config, env, executor, 5))(state)
    goals = [ticks.obs[..., 2:], ticks.final_obs[..., :2]] if relabel else [ticks.obs[..., 2:]]
    np.testing.assert_allclose(state.obs_statistics.mean[2:], np.mean(goals, axis=(0, 1, 2)), atol=1e-5)
    np.testing.assert_allclose(state.obs_statistics.std[2:], np.std(goals, axis=(0, 1, 2)), rtol=1e-3, atol=1e-5)


def test_values_of_tasks_whose_answer_is_known():
    """V is 1, x, and gamma then 1; the greedy action has the sign of x."""
    env = OneOf(Constant(), Observed(), TwoStep(), Sign())
    agent, metrics = train(env, FLAT, 8192)
    assert metrics["critic_loss"][-1] < 0.02
    assert abs(metrics["value"][-1] - np.mean([1.0, 0.0, 0.99, 1.0])) < 0.25
    for x in (-1.0, 1.0):
        obs = jnp.array([0.0, 0.0, 0.0, 1.0, x])
        _, action, _ = agent.act(agent.start(obs), obs)
        assert np.sign(action[0]) == x


@pytest.mark.parametrize("scale", [1.0, 0.2])
def test_an_option_of_two_ticks_is_worth_the_discounted_and_scaled_reward_of_its_second(scale):
    config = as_arrays(dataclasses.replace(CONFIG, gamma=0.5, reward_scale=scale))
    env, executor = TwoStep(), Repeat(2)
    step = jax.jit(partial(sac.iterate, config, env, executor, 12))
    state = sac.init(config, env, executor, jax.random.key(0))
    for _ in range(12):
        state, metrics, _ = step(state)
    obs = (0.0 - state.obs_statistics.mean) / state.obs_statistics.std
    values = sac.make_critics(config).values(state.learnt.critics, obs[None], jnp.zeros((1, 1)))
    np.testing.assert_allclose(values, 0.5 * scale, atol=0.03)
    assert metrics["duration"] == 2.0


def test_keys_may_be_vmapped():
    config = dataclasses.replace(CONFIG, warmup=0, rollout_length=4)
    run = partial(taic.train, config, Sign(), FLAT, ticks=64)
    keys = jax.random.split(jax.random.key(0), 2)
    together = jax.jit(jax.vmap(run))(keys)[1]["value"]
    for k in range(2):
        np.testing.assert_allclose(together[k], jax.jit(run)(keys[k])[1]["value"], rtol=1e-4, atol=1e-5)
    assert np.abs(together[0] - together[1]).max() > 1e-4
