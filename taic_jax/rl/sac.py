"""Soft actor-critic over options (§5): rollout, replay, updates; flat SAC with the identity executor.

A decision is judged by its semi-Markov target r_{t..t+k} + gamma^k V(s_{t+k}), in which
V(s) = min Q(s, o) - temperature log pi(o|s) for an option o drawn from pi.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Key

from taic_jax.config import SACConfig
from taic_jax.envs.base import Env, Goals
from taic_jax.envs.wrappers import AutoReset
from taic_jax.networks import Critics, SquashedParams, SquashedPolicy
from taic_jax.nonfinite import earliest, first_nonfinite
from taic_jax.options.execution import Executor, IdentityExecutor
from taic_jax.rl import normalize
from taic_jax.rl.agent import Agent
from taic_jax.rl.replay import Replay, Transition, add, complete, init_pending, relabelled, sample
from taic_jax.rl.replay import init as init_replay
from taic_jax.rl.rollout import Rollout, RolloutCarry, pack_metrics, rollout, rollout_metrics, start
from taic_jax.types import Scalar, select

TERMS = ("critic_loss", "actor_loss", "value", "entropy", "temperature")


class Learnt(struct.PyTreeNode):
    """All that gradient steps change: the parameters, and the state of their optimiser."""

    actor: SquashedParams
    critics: Any
    log_temperature: Array
    targets: Any
    optimizer: optax.OptState


class SACState(struct.PyTreeNode):
    """The whole state of training, saved and restored as one tree; `owed` are gradient steps not taken yet."""

    learnt: Learnt
    obs_statistics: normalize.Statistics
    replay: Replay
    pending: Transition
    running: RolloutCarry
    owed: Array
    key: Array
    iteration: Array


def make_policy(executor: Executor, config: SACConfig) -> SquashedPolicy:
    """Return the policy over the executor's options."""
    return SquashedPolicy(executor.option_size, tuple(config.hidden_sizes))


def make_critics(config: SACConfig) -> Critics:
    """Return the critics' networks."""
    return Critics(tuple(config.hidden_sizes), config.layer_norm)


def make_optimizer() -> optax.GradientTransformation:
    """Return Adam on one flat vector, without the step size."""
    return optax.flatten(optax.scale_by_adam())


def init(config: SACConfig, env: Env, executor: Executor, key: Key[Array, ""]) -> SACState:
    """Return the state before the first iteration."""
    key, key_actor, key_critics, key_envs = jax.random.split(key, 4)
    bound = 1.0 if isinstance(executor, IdentityExecutor) else config.bound
    actor = make_policy(executor, config).init(key_actor, env.observation_size, bound)
    sizes, goals = (env.observation_size, executor.option_size), goals_of(config, env)
    pending = init_pending(config.num_envs, *sizes, executor.length, goals.size if goals else 0)
    critics = make_critics(config).init(key_critics, *sizes)
    log_temperature = jnp.log(jnp.asarray(config.temperature, jnp.float32))
    optimizer = make_optimizer().init((actor.actor, critics, log_temperature))
    return SACState(
        learnt=Learnt(actor, critics, log_temperature, critics, optimizer),
        obs_statistics=normalize.init((env.observation_size,)),
        replay=init_replay(config.capacity, pending),
        pending=pending,
        running=start(AutoReset(env), executor, config.num_envs, key_envs),
        owed=jnp.zeros(()),
        key=key,
        iteration=jnp.zeros((), jnp.int32),
    )


def goals_of(config: SACConfig, env: Env) -> Goals | None:
    """Return the goals of the task for hindsight, or None without it."""
    return env.goals if config.relabel else None


def as_agent(config: SACConfig, executor: Executor, state: SACState) -> Agent:
    """Return the agent trained so far."""
    return Agent(executor, state.learnt.actor, state.obs_statistics, make_policy(executor, config))


def iterate(
    config: SACConfig, env: Env, executor: Executor, num_iterations: int, state: SACState
) -> tuple[SACState, dict[str, Array], Rollout]:
    """Run one iteration: several rounds of ticks in B environments, each followed by its gradient steps.

    Returns the next state, the iteration's metrics and the rollout. The number of iterations has no effect.
    """
    key, key_rounds = jax.random.split(state.key)
    rounds = config.rollout_length // config.update_every
    step = partial(_round, config, env, executor)
    after, (ticks, terms, codes) = jax.lax.scan(step, state, jax.random.split(key_rounds, rounds))
    ticks = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), ticks)
    after = after.replace(key=key, iteration=state.iteration + 1)
    metrics = dict(zip(TERMS, jnp.mean(terms, axis=0), strict=True))
    metrics |= rollout_metrics(after.running, ticks, executor.length)
    return after, metrics | {"nonfinite": earliest(codes)}, ticks


def _round(
    config: SACConfig, env: Env, executor: Executor, state: SACState, key: Key[Array, ""]
) -> tuple[SACState, tuple[Rollout, Array, Array]]:
    """Take ticks, add the decisions that ended to the buffer, and learn from it."""
    key_rollout, key_update = jax.random.split(key)
    seen = state.iteration * config.rollout_length * config.num_envs
    warm = seen >= config.warmup
    running, ticks = collect(config, env, executor, state, warm, key_rollout)
    goals = goals_of(config, env)
    pending, transitions = complete(state.pending, ticks, config.gamma, goals)
    replay = add(state.replay, transitions, ticks.ended)
    owed = state.owed + jnp.where(warm, config.updates_per_decision * jnp.sum(ticks.ended, dtype=jnp.float32), 0.0)
    statistics = normalize.update(state.obs_statistics, ticks.obs)
    state = state.replace(obs_statistics=statistics, replay=replay, pending=pending, running=running)
    learnt, terms = improve(config, goals, executor, state, jnp.floor(owed), key_update)
    code = first_nonfinite(
        action=ticks.action, physics=running.env.physics, observation=(ticks.obs, ticks.final_obs),
        reward=ticks.reward, loss=terms, gradient=learnt,
    )  # fmt: skip
    return state.replace(learnt=learnt, owed=owed - jnp.floor(owed)), (ticks, terms, code)


