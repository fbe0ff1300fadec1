"""PPO over options (§3.5, eq. 10): rollout, advantages, updates.

Flat PPO is the same code with the identity executor, whose options are actions that end after one tick.
"""

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Key

from taic_jax.config import PPOConfig
from taic_jax.envs.base import Env
from taic_jax.envs.wrappers import AutoReset
from taic_jax.networks import CategoricalPolicy, Policy, PolicyParams
from taic_jax.nonfinite import first_nonfinite
from taic_jax.options.execution import Executor
from taic_jax.rl import normalize
from taic_jax.rl.agent import Agent
from taic_jax.rl.returns import Judgement, semi_markov_advantages
from taic_jax.rl.rollout import Rollout, RolloutCarry, pack_metrics, rollout, rollout_metrics, start
from taic_jax.rl.update import LOSSES, Decisions, Update, make_optimizer, update
from taic_jax.types import Scalar


class TrainState(struct.PyTreeNode):
    """The whole state of training, saved and restored as one tree."""

    params: PolicyParams
    optimizer: optax.OptState
    obs_statistics: normalize.Statistics
    reward_scale: normalize.RewardScale
    running: RolloutCarry
    key: Array
    iteration: Array


def make_policy(executor: Executor, config: PPOConfig) -> Policy:
    """Return the policy over the executor's options."""
    kind = CategoricalPolicy if executor.discrete else Policy
    return kind(executor.option_size, tuple(config.hidden_sizes))


def init(config: PPOConfig, env: Env, executor: Executor, key: Key[Array, ""]) -> TrainState:
    """Return the state before the first iteration."""
    key, key_params, key_envs = jax.random.split(key, 3)
    policy = make_policy(executor, config)
    params: Any = policy.init(key_params, env.observation_size, config.log_std_init)
    return TrainState(
        params=params,
        optimizer=make_optimizer(config).init(params),
        obs_statistics=normalize.init((env.observation_size,)),
        reward_scale=normalize.init_reward_scale(config.num_envs),
        running=start(AutoReset(env), executor, config.num_envs, key_envs, env.staggered),
        key=key,
        iteration=jnp.zeros((), jnp.int32),
    )


def as_agent(config: PPOConfig, executor: Executor, state: TrainState) -> Agent:
    """Return the agent trained so far."""
    return Agent(executor, state.params, state.obs_statistics, make_policy(executor, config))


def step_size(config: PPOConfig, learning_rate: Scalar, iteration: Int[Array, ""], num_iterations: int) -> Scalar:
    """Return the step size of an iteration, which decays to zero over all of them if the config says so."""
    progress = iteration.astype(jnp.float32) / num_iterations if config.learning_rate_decay else 0.0
    return learning_rate * (1.0 - progress)


def standardize(x: Float[Array, "..."], mask: Array | None = None) -> Float[Array, "..."]:
    """Subtract the mean and divide by the standard deviation, those of the masked entries."""
    mean = jnp.mean(x, where=mask)
    return (x - mean) / (jnp.std(x, where=mask) + 1e-8)


def iterate(
    config: PPOConfig, env: Env, executor: Executor, num_iterations: int, state: TrainState
) -> tuple[TrainState, dict[str, Array], Rollout, Judgement]:
    """Run one iteration: collect T ticks of B environments, judge them, then update the policy in epochs.

    Returns the next state, the iteration's metrics, the rollout (unscaled rewards) and its judgement.
    """
    key, key_rollout, key_update = jax.random.split(state.key, 3)
    running, ticks = collect(config, env, executor, state, key_rollout)
    reward_scale, obs, judgement = judge(config, executor, state, ticks, running.env.obs)
    rows = decisions_of(config, obs, ticks, judgement)
    result = improve(config, executor, num_iterations, state, rows, ticks.decision.reshape(-1), key_update)
    after = TrainState(
        params=_explore_anew(config, result.params, state.running.env.metrics, running.env.metrics),
        optimizer=result.optimizer,
        obs_statistics=normalize.update(state.obs_statistics, ticks.obs),
        reward_scale=reward_scale,
        running=running,
        key=key,
        iteration=state.iteration + 1,
    )
    nonfinite = first_nonfinite(
        action=ticks.action, physics=running.env.physics, observation=(ticks.obs, ticks.final_obs),
        reward=(ticks.reward, judgement.reward), value=rows.advantage,
        loss=result.terms, gradient=(result.params, result.optimizer),
    )  # fmt: skip
    return after, _metrics(config, after, ticks, result, executor.length) | {"nonfinite": nonfinite}, ticks, judgement


