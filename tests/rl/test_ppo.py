"""PPO over decisions: its loss by hand, its bookkeeping against plain code, and tasks whose answer is known."""

import dataclasses
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import NO, YES, Constant, Counting, Observed, OneOf, Probe, Repeat, Sign, TwoStep, assert_trees_equal
from scipy import stats

from taic_jax.config import PPOConfig
from taic_jax.envs import Navigation, TimeLimit
from taic_jax.networks import Policy, PolicyParams
from taic_jax.nonfinite import QUANTITIES
from taic_jax.options.execution import IdentityExecutor
from taic_jax.rl import learner, normalize, ppo, update
from taic_jax.rl.agent import Agent
from taic_jax.rl.returns import Judgement, semi_markov_advantages
from taic_jax.rl.rollout import Rollout
from taic_jax.types import as_arrays

ENV, EXECUTOR = Counting(7, truncated=True, spread=5), Repeat(3)
ITERATIONS = 4
ONE_STEP = PPOConfig(
    num_envs=4, rollout_length=16, epochs=1, minibatch_size=64, hidden_sizes=(4,), learning_rate=0.01,
    entropy_weight=0.01, normalize_reward=False,
)  # fmt: skip


def test_loss_by_hand():
    policy = Policy(1, (2,))
    # All weights zero: mean option 0, standard deviation 1, value 0.
    shapes = jax.eval_shape(lambda: policy.init(jax.random.key(0), 1, jnp.zeros(())))
    params = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), shapes)
    ratio = jnp.array([1.5, 1.5, 0.5, 0.5, 1.1])
    advantage = jnp.array([2.0, -2.0, 2.0, -2.0, 1.0])
    option = jnp.array([[0.0], [1.0], [2.0], [-1.0], [0.5]])
    log_prob = -0.5 * option[:, 0] ** 2 - 0.5 * math.log(2 * math.pi)
    decisions = update.Decisions(jnp.zeros((5, 1)), option, log_prob - jnp.log(ratio), advantage, jnp.arange(5.0))
    config = as_arrays(PPOConfig(clip=0.2, value_weight=0.5, entropy_weight=0.1))
    loss, terms = jax.jit(update.ppo_loss, static_argnums=1)(params, policy, decisions, jnp.full(5, 0.2), config)
    # min(ratio A, clipped A): 1.2 * 2, 1.5 * -2, 0.5 * 2, 0.8 * -2, 1.1 * 1; sum -0.1, mean -0.02.
    policy_loss = 0.02
    value_loss = 0.5 * (0 + 1 + 4 + 9 + 16) / 5
    entropy = 0.5 * math.log(2 * math.pi * math.e)
    approx_kl = np.mean([r - 1 - math.log(r) for r in (1.5, 1.5, 0.5, 0.5, 1.1)])
    np.testing.assert_allclose(terms, [policy_loss, value_loss, entropy, approx_kl, 4 / 5], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(loss, policy_loss + 0.5 * value_loss - 0.1 * entropy, rtol=1e-5)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("count", [1, 2, 96, 128])
def test_the_chosen_rows_come_first_and_each_anywhere_among_them(count, share):
    chosen = np.arange(count) % 10 < 10 * share
    keys = jax.random.split(jax.random.key(0), 2000)
    orders = np.asarray(jax.jit(jax.vmap(partial(update.shuffled, jnp.asarray(chosen))))(keys)).astype(int)
    np.testing.assert_array_equal(np.sort(orders, axis=1), np.broadcast_to(np.arange(count), orders.shape))
    first = chosen.sum()
    assert chosen[orders[:, :first]].all()
    if first > 1:  # the chosen row 0 comes at each of the first places, and each chosen row comes first, equally often
        for found in (np.argmax(orders == 0, axis=1), orders[:, 0]):
            counts = np.unique(found, return_counts=True)[1]
            assert len(counts) == first and stats.chisquare(counts).pvalue > 1e-4


def test_options_are_drawn_from_the_policy():
    policy, rng = Policy(2, (3,)), np.random.default_rng(0)
    shapes = jax.eval_shape(lambda: policy.init(jax.random.key(0), 1, jnp.zeros(())))
    params = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), shapes)
    agent = Agent(EXECUTOR, params, normalize.init((1,)), policy)
    obs, noise = (jnp.asarray(rng.normal(size=(4, size)), jnp.float32) for size in (1, 2))
    mean, std = np.asarray(policy.distribution(params, obs).mean()), np.exp(np.asarray(params.log_std))
    for exploration in (1.0, 0.5, 0.0):
        option, log_prob = agent.decide(exploration)(obs, noise)
        np.testing.assert_allclose(option, mean + exploration * std * np.asarray(noise), rtol=1e-5)
        np.testing.assert_allclose(log_prob, stats.norm.logpdf(option, mean, std).sum(axis=1), rtol=1e-4)


