"""An agent trained on Gymnasium's model acts in Gymnasium's own environment as in ours."""

import gymnasium
import jax
import numpy as np
import scipy.stats

import taic_jax as taic

EPISODES = 8


def test_returns_in_gymnasium_are_distributed_like_ours():
    handle = taic.load("pretrained:half_cheetah")
    agent = handle.agents["taic"][0]
    env, returns = gymnasium.make("HalfCheetah-v5"), np.zeros(EPISODES)
    for episode in range(EPISODES):
        obs, _ = env.reset(seed=episode)
        carry, ended = agent.start(obs), False
        while not ended:
            carry, action, _ = agent.act(carry, obs)
            obs, reward, _, ended, _ = env.step(np.asarray(action))
            returns[episode] += float(reward)
    keys = jax.random.split(jax.random.key(0), 3 * EPISODES)
    ours = jax.jit(jax.vmap(lambda key: taic.evaluate(handle.env, agent, key, 1, 0.0)["return"]))(keys)
    assert np.std(returns) > 1.0 and scipy.stats.mannwhitneyu(returns, ours).pvalue > 1e-3
    assert abs(returns.mean() - ours.mean()) < 4 * np.hypot(returns.std(), ours.std()) / np.sqrt(EPISODES)
