"""An agent of a run on Gymnasium's model acts in Gymnasium's own environment as in ours."""

import gymnasium
import jax
import numpy as np
import scipy.stats
from tiny_runs import CONFIG, with_fields

import taic_jax as taic

EPISODES = 8


def test_returns_in_gymnasium_are_distributed_like_ours(tmp_path):
    fields = {"env__name": "half_cheetah", "env__model": "gym", "seeds": 1, "evaluate__video_ticks": 0}
    taic.run_pipeline(with_fields(CONFIG, **fields, train__baselines=()), tmp_path / "run", quiet=True)
    handle = taic.load(tmp_path / "run")
    agent = handle.agents["taic"][0]
    # An untrained policy hardly moves: with these weights its options depend on the state, and the robot runs or falls.
    actor, decoder = jax.tree.map(lambda x: 10.0 * x, (agent.params.actor, agent.executor.model.params["decoder"]))
    executor = agent.executor.replace(model=agent.executor.model.with_decoder(decoder))
    agent = agent.replace(params=agent.params.replace(actor=actor), executor=executor)
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