@pytest.fixture(scope="module")
def iterate():
    """One iteration that is one gradient step on all decisions, compiled once."""
    return jax.jit(lambda state: ppo.iterate(as_arrays(ONE_STEP), ENV, EXECUTOR, ITERATIONS, state)[:3])


@pytest.fixture(scope="module")
def first_state() -> ppo.TrainState:
    return jax.jit(partial(ppo.init, as_arrays(ONE_STEP), ENV, EXECUTOR))(jax.random.key(3))


@jax.jit
def plain_update(
    state: ppo.TrainState, last_obs: jax.Array, ticks: Rollout, rows: tuple[jax.Array, jax.Array]
) -> tuple[PolicyParams, jax.Array]:
    """Do what the iteration should have done to the parameters, in plain code, on the decisions at `rows` alone."""
    config, policy = as_arrays(ONE_STEP), ppo.make_policy(EXECUTOR, ONE_STEP)
    obs, final_obs, last_obs = (
        normalize.normalize(state.obs_statistics, x) for x in (ticks.obs, ticks.final_obs, last_obs)
    )
    value, final_value, last_value = (policy.value(state.params, x) for x in (obs, final_obs, last_obs))
    judgement = Judgement(ticks.reward, ticks.terminated, ticks.truncated, value, final_value, last_value)
    advantage = semi_markov_advantages(judgement, ticks.ended, config.gamma, config.lambda_)
    target, advantage = (advantage + value)[rows], advantage[rows]
    advantage = (advantage - advantage.mean()) / advantage.std()
    decisions = update.Decisions(obs[rows], ticks.option[rows], ticks.log_prob[rows], advantage, target)
    weight = jnp.full(len(advantage), 1.0 / len(advantage))
    gradient, terms = jax.grad(update.ppo_loss, has_aux=True)(state.params, policy, decisions, weight, config)
    adam = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(ONE_STEP.learning_rate, eps=1e-5))
    with jax.numpy_dtype_promotion("standard"):
        updates, _ = adam.update(gradient, adam.init(state.params))
    return optax.apply_updates(state.params, updates), terms


def test_an_iteration_is_the_plain_update_on_its_decisions(iterate, first_state):
    state, metrics, ticks = iterate(first_state)
    assert 0.3 < np.mean(ticks.decision) < 0.5 and metrics["decisions"] == int(ticks.decision.sum())
    rows = np.nonzero(np.asarray(ticks.decision))
    params, terms = plain_update(first_state, state.running.env.obs, ticks, rows)
    assert_trees_equal(state.params, params, rtol=1e-4, atol=1e-6)
    assert_trees_equal([metrics[name] for name in update.LOSSES], list(terms), rtol=1e-4, atol=1e-6)


def test_the_first_pass_sees_the_policy_that_acted(iterate, first_state):
    """Ratios are 1: nothing is clipped, no divergence, and the loss is minus the mean advantage, standardised."""
    _, metrics, _ = iterate(first_state)
    np.testing.assert_allclose([metrics["policy_loss"], metrics["approx_kl"], metrics["clip_fraction"]], 0.0, atol=1e-6)


def test_iterations_share_one_program_and_statistics_follow_the_ticks(iterate, first_state):
    state, seen, count = first_state, [], iterate._cache_size()
    for _ in range(3):
        state, _, ticks = iterate(state)
        seen.append(ticks.obs)
    assert iterate._cache_size() == max(count, 1) == 1
    assert state.iteration == 3
    np.testing.assert_allclose(state.obs_statistics.mean, np.mean(seen, axis=(0, 1, 2)), rtol=1e-5)


