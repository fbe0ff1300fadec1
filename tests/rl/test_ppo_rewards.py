"""PPO on scaled rewards: what its critic is pulled to, by value, in one iteration and in the next."""

from functools import partial

import jax
import numpy as np
import pytest
from probes import Counting, Repeat

from taic_jax.config import PPOConfig
from taic_jax.rl import ppo
from taic_jax.rl.returns import Judgement, semi_markov_advantages
from taic_jax.rl.rollout import Rollout
from taic_jax.types import as_arrays

GAMMA, LAMBDA = np.float32(0.9), np.float32(0.8)
CONFIG = PPOConfig(
    num_envs=4, rollout_length=16, epochs=1, minibatch_size=64, hidden_sizes=(4,), learning_rate=0.01,
    gamma=float(GAMMA), lambda_=float(LAMBDA), normalize_reward=True,
)  # fmt: skip

advantages = jax.jit(semi_markov_advantages)


def discounted(ticks: Rollout, running: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the discounted return at each tick [T, B], and what is carried over to the next rollout [B]."""
    totals = []
    for reward, done in zip(np.asarray(ticks.reward), np.asarray(ticks.terminated | ticks.truncated), strict=True):
        totals.append(GAMMA * running + reward)
        running = np.where(done, 0.0, totals[-1])
    return np.array(totals), running


@pytest.mark.parametrize("truncated", [False, True], ids=["terminated", "truncated"])
def test_the_critic_is_pulled_to_scaled_rewards(truncated):
    """In one step on all decisions its loss is half the mean square of their advantages, before any standardising."""
    env, executor, config = Counting(7, truncated=truncated, spread=5), Repeat(3), as_arrays(CONFIG)
    state = ppo.init(config, env, executor, jax.random.key(3))
    iterate = jax.jit(partial(ppo.iterate, config, env, executor, 10))
    running, totals = np.zeros(4), np.zeros((0, 4))
    for _ in range(2):
        before = state
        state, metrics, ticks, _ = iterate(state)
        new, running = discounted(ticks, running)
        totals = np.concatenate([totals, new])
        critic = jax.jit(partial(value, before, ppo.as_agent(config, executor, before).policy))
        values = (critic(obs) for obs in (ticks.obs, ticks.final_obs, state.running.env.obs))
        judgement = Judgement(ticks.reward / np.float32(totals.std()), ticks.terminated, ticks.truncated, *values)
        advantage = advantages(judgement, ticks.ended, GAMMA, LAMBDA)
        expected = np.mean(np.square(advantage[ticks.decision])) / 2
        np.testing.assert_allclose(metrics["value_loss"], expected, rtol=1e-3)
        np.testing.assert_array_equal(ticks.reward, ticks.final_obs[..., 0])  # the rollout's own are as they were
    assert totals.std() > 3.0  # so that unscaled rewards would have been told apart


def value(state: ppo.TrainState, policy, obs: jax.Array) -> jax.Array:
    """Return V of observations, normalised by the statistics before the rollout."""
    statistics = state.obs_statistics
    with jax.numpy_rank_promotion("allow"):
        return policy.value(state.params, (obs - statistics.mean) / statistics.std)
