"""Double DQN and the policies over discrete options: draws, target and step by hand, and tasks of known answers."""

import dataclasses
from functools import partial

import distrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import TwoStep, draw
from scipy import special, stats

import taic_jax as taic
from taic_jax.config import DQNConfig, PPOConfig
from taic_jax.envs import Env, State, TimeLimit
from taic_jax.networks import CategoricalPolicy, GreedyPolicy, Policy, gumbel
from taic_jax.options.execution import IdentityExecutor
from taic_jax.rl import dqn
from taic_jax.rl.replay import Transition
from taic_jax.rl.update import Decisions, ppo_loss
from taic_jax.types import as_arrays

CONFIG = DQNConfig(
    num_envs=8, rollout_length=16, update_every=2, warmup=256, capacity=4096, batch_size=64, hidden_sizes=(32, 32),
    learning_rate=3e-3, tau=0.05, epsilon_steps=500.0,
)  # fmt: skip
PPO = PPOConfig(num_envs=8, rollout_length=16, minibatch_size=32, learning_rate=3e-3)
S, D, M = 3, 4, 16
WIDTH = 5


class Corridor(Env):
    """Cells in a row, begun in the middle: left, stay or right; 1 at the right end, 0.1 at the left, then the end."""

    name = proprioception = "corridor"
    observation_size = proprioceptive_size = WIDTH
    action_size, discrete = 3, True
    episode_length, dt = 20, 1.0

    def reset(self, key):
        """Begin in the middle."""
        return State.first(jnp.array(WIDTH // 2), jax.nn.one_hot(WIDTH // 2, WIDTH), {})

    def step(self, state, action):
        """Move by one cell."""
        cell = jnp.clip(state.physics + jnp.argmax(action) - 1, 0, WIDTH - 1)
        reward = jnp.where(cell == WIDTH - 1, 1.0, jnp.where(cell == 0, 0.1, 0.0))
        obs = jax.nn.one_hot(cell, WIDTH)
        return state.replace(physics=cell, obs=obs, reward=reward, terminated=reward > 0.0)

    def render(self, physics, *, height=240, width=320):
        """Draw nothing."""
        return np.zeros((len(physics), height, width, 3), np.uint8)


@pytest.fixture
def learnt():
    """Return what is learnt with random parameters, and a batch of one-hot options."""
    rng, policy = np.random.default_rng(1), GreedyPolicy(D, (4,), layer_norm=True)
    params = policy.init(jax.random.key(0), S, 1.0)
    values, targets = (jax.tree.map(lambda x: draw(rng, *x.shape), params.values) for _ in range(2))
    more = jnp.zeros((M, 1, 0)), jnp.ones(M), jnp.zeros(M)
    option = jax.nn.one_hot(rng.integers(0, D, M), D)
    batch = Transition(draw(rng, M, S), option, draw(rng, M), jnp.abs(draw(rng, M)), draw(rng, M, S), *more)
    optimizer = dqn.make_optimizer().init(values)
    return policy, dqn.Learnt(params.replace(values=values), targets, optimizer), batch


def test_random_options_are_as_many_as_epsilon_says_and_uniform(learnt):
    policy, learnt, _ = learnt
    params = learnt.policy.replace(epsilon=jnp.array(0.4))
    noise = jax.random.normal(jax.random.key(0), (20_000, D))
    obs = jnp.broadcast_to(draw(np.random.default_rng(0), S), (len(noise), S))
    best = int(jnp.argmax(policy.evaluate(params.values, obs[0])))
    option, log_prob = policy.draw(params, obs, 1.0, noise)
    share = np.full(D, 0.1) + 0.6 * (np.arange(D) == best)
    assert stats.chisquare(option.sum(axis=0), share * len(noise)).pvalue > 0.01
    np.testing.assert_allclose(log_prob, np.log(np.asarray(option) @ share), rtol=1e-5)
    assert (policy.draw(params, obs, 0.0, noise)[0][:, best] == 1.0).all()
    assert stats.chisquare(policy.uniform(params, noise).sum(axis=0)).pvalue > 0.01


def test_a_categorical_policy_draws_by_its_probabilities():
    rng, policy = np.random.default_rng(0), CategoricalPolicy(D, (4,))
    params = policy.init(jax.random.key(0), S, 0.0)
    params = params.replace(actor=jax.tree.map(lambda x: draw(rng, *x.shape), params.actor))
    obs = jnp.broadcast_to(draw(rng, S), (20_000, S))
    noise = jax.random.normal(jax.random.key(0), (20_000, D))
    option, log_prob = policy.draw(params, obs, 1.0, noise)
    distribution = policy.distribution(params, obs)
    probs = np.asarray(distribution.probs[0], float)
    assert stats.chisquare(option.sum(axis=0), probs / probs.sum() * len(obs)).pvalue > 0.01
    np.testing.assert_allclose(log_prob, np.log(np.asarray(option) @ probs), rtol=1e-5)
    assert (policy.draw(params, obs, 0.0, noise)[0][:, probs.argmax()] == 1.0).all()
    np.testing.assert_allclose(policy.divergence(distribution)[0], stats.entropy(probs, np.full(D, 1 / D)), rtol=1e-3)


def test_gumbel_numbers_are_gumbel_even_far_from_the_middle():
    noise = jax.random.normal(jax.random.key(0), (20_000,))
    assert stats.kstest(gumbel(noise), stats.gumbel_r.cdf).pvalue > 0.01
    far = jnp.array([-9.0, 9.0])
    np.testing.assert_allclose(gumbel(far), -np.log(-special.log_ndtr(np.asarray(far, float))), rtol=1e-5)


def test_the_divergence_of_a_gaussian_policy_is_from_the_standard_normal():
    policy = Policy(2, (4,))
    normal = distrax.MultivariateNormalDiag(jnp.array([1.0, -2.0]), jnp.array([0.5, 2.0]))
    expected = sum((s**2 + m**2 - 1) / 2 - np.log(s) for m, s in ((1.0, 0.5), (-2.0, 2.0)))
    np.testing.assert_allclose(policy.divergence(normal), expected, rtol=1e-5)


@pytest.mark.parametrize("prior_weight", [0.0, 0.3])
def test_the_prior_weight_is_that_of_the_divergence(prior_weight):
    rng, policy = np.random.default_rng(0), CategoricalPolicy(D, (4,))
    params = policy.init(jax.random.key(0), S, 0.0)
    params = params.replace(actor=jax.tree.map(lambda x: draw(rng, *x.shape), params.actor))
    batch = Decisions(draw(rng, M, S), jax.nn.one_hot(rng.integers(0, D, M), D), *(draw(rng, M) for _ in range(3)))
    weight = jnp.full(M, 1 / M)
    with_prior, without = (
        ppo_loss(params, policy, batch, weight, as_arrays(PPOConfig(prior_weight=w)))[0] for w in (prior_weight, 0.0)
    )
    divergence = jnp.mean(policy.divergence(policy.distribution(params, batch.obs)))
    np.testing.assert_allclose(with_prior - without, prior_weight * divergence, rtol=1e-2, atol=1e-5)


def test_the_target_is_double_and_semi_markov(learnt):
    policy, learnt, batch = learnt
    target = dqn.double_target(learnt.policy.values, policy, learnt.targets, batch)
    best = np.argmax(policy.evaluate(learnt.policy.values, batch.next_obs), axis=1)
    after = np.asarray(policy.evaluate(learnt.targets, batch.next_obs))
    assert (best != after.argmax(axis=1)).any()  # else it may be a plain one
    np.testing.assert_allclose(target, batch.reward + batch.discount * after[np.arange(M), best], rtol=1e-4)

    def loss(values):
        chosen = policy.evaluate(values, batch.obs)[np.arange(M), np.argmax(batch.option, axis=1)]
        return jnp.mean(jnp.square(chosen - target))

    got, terms = jax.grad(dqn.dqn_loss, has_aux=True)(learnt.policy.values, policy, batch, target)
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(jax.grad(loss)(learnt.policy.values)), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(terms[0], loss(learnt.policy.values), rtol=1e-4)
    config = as_arrays(dataclasses.replace(CONFIG, hidden_sizes=(4,)))
    _, terms = dqn.update(config, IdentityExecutor(D, discrete=True), learnt, batch, jax.random.key(0))
    np.testing.assert_allclose(terms[0], loss(learnt.policy.values), rtol=1e-4)


def test_targets_follow_the_values_and_epsilon_falls_to_its_end(learnt):
    _, learnt, batch = learnt
    config = as_arrays(dataclasses.replace(CONFIG, epsilon=0.5, epsilon_steps=2.0, hidden_sizes=(4,)))
    executor = IdentityExecutor(D, discrete=True)
    for epsilon in (1.0, 0.75, 0.5, 0.5):
        after, terms = dqn.update(config, executor, learnt, batch, jax.random.key(0))
        assert terms[-1] == epsilon
        for old, new, value in zip(
            *(jax.tree.leaves(x) for x in (learnt.targets, after.targets, after.policy.values)), strict=True
        ):
            np.testing.assert_allclose(new, 0.95 * old + 0.05 * value, rtol=1e-4, atol=1e-6)
        learnt = after


@pytest.mark.parametrize("settings", [CONFIG, PPO])
def test_learns_the_way_to_the_greater_reward(settings):
    env = TimeLimit(Corridor(), Corridor.episode_length)
    train = jax.jit(partial(taic.train, settings, env, IdentityExecutor(3, discrete=True), ticks=8192))
    agent, metrics = train(jax.random.key(0))
    for cell in (2, 3):  # those on the way
        obs = jax.nn.one_hot(cell, WIDTH)
        _, action, _ = agent.act(agent.start(obs), obs)
        assert (action == jax.nn.one_hot(2, 3)).all()
    assert metrics["return"][-1] > 0.8


def test_a_held_option_is_worth_the_discounted_reward_of_its_end():
    config = as_arrays(dataclasses.replace(CONFIG, gamma=0.5))
    env, executor = TwoStep(), IdentityExecutor(1, length=2, discrete=True)
    step = jax.jit(partial(dqn.iterate, config, env, executor, 12))
    state = dqn.init(config, env, executor, jax.random.key(0))
    for _ in range(12):
        state, metrics, _ = step(state)
    obs = (0.0 - state.obs_statistics.mean) / state.obs_statistics.std
    values = dqn.make_policy(executor, config).evaluate(state.learnt.policy.values, obs[None])
    np.testing.assert_allclose(values, 0.5, atol=0.03)
    assert metrics["duration"] == 2.0
