"""Learning from replay over options (§5): rollout, replay buffer, updates; the parts that SAC and DQN share.

A learner is a `Rule`, which sees transitions of normalised observations. Flat control is the same code with the
identity executor.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Key

from taic_jax.config import ReplayConfig
from taic_jax.envs.base import Env, Goals
from taic_jax.envs.wrappers import AutoReset
from taic_jax.nonfinite import earliest, first_nonfinite
from taic_jax.options.execution import Executor
from taic_jax.rl import normalize
from taic_jax.rl.agent import Agent
from taic_jax.rl.replay import Replay, Transition, add, complete, init_pending, relabelled, sample
from taic_jax.rl.replay import init as init_replay
from taic_jax.rl.rollout import Rollout, RolloutCarry, pack_metrics, rollout, rollout_metrics, start
from taic_jax.types import select


class Rule(NamedTuple):
    """The functions that set a learner apart, each of its config and the executor.

    `init_learnt(config, executor, observation_size, key)` returns all that gradient steps change, whose `policy` are
    the parameters of `make_policy(executor, config)`. `update(config, executor, learnt, batch, key)` takes one gradient
    step on M transitions, and returns the next of these and the `terms` of the loss.
    """

    make_policy: Callable[[Executor, Any], Any]
    init_learnt: Callable[[Any, Executor, int, Array], Any]
    update: Callable[[Any, Executor, Any, Transition, Array], tuple[Any, Array]]
    terms: tuple[str, ...]


class OffPolicyState(struct.PyTreeNode):
    """The whole state of training, saved and restored as one tree; `owed` are gradient steps not taken yet."""

    learnt: Any
    obs_statistics: normalize.Statistics
    replay: Replay
    pending: Transition
    running: RolloutCarry
    owed: Array
    key: Array
    iteration: Array


def make_optimizer() -> optax.GradientTransformation:
    """Return Adam on one flat vector, without the step size."""
    return optax.flatten(optax.scale_by_adam())


def descend(config: ReplayConfig, gradient: Any, params: Any, optimizer: optax.OptState) -> tuple[Any, optax.OptState]:
    """Take one step of Adam; return the next parameters and its next state."""
    with jax.numpy_dtype_promotion("standard"):  # Optax raises a float to an integer power
        updates, optimizer = make_optimizer().update(gradient, optimizer)
    return jax.tree.map(lambda p, u: p - config.learning_rate * u, params, updates), optimizer


def follow(config: ReplayConfig, targets: Any, params: Any) -> Any:
    """Return target parameters after they took over the share `tau` of the parameters."""
    return jax.tree.map(lambda old, new: old + config.tau * (new - old), targets, params)


def init(rule: Rule, config: ReplayConfig, env: Env, executor: Executor, key: Key[Array, ""]) -> OffPolicyState:
    """Return the state before the first iteration."""
    key, key_learnt, key_envs = jax.random.split(key, 3)
    goals = goals_of(config, env)
    sizes = env.observation_size, executor.option_size, executor.length, goals.size if goals else 0
    pending = init_pending(config.num_envs, *sizes)
    return OffPolicyState(
        learnt=rule.init_learnt(config, executor, env.observation_size, key_learnt),
        obs_statistics=normalize.init((env.observation_size,)),
        replay=init_replay(config.capacity, pending),
        pending=pending,
        running=start(AutoReset(env), executor, config.num_envs, key_envs, env.staggered),
        owed=jnp.zeros(()),
        key=key,
        iteration=jnp.zeros((), jnp.int32),
    )


def goals_of(config: ReplayConfig, env: Env) -> Goals | None:
    """Return the goals of the task for hindsight, or None without it."""
    return env.goals if config.relabel else None


def as_agent(rule: Rule, config: ReplayConfig, executor: Executor, state: OffPolicyState) -> Agent:
    """Return the agent trained so far."""
    return Agent(executor, state.learnt.policy, state.obs_statistics, rule.make_policy(executor, config))


def iterate(
    rule: Rule, config: ReplayConfig, env: Env, executor: Executor, num_iterations: int, state: OffPolicyState
) -> tuple[OffPolicyState, dict[str, Array], Rollout]:
    """Run one iteration: several rounds of ticks in B environments, each followed by its gradient steps.

    Returns the next state, the iteration's metrics and the rollout. Of all `num_iterations` the step size may decay.
    """
    if config.learning_rate_decay:
        left = 1.0 - state.iteration / num_iterations
        config = dataclasses.replace(config, learning_rate=left * config.learning_rate)
    key, key_rounds = jax.random.split(state.key)
    rounds = config.rollout_length // config.update_every
    step = partial(_round, rule, config, env, executor)
    after, (ticks, terms, codes) = jax.lax.scan(step, state, jax.random.split(key_rounds, rounds))
    ticks = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), ticks)
    after = after.replace(key=key, iteration=state.iteration + 1)
    metrics = dict(zip(rule.terms, jnp.mean(terms, axis=0), strict=True))
    metrics |= rollout_metrics(after.running, ticks, executor.length)
    return after, metrics | {"nonfinite": earliest(codes)}, ticks


def _round(
    rule: Rule, config: ReplayConfig, env: Env, executor: Executor, state: OffPolicyState, key: Key[Array, ""]
) -> tuple[OffPolicyState, tuple[Rollout, Array, Array]]:
    """Take ticks, add the decisions that ended to the buffer, and learn from it."""
    key_rollout, key_update = jax.random.split(key)
    seen = state.iteration * config.rollout_length * config.num_envs
    warm = seen >= config.warmup
    running, ticks = collect(as_agent(rule, config, executor, state), config, env, state.running, warm, key_rollout)
    goals = goals_of(config, env)
    pending, transitions = complete(state.pending, ticks, config.gamma, goals)
    replay = add(state.replay, transitions, ticks.ended)
    owed = state.owed + jnp.where(warm, config.updates_per_decision * jnp.sum(ticks.ended, dtype=jnp.float32), 0.0)
    statistics = normalize.update(state.obs_statistics, with_achieved_goals(ticks, goals))
    state = state.replace(obs_statistics=statistics, replay=replay, pending=pending, running=running)
    learnt, terms = improve(rule, config, goals, executor, state, jnp.floor(owed), key_update)
    code = first_nonfinite(
        action=ticks.action, physics=running.env.physics, observation=(ticks.obs, ticks.final_obs),
        reward=ticks.reward, loss=terms, gradient=learnt,
    )  # fmt: skip
    return state.replace(learnt=learnt, owed=owed - jnp.floor(owed)), (ticks, terms, code)


def with_achieved_goals(ticks: Rollout, goals: Goals | None) -> Float[Array, "N B S"]:
    """Return the observations of ticks [T, B]; for hindsight N is 2 T, and the second half aims at goals achieved.

    Statistics of a goal that is always the same would take every other one for an outlier, and clip it.
    """
    if goals is None:
        return ticks.obs
    aimed = jax.vmap(jax.vmap(lambda obs, after: goals.aim(obs, goals.achieved(after))))(ticks.obs, ticks.final_obs)
    return jnp.concatenate([ticks.obs, aimed])


def collect(
    agent: Agent, config: ReplayConfig, env: Env, running: RolloutCarry, warm: Bool[Array, ""], key: Key[Array, ""]
) -> tuple[RolloutCarry, Rollout]:
    """Roll the policy out, or uniformly random options before the warm-up is over."""
    act = agent.decide()
    policy: Any = agent.policy

    def decide(obs: Array, noise: Array) -> tuple[Array, Array]:
        option, log_prob = act(obs, noise)
        return jnp.where(warm, option, policy.uniform(agent.params, noise)), log_prob

    return rollout(AutoReset(env), agent.executor, decide, running, key, config.update_every, keep=pack_metrics)


def improve(
    rule: Rule, config: ReplayConfig, goals: Goals | None, executor: Executor, state: OffPolicyState,
    count: Float[Array, ""], key: Key[Array, ""],
) -> tuple[Any, Float[Array, " terms"]]:  # fmt: skip
    """Take `count` gradient steps; return what is learnt and the mean terms, of zero for no step."""

    def step(index: Any, carry: tuple[Any, Array]) -> tuple[Any, Array]:
        key_sample, key_goal, key_update = jax.random.split(jax.random.fold_in(key, index), 3)
        horizon = config.horizon if goals else 0
        batch, later = sample(state.replay, key_sample, config.batch_size, state.pending, horizon)
        if goals:
            share = config.relabel / (config.relabel + 1)
            chosen = jax.random.bernoulli(key_goal, share, (config.batch_size,))
            batch = select(chosen, relabelled(batch, later, config.gamma, goals), batch)
        obs, next_obs = (normalize.normalize(state.obs_statistics, x) for x in (batch.obs, batch.next_obs))
        batch = batch.replace(obs=obs, next_obs=next_obs, reward=config.reward_scale * batch.reward)
        learnt, terms = rule.update(config, executor, carry[0], batch, key_update)
        return learnt, carry[1] + terms

    steps = count.astype(jnp.int32)
    learnt, terms = jax.lax.fori_loop(0, steps, step, (state.learnt, jnp.zeros(len(rule.terms))))
    return learnt, terms / jnp.maximum(count, 1.0)
