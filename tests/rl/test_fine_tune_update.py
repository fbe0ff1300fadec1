"""One update of D against plain code: scaled states, episodes that end either way, a decayed step size."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import Probe

from taic_jax.config import FineTuneConfig, OptionsConfig, PPOConfig
from taic_jax.options.execution import OptionExecutor, make_executor
from taic_jax.options.model import OptionModel, Scale, init_params, make_networks
from taic_jax.rl import fine_tune, ppo
from taic_jax.rl.returns import Judgement, semi_markov_advantages
from taic_jax.rl.rollout import Rollout
from taic_jax.types import as_arrays, select

T, B, L = 12, 4, 3
OPTIONS = OptionsConfig(length=L, size=2, hidden_size=4, mlp_sizes=(4,), decoder_sizes=(8,))
PPO = PPOConfig(
    num_envs=B, rollout_length=T, epochs=1, minibatch_size=48, hidden_sizes=(4,), log_std_init=-2.0, gamma=0.9,
    lambda_=0.8, learning_rate_decay=True,
)  # fmt: skip
FINE = FineTuneConfig(epochs=1, minibatch_size=T * B, learning_rate=0.02, std=0.1)
ITERATIONS, ITERATION = 8, 6
"""After six of eight iterations a quarter of the step size is left."""


class Walk(Probe):
    """x moves by the action, which is the reward too; an episode ends once x has gone 5 ticks, one way or the other."""

    observation_size = 2
    episode_length = 5

    def __init__(self, truncated: bool):
        self.truncated = jnp.asarray(truncated)

    def first(self, key: jax.Array) -> jax.Array:
        tick = jax.random.randint(key, (), 0, 3).astype(jnp.float32)
        return jnp.stack([jax.random.uniform(key, (), minval=2.0, maxval=4.0), tick])

    def observe(self, x: jax.Array) -> jax.Array:
        return x

    def move(self, x: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        x = x + jnp.append(action, 1.0)
        ended = x[1] >= self.episode_length
        return x, action * x[0], ended & ~self.truncated, ended & self.truncated


def make(decoder: str) -> OptionExecutor:
    """Return the executor of a model that has not learnt, of a body that sees x alone, around 3 and a half wide."""
    options = dataclasses.replace(OPTIONS, decoder=decoder)
    networks = make_networks(options, 1, 1)
    params = init_params(networks, options, jax.random.key(3))
    params = {**params, "decoder": jax.tree.map(lambda x: 0.3 * x, params["decoder"])}  # far from the actions' bounds
    scale = Scale(jnp.full(1, 3.0), jnp.full(1, 0.5))
    return make_executor(options, OptionModel(params, scale, scale, jnp.ones(()), networks))


def mean_actions(executor: OptionExecutor, ticks: Rollout, decoder: dict) -> jax.Array:
    """Return D's action at each tick [T, B, A], as the executor emits it without noise."""
    executor = fine_tune.tuned_executor(executor, decoder)
    start, act = jax.vmap(executor.start), jax.vmap(partial(executor.act, noise=jnp.zeros(0)))

    def tick(carry, step):
        option, obs, decision = step
        return act(select(decision, start(option, obs), carry), obs)

    first = start(ticks.option[0], ticks.obs[0])
    return jax.lax.scan(tick, first, (ticks.option, ticks.obs, ticks.decision))[1]


@jax.jit
def plain_update(executor: OptionExecutor, state, ticks: Rollout, last_obs, reward, decay) -> dict:
    """Return what a step up the advantages' likelihood makes of D."""
    config, decoder = as_arrays(PPO), executor.model.params["decoder"]
    policy = ppo.make_policy(executor, config)
    value, final_value, last_value = (policy.value(state.params, x) for x in (ticks.obs, ticks.final_obs, last_obs))
    judgement = Judgement(reward, ticks.terminated, ticks.truncated, value, final_value, last_value)
    advantage = semi_markov_advantages(judgement, jnp.ones((T, B), bool), config.gamma, config.lambda_)
    advantage = (advantage - advantage.mean()) / advantage.std()

    def loss(decoder: dict) -> jax.Array:
        errors = jnp.sum(jnp.square(ticks.action - mean_actions(executor, ticks, decoder)), axis=-1)
        log_prob = -errors / (2 * FINE.std**2)
        return -jnp.mean(advantage * jnp.exp(log_prob - jax.lax.stop_gradient(log_prob)))

    adam = optax.chain(optax.clip_by_global_norm(PPO.max_grad_norm), optax.adam(decay * FINE.learning_rate, eps=1e-5))
    with jax.numpy_dtype_promotion("standard"):
        updates, _ = adam.update(jax.grad(loss)(decoder), adam.init(decoder))
    return optax.apply_updates(decoder, updates)


@pytest.mark.parametrize(
    ("decoder", "truncated", "normalize", "decay"),
    [("closed", True, True, True), ("open", False, False, False)],
)
def test_a_step_of_d_is_the_plain_update(decoder, truncated, normalize, decay):
    config = as_arrays(dataclasses.replace(PPO, normalize_reward=normalize, learning_rate_decay=decay))
    env, executor, fine = Walk(truncated), make(decoder), as_arrays(FINE)
    state = ppo.init(config, env, executor, jax.random.key(0)).replace(iteration=jnp.int32(ITERATION))
    noisy = executor.replace(std=fine.std)
    running, ticks = jax.jit(partial(ppo.collect, config, env, noisy))(state, jax.random.split(state.key, 3)[1])
    tune = jax.jit(partial(fine_tune.iterate, config, fine, env, executor, ITERATIONS))
    _, tuned, metrics = tune(state, fine_tune.init(config, executor))
    assert np.abs(ticks.action).max() < 1.0 and (ticks.terminated | ticks.truncated).sum() > B
    reward = np.asarray(ticks.reward)
    if normalize:
        total, totals = np.zeros(B), []
        for t in range(T):
            totals.append(0.9 * total + reward[t])
            total = np.where(ticks.terminated[t] | ticks.truncated[t], 0.0, totals[-1])
        reward = reward / np.float32(np.std(totals))
    share = 1.0 - ITERATION / ITERATIONS if decay else 1.0
    expected = plain_update(executor, state, ticks, running.env.obs, reward, share)
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), expected, executor.model.params["decoder"])
    np.testing.assert_allclose(max(jax.tree.leaves(moved)), share * FINE.learning_rate, rtol=0.1)
    for a, b in zip(jax.tree.leaves(tuned.decoder), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=0.1 * share * FINE.learning_rate)
    np.testing.assert_allclose(metrics["decoder_loss"], 0.0, atol=1e-5)