def test_the_step_size_falls_linearly_to_zero(iterate, first_state):
    def step_at(iteration: int) -> list[np.ndarray]:
        state, _, _ = iterate(first_state.replace(iteration=jnp.int32(iteration)))
        return jax.tree.leaves(jax.tree.map(lambda a, b: np.asarray(a - b), state.params, first_state.params))

    whole, half, none = step_at(0), step_at(ITERATIONS // 2), step_at(ITERATIONS)
    for a, b, c in zip(whole, half, none, strict=True):
        np.testing.assert_allclose(b, a / 2, rtol=1e-3, atol=1e-6)
        assert not c.any()


def test_durations_are_counted_where_options_take_more_than_a_tick(iterate, first_state):
    _, metrics, ticks = iterate(first_state)
    np.testing.assert_array_equal(metrics["durations"], np.bincount(ticks.duration[ticks.ended], minlength=4)[1:])
    assert metrics["durations"].shape == (3,) and metrics["durations"].min() > 0
    flat, config = IdentityExecutor(1), as_arrays(ONE_STEP)
    state = jax.eval_shape(partial(ppo.init, config, ENV, flat), jax.random.key(3))
    _, of_flat, *_ = jax.eval_shape(partial(ppo.iterate, config, ENV, flat, ITERATIONS), state)
    assert set(of_flat) == set(metrics) - {"durations"}


def test_metrics_of_the_task_are_means_over_its_ticks(iterate, first_state):
    _, metrics, ticks = iterate(first_state)
    assert np.std(ticks.final_obs[..., -1]) > 0
    np.testing.assert_allclose(metrics["mean/last"], np.mean(ticks.final_obs[..., -1]), rtol=1e-5)


class Blinded(Probe):
    """One tick, after which nothing is observed; state and reward stay finite."""

    def observe(self, x: jax.Array) -> jax.Array:
        return jnp.where(x > 0, jnp.nan, x)[None]

    def move(self, x: jax.Array, action: jax.Array) -> tuple[jax.Array, ...]:
        return jnp.ones(()), jnp.ones(()), YES, NO


def test_an_observation_that_is_not_finite_is_named():
    env, executor, config = Blinded(), IdentityExecutor(1), as_arrays(ONE_STEP)
    state = jax.jit(partial(ppo.init, config, env, executor))(jax.random.key(0))
    _, metrics, *_ = jax.jit(partial(ppo.iterate, config, env, executor, ITERATIONS))(state)
    assert QUANTITIES[metrics["nonfinite"]] == "observation"


def pairs(a: jax.Array, b: jax.Array) -> list[tuple[float, float]]:
    return list(zip(a.tolist(), b.tolist(), strict=True))


def test_every_decision_is_used_once_an_epoch_and_nothing_else(monkeypatch, first_state):
    minibatches, true_loss = [], update.ppo_loss

    def spy(params, policy, batch, weight, config):
        jax.debug.callback(lambda *x: minibatches.append(x), batch.option[:, 0], batch.log_prob, weight)
        return true_loss(params, policy, batch, weight, config)

    monkeypatch.setattr(update, "ppo_loss", spy)
    config = as_arrays(dataclasses.replace(ONE_STEP, epochs=2, minibatch_size=5))
    _, _, ticks, _ = jax.jit(partial(ppo.iterate, config, ENV, EXECUTOR, ITERATIONS))(first_state)
    jax.effects_barrier()
    decisions = pairs(ticks.option[ticks.decision][:, 0], ticks.log_prob[ticks.decision])
    assert len(minibatches) == 2 * math.ceil(len(decisions) / 5)
    used = []
    for minibatch in minibatches:
        option, log_prob, weight = map(np.asarray, minibatch)
        rows = weight > 0
        assert 1 <= rows.sum() <= 5
        np.testing.assert_allclose(weight[rows], 1.0 / np.sum(rows))
        used += pairs(option[rows], log_prob[rows])
    assert sorted(used) == sorted(decisions + decisions)
    for epoch in (used[: len(decisions)], used[len(decisions) :]):
        assert sorted(epoch) == sorted(decisions) and epoch != decisions


def test_solves_the_probes():
    env = OneOf(Constant(), Observed(), TwoStep(), Sign())
    config = PPOConfig(
        num_envs=64, rollout_length=8, epochs=4, minibatch_size=128, hidden_sizes=(32,), learning_rate=0.02,
        gamma=0.5, normalize_reward=False,
    )  # fmt: skip
    ticks = 50 * config.num_envs * config.rollout_length
    agent, _ = jax.jit(lambda key: learner.train(config, env, IdentityExecutor(1), key, ticks))(jax.random.key(0))
    # Constant at 0, Observed at -1 and 1, TwoStep at 0 and 1, Sign at -1 and 1.
    which, x = jnp.array([0, 1, 1, 2, 2, 3, 3]), jnp.array([0.0, -1.0, 1.0, 0.0, 1.0, -1.0, 1.0])
    obs = jax.vmap(env.observe)((x, which))
    value = agent.policy.value(agent.params, normalize.normalize(agent.obs_statistics, obs))
    np.testing.assert_allclose(value[:5], [1.0, -1.0, 1.0, config.gamma, 1.0], atol=0.1)
    np.testing.assert_allclose(value[5:], [1.0, 1.0], atol=0.2)
    action, _ = agent.decide(exploration=0.0)(obs, jnp.zeros((7, 1)))
    assert action[5, 0] < -0.5 and action[6, 0] > 0.5


def train(config: PPOConfig, key: jax.Array) -> tuple[Agent, dict[str, jax.Array]]:
    return learner.train(config, ENV, EXECUTOR, key, 2 * config.num_envs * config.rollout_length)


train_alone, train_together = jax.jit(train), jax.jit(jax.vmap(train))


@pytest.mark.parametrize(
    ("learning_rates", "seeds"), [((0.01, 0.01), (0, 1)), ((0.01, 0.03), (0, 0))], ids=["keys", "config leaf"]
)
def test_vmapped_runs_are_the_runs_alone(learning_rates, seeds):
    configs = [as_arrays(dataclasses.replace(ONE_STEP, epochs=2, learning_rate=rate)) for rate in learning_rates]
    keys = [jax.random.key(seed) for seed in seeds]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *configs)
    together = jax.device_get(train_together(stacked, jnp.stack(keys)))
    alone = [jax.device_get(train_alone(config, key)) for config, key in zip(configs, keys, strict=True)]
    for k in range(2):
        assert_trees_equal(jax.tree.map(lambda x, k=k: x[k], together), alone[k], rtol=1e-4, atol=1e-5)
    assert (alone[0][0].params.log_std != alone[1][0].params.log_std).all()
    assert train_alone._cache_size() == train_together._cache_size() == 1


@pytest.mark.parametrize("reset", [True, False])
def test_exploration_is_reset_once_where_the_task_changes(reset):
    """Episodes of six ticks, the first in the room as it was: the task changes within the first of the rollouts."""
    config = dataclasses.replace(ONE_STEP, num_envs=2, rollout_length=8, log_std_reset=0.5, reset_at_change=reset)
    env, executor = TimeLimit(Navigation(change_after=1), 6), IdentityExecutor(2)
    config = as_arrays(dataclasses.replace(config, minibatch_size=16, learning_rate=0.0))
    state, narrow, found = ppo.init(config, env, executor, jax.random.key(0)), jnp.full(2, -1.0), []
    iterate = jax.jit(partial(ppo.iterate, config, env, executor, ITERATIONS))
    for _ in range(2):
        state, metrics, *_ = iterate(state.replace(params=state.params.replace(log_std=narrow)))
        found.append(state.params.log_std.tolist())
    assert found == [[0.5, 0.5] if reset else [-1.0, -1.0], [-1.0, -1.0]]
    assert metrics["episodes"] == 2.0, "of 16 ticks, two environments end their second episodes in the second rollout"