def collect(
    config: PPOConfig, env: Env, executor: Executor, state: TrainState, key: Key[Array, ""]
) -> tuple[RolloutCarry, Rollout]:
    """Roll the policy out for T ticks in B environments."""
    decide = as_agent(config, executor, state).decide()
    return rollout(AutoReset(env), executor, decide, state.running, key, config.rollout_length, keep=pack_metrics)


def judge(
    config: PPOConfig, executor: Executor, state: TrainState, ticks: Rollout, last_obs: Float[Array, "B S"]
) -> tuple[normalize.RewardScale, Float[Array, "T B S"], Judgement]:
    """Return the next reward scale, the normalised observations, and rewards and values of the ticks."""
    reward_scale, reward = state.reward_scale, ticks.reward
    if config.normalize_reward:
        done = ticks.terminated | ticks.truncated
        reward_scale, reward = normalize.scale_rewards(reward_scale, reward, done, config.gamma)
    obs, final_obs, last_obs = (
        normalize.normalize(state.obs_statistics, x) for x in (ticks.obs, ticks.final_obs, last_obs)
    )
    value, final_value, last_value = (
        make_policy(executor, config).value(state.params, x) for x in (obs, final_obs, last_obs)
    )
    return reward_scale, obs, Judgement(reward, ticks.terminated, ticks.truncated, value, final_value, last_value)


def decisions_of(config: PPOConfig, obs: Float[Array, "T B S"], ticks: Rollout, judgement: Judgement) -> Decisions:
    """Return a row per tick [T B] with its advantage and the critic's target; only decisions are meaningful."""
    advantage = semi_markov_advantages(judgement, ticks.ended, config.gamma, config.lambda_)
    rows = Decisions(obs, ticks.option, ticks.log_prob, advantage, advantage + judgement.value)
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), rows)


def improve(
    config: PPOConfig,
    executor: Executor,
    num_iterations: int,
    state: TrainState,
    rows: Decisions,
    decision: Bool[Array, " R"],
    key: Key[Array, ""],
) -> Update:
    """Run all epochs of updates on the ticks that are decisions."""
    if config.normalize_advantage:
        rows = rows.replace(advantage=standardize(rows.advantage, decision))
    learning_rate = step_size(config, config.learning_rate, state.iteration, num_iterations)
    policy = make_policy(executor, config)
    return update(policy, config, learning_rate, state.params, state.optimizer, rows, decision, key)


def _explore_anew(
    config: PPOConfig, params: PolicyParams, before: dict[str, Array], after: dict[str, Array]
) -> PolicyParams:
    """Reset the standard deviation after the rollout in which the share of changed environments reaches one half.

    A task without a metric `changed` never changes.
    """
    if not config.reset_at_change or "changed" not in after:
        return params
    half = (jnp.mean(before["changed"]) < 0.5) & (jnp.mean(after["changed"]) >= 0.5)
    return params.replace(log_std=jnp.where(half, config.log_std_reset, params.log_std))


def _metrics(config: PPOConfig, state: TrainState, ticks: Rollout, result: Update, length: int) -> dict[str, Array]:
    """Return the terms of one iteration's updates, and the metrics of its rollout."""
    count = jnp.sum(ticks.decision, dtype=jnp.int32)
    num_updates = config.epochs * ((count + config.minibatch_size - 1) // config.minibatch_size)
    terms = dict(zip(LOSSES, result.terms / num_updates.astype(jnp.float32), strict=True))
    std = {"std": jnp.mean(jnp.exp(state.params.log_std))}
    return std | terms | rollout_metrics(state.running, ticks, length)
