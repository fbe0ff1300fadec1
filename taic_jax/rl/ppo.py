"""PPO over options (§3.5, eq. 10): rollout, advantages, and updates that are spent on decisions only.

Flat PPO is the same code with the identity executor, whose options are actions that end after one tick.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int, Key

from taic_jax import normalize
from taic_jax.config import PPOConfig
from taic_jax.envs.base import Env
from taic_jax.envs.wrappers import AutoReset
from taic_jax.networks import Policy, PolicyParams
from taic_jax.options.execution import Executor
from taic_jax.returns import semi_markov_advantages
from taic_jax.rl.rollout import DecideFn, Rollout, Running, count_durations, rollout, start
from taic_jax.types import Scalar, as_arrays

LOSSES = ("policy_loss", "value_loss", "entropy", "approx_kl", "clip_fraction")


class TrainState(struct.PyTreeNode):
    """Everything a training run is: saved and restored whole."""

    params: PolicyParams
    optimizer: optax.OptState
    obs_statistics: normalize.Statistics
    reward_scale: normalize.RewardScale
    running: Running
    key: Array
    iteration: Array


class Agent(struct.PyTreeNode):
    """All that is needed to act: a policy over options with its parameters, and what executes the options."""

    executor: Executor
    params: PolicyParams
    obs_statistics: normalize.Statistics
    policy: Policy = struct.field(pytree_node=False)

    def decide(self, exploration: Scalar = 1.0) -> DecideFn:
        """Return the policy as a function of raw observations and standard normal noise.

        The noise is scaled by `exploration`: 1 draws options from pi(o|s), 0 takes their mean.
        """
        return partial(_decide, self, exploration)


def _decide(
    agent: Agent, exploration: Scalar, obs: Float[Array, "B S"], noise: Float[Array, "B D"]
) -> tuple[Float[Array, "B D"], Float[Array, " B"]]:
    distribution: Any = agent.policy.distribution(agent.params, normalize.normalize(agent.obs_statistics, obs))
    option = distribution.loc + exploration * distribution.scale_diag * noise
    return option, distribution.log_prob(option)


class Decisions(struct.PyTreeNode):
    """What the loss needs of R decisions."""

    obs: Array
    option: Array
    log_prob: Array
    advantage: Array
    target: Array


def make_policy(executor: Executor, config: PPOConfig) -> Policy:
    """Return the policy over the executor's options."""
    return Policy(executor.option_size, tuple(config.hidden_sizes))