def collect(
    config: SACConfig, env: Env, executor: Executor, state: SACState, warm: Bool[Array, ""], key: Key[Array, ""]
) -> tuple[RolloutCarry, Rollout]:
    """Roll the policy out, or uniformly random options before the warm-up is over."""
    policy = as_agent(config, executor, state).decide()

    def decide(obs: Array, noise: Array) -> tuple[Array, Array]:
        option, log_prob = policy(obs, noise)
        uniform = state.learnt.actor.bound * (2.0 * jax.scipy.stats.norm.cdf(noise) - 1.0)
        return jnp.where(warm, option, uniform), log_prob

    return rollout(AutoReset(env), executor, decide, state.running, key, config.update_every, keep=pack_metrics)


def improve(
    config: SACConfig, goals: Goals | None, executor: Executor, state: SACState, count: Float[Array, ""],
    key: Key[Array, ""],
) -> tuple[Learnt, Float[Array, "5"]]:  # fmt: skip
    """Take `count` gradient steps; return what is learnt and the mean terms, of zero for no step."""

    def step(index: Any, carry: tuple[Learnt, Array]) -> tuple[Learnt, Array]:
        key_sample, key_goal, key_options = jax.random.split(jax.random.fold_in(key, index), 3)
        horizon = config.horizon if goals else 0
        batch, later = sample(state.replay, key_sample, config.batch_size, state.pending, horizon)
        if goals:
            share = config.relabel / (config.relabel + 1)
            chosen = jax.random.bernoulli(key_goal, share, (config.batch_size,))
            batch = select(chosen, relabelled(batch, later, config.gamma, goals), batch)
        obs, next_obs = (normalize.normalize(state.obs_statistics, x) for x in (batch.obs, batch.next_obs))
        learnt, terms = update(config, executor, carry[0], batch.replace(obs=obs, next_obs=next_obs), key_options)
        return learnt, carry[1] + terms

    steps = count.astype(jnp.int32)
    learnt, terms = jax.lax.fori_loop(0, steps, step, (state.learnt, jnp.zeros(len(TERMS))))
    return learnt, terms / jnp.maximum(count, 1.0)


def update(
    config: SACConfig, executor: Executor, learnt: Learnt, batch: Transition, key: Key[Array, ""]
) -> tuple[Learnt, Float[Array, "5"]]:
    """Take one gradient step on M transitions of normalised observations; return the terms of the loss."""
    params = learnt.actor.actor, learnt.critics, learnt.log_temperature
    noise = jax.random.normal(key, (2, config.batch_size, executor.option_size))
    gradient, terms = jax.grad(sac_loss, has_aux=True)(params, config, executor, learnt, batch, noise)
    with jax.numpy_dtype_promotion("standard"):  # Optax raises a float to an integer power
        updates, optimizer = make_optimizer().update(gradient, learnt.optimizer)
    actor, critics, log_temperature = jax.tree.map(lambda p, u: p - config.learning_rate * u, params, updates)
    targets = jax.tree.map(lambda old, new: old + config.tau * (new - old), learnt.targets, critics)
    return Learnt(learnt.actor.replace(actor=actor), critics, log_temperature, targets, optimizer), terms


def sac_loss(
    params: Any, config: SACConfig, executor: Executor, learnt: Learnt, batch: Transition, noise: Float[Array, "2 M D"]
) -> tuple[Float[Array, ""], Float[Array, "5"]]:
    """Return the sum of the losses of critics, actor and temperature, none of which moves another's parameters."""
    actor, critics, log_temperature = params
    policy, networks = make_policy(executor, config), make_critics(config)
    bound, temperature = learnt.actor.bound, jax.lax.stop_gradient(jnp.exp(log_temperature))
    target = jax.lax.stop_gradient(semi_markov_target(policy, networks, learnt, temperature, batch, noise[0]))
    values = networks.values(critics, batch.obs, batch.option / bound)
    critic_loss = jnp.sum(jnp.mean(jnp.square(values - target[None]), axis=1))
    option, log_prob = policy.draw(learnt.actor.replace(actor=actor), batch.obs, 1.0, noise[1])
    value = jnp.min(networks.values(jax.lax.stop_gradient(critics), batch.obs, option / bound), axis=0)
    actor_loss = jnp.mean(temperature * log_prob - value)
    entropy = -jax.lax.stop_gradient(jnp.mean(log_prob))
    temperature_loss = log_temperature * (entropy - config.target_entropy * executor.option_size)
    terms = jnp.stack([critic_loss, actor_loss, jnp.mean(value), entropy, temperature])
    return critic_loss + actor_loss + temperature_loss, terms


def semi_markov_target(
    policy: SquashedPolicy,
    networks: Critics,
    learnt: Learnt,
    temperature: Scalar,
    batch: Transition,
    noise: Float[Array, "M D"],
) -> Float[Array, " M"]:
    """Return r_{t..t+k} + gamma^k V(s_{t+k}) with the target critics; an end of the task has no V."""
    option, log_prob = policy.draw(learnt.actor, batch.next_obs, 1.0, noise)
    values = networks.values(learnt.targets, batch.next_obs, option / learnt.actor.bound)
    return batch.reward + batch.discount * (jnp.min(values, axis=0) - temperature * log_prob)