def make_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Return Adam behind global-norm clipping on one flat vector; the learning rate is applied by `_update`."""
    clip = optax.clip_by_global_norm(config.max_grad_norm)
    return optax.flatten(optax.chain(clip, optax.scale_by_adam(eps=1e-5)))


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
        running=start(AutoReset(env), executor, config.num_envs, key_envs),
        key=key,
        iteration=jnp.zeros((), jnp.int32),
    )


def as_agent(config: PPOConfig, executor: Executor, state: TrainState) -> Agent:
    """Return the agent trained so far."""
    return Agent(executor, state.params, state.obs_statistics, make_policy(executor, config))


def ppo_loss(
    params: PolicyParams,
    policy: Policy,
    batch: Decisions,
    weight: Float[Array, " M"],
    config: PPOConfig,
) -> tuple[Float[Array, ""], Float[Array, "5"]]:
    """Return the clipped loss of M decisions, averaged with weights that sum to one, and its terms."""
    distribution = policy.distribution(params, batch.obs)
    log_ratio = distribution.log_prob(batch.option) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    policy_loss = -jnp.sum(weight * jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))
    value_loss = 0.5 * jnp.sum(weight * jnp.square(policy.value(params, batch.obs) - batch.target))
    entropy = jnp.sum(weight * distribution.entropy())
    loss = policy_loss + config.value_weight * value_loss - config.entropy_weight * entropy
    approx_kl = jnp.sum(weight * (ratio - 1.0 - log_ratio))
    clip_fraction = jnp.sum(weight, where=jnp.abs(ratio - 1.0) > config.clip)
    return loss, jnp.stack([policy_loss, value_loss, entropy, approx_kl, clip_fraction])


class _Update(struct.PyTreeNode):
    """Carry of the update loops: parameters, optimiser state and the sum of the loss terms."""

    params: PolicyParams
    optimizer: optax.OptState
    terms: Array


def _minibatch(
    policy: Policy,
    config: PPOConfig,
    learning_rate: Scalar,
    rows: Decisions,
    count: Int[Array, ""],
    num_minibatches: Int[Array, ""],
    index: Int[Array, ""],
    carry: _Update,
) -> _Update:
    """Take one gradient step on the `index`-th of `num_minibatches` nearly equal parts of `count` rows."""
    size, rest = count // num_minibatches, count % num_minibatches
    first = index * size + jnp.minimum(index, rest)
    size = size + (index < rest).astype(jnp.int32)
    batch = jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, first, config.minibatch_size), rows)
    weight = jnp.where(jnp.arange(config.minibatch_size) < size, 1.0 / size.astype(jnp.float32), 0.0)
    gradient, terms = jax.grad(ppo_loss, has_aux=True)(carry.params, policy, batch, weight, config)
    with jax.numpy_dtype_promotion("standard"):  # Optax raises a float to an integer power
        updates, optimizer = make_optimizer(config).update(gradient, carry.optimizer)
    params = jax.tree.map(lambda p, u: p - learning_rate * u, carry.params, updates)
    return _Update(params, optimizer, carry.terms + terms)


def _epoch(
    policy: Policy,
    config: PPOConfig,
    learning_rate: Scalar,
    packed: Float[Array, "R F"],
    decision: Array,
    carry: _Update,
    key: Key[Array, ""],
) -> tuple[_Update, None]:
    """Pass once over all decisions in random order, in as many minibatches as they fill."""
    count = jnp.sum(decision, dtype=jnp.int32)
    num_minibatches = (count + config.minibatch_size - 1) // config.minibatch_size
    # Decisions first, in random order; the ticks between them are never touched.
    order = jnp.argsort(jnp.where(decision, jax.random.uniform(key, decision.shape), 2.0))
    rows = jnp.pad(packed[order], ((0, config.minibatch_size), (0, 0)))
    size = policy.option_size
    split = Decisions(rows[:, size + 3 :], rows[:, :size], *jnp.moveaxis(rows[:, size : size + 3], 1, 0))
    step = partial(_minibatch, policy, config, learning_rate, split, count, num_minibatches)
    return jax.lax.fori_loop(0, num_minibatches, step, carry), None


def _update(
    policy: Policy,
    config: PPOConfig,
    learning_rate: Scalar,
    state: TrainState,
    decisions: Decisions,
    decision: Array,
    key: Key[Array, ""],
) -> _Update:
    """Run all epochs over the decisions among R ticks."""
    scalars = jnp.stack([decisions.log_prob, decisions.advantage, decisions.target], axis=1)
    # One matrix, so that a permutation is a single gather.
    packed = jnp.concatenate([decisions.option, scalars, decisions.obs], axis=1)
    carry = _Update(state.params, state.optimizer, jnp.zeros(len(LOSSES)))
    epoch = partial(_epoch, policy, config, learning_rate, packed, decision)
    carry, _ = jax.lax.scan(epoch, carry, jax.random.split(key, config.epochs))
    return carry


def _standardize(x: Float[Array, " R"], mask: Array) -> Float[Array, " R"]:
    """Subtract the mean and divide by the standard deviation of the masked entries."""
    mean = jnp.mean(x, where=mask)
    return (x - mean) / (jnp.std(x, where=mask) + 1e-8)


def iterate(
    config: PPOConfig,
    env: Env,
    executor: Executor,
    num_iterations: int,
    state: TrainState,
) -> tuple[TrainState, dict[str, Array], Rollout]:
    """Run one iteration: T ticks of B environments, then all epochs of updates.

    Returns the next state, the iteration's metrics and the rollout (unscaled rewards).
    """
    policy = make_policy(executor, config)
    key, key_rollout, key_update = jax.random.split(state.key, 3)
    decide = as_agent(config, executor, state).decide()
    running, ticks = rollout(AutoReset(env), executor, decide, state.running, key_rollout, config.rollout_length)
    reward_scale, reward = state.reward_scale, ticks.reward
    if config.normalize_reward:
        done = ticks.terminated | ticks.truncated
        reward_scale, reward = normalize.scale_rewards(reward_scale, reward, done, config.gamma)

    obs = normalize.normalize(state.obs_statistics, ticks.obs)
    value = policy.value(state.params, obs)
    final_obs = normalize.normalize(state.obs_statistics, ticks.final_obs)
    last_obs = normalize.normalize(state.obs_statistics, running.env.obs)
    advantage = semi_markov_advantages(
        reward=reward,
        ended=ticks.ended,
        terminated=ticks.terminated,
        truncated=ticks.truncated,
        value=value,
        final_value=policy.value(state.params, final_obs),
        last_value=policy.value(state.params, last_obs),
        gamma=config.gamma,
        lambda_=config.lambda_,
    )
    decisions = Decisions(obs, ticks.option, ticks.log_prob, advantage, advantage + value)
    decisions = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), decisions)
    decision = ticks.decision.reshape(-1)
    if config.normalize_advantage:
        decisions = decisions.replace(advantage=_standardize(decisions.advantage, decision))

    progress = state.iteration.astype(jnp.float32) / num_iterations if config.learning_rate_decay else 0.0
    learning_rate = config.learning_rate * (1.0 - progress)
    result = _update(policy, config, learning_rate, state, decisions, decision, key_update)
    state = state.replace(
        params=result.params,
        optimizer=result.optimizer,
        obs_statistics=normalize.update(state.obs_statistics, ticks.obs),
        reward_scale=reward_scale,
        running=running,
        key=key,
        iteration=state.iteration + 1,
    )
    return state, _metrics(config, state, ticks, result, executor.length), ticks


def _metrics(config: PPOConfig, state: TrainState, ticks: Rollout, result: _Update, length: int) -> dict[str, Array]:
    """Return the scalars of one iteration and, where options take more than one tick, their durations [L]."""
    count = jnp.sum(ticks.decision, dtype=jnp.int32)
    num_updates = config.epochs * ((count + config.minibatch_size - 1) // config.minibatch_size)
    terms = dict(zip(LOSSES, result.terms / num_updates.astype(jnp.float32), strict=True))
    return {
        # Of each environment's last finished episode; NaN until one has finished.
        "return": jnp.nanmean(state.running.last_return),
        "decisions": count.astype(jnp.float32),
        "duration": ticks.decision.size / count.astype(jnp.float32),
        "std": jnp.mean(jnp.exp(state.params.log_std)),
        **terms,
        **({"durations": count_durations(ticks, length)} if length > 1 else {}),
    }


def num_iterations(config: PPOConfig, ticks: int) -> int:
    """Return how many whole iterations a budget of ticks buys."""
    return ticks // (config.num_envs * config.rollout_length)


def train(
    config: PPOConfig, env: Env, executor: Executor, key: Key[Array, ""], ticks: int
) -> tuple[Agent, dict[str, Array]]:
    """Train a policy over the executor's options for `ticks` interactions; pure, so keys may be vmapped.

    Returns the agent and the metrics of every iteration, leading axis the iteration.
    """
    config = as_arrays(config)
    iterations = num_iterations(config, ticks)
    step = partial(iterate, config, env, executor, iterations)
    state, metrics = jax.lax.scan(lambda s, _: step(s)[:2], init(config, env, executor, key), None, iterations)
    return as_agent(config, executor, state), metrics
