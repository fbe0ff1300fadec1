"""The loops of ours that the benchmark measures: the engine alone, rollouts, and training, flat and over options.

Each function returns a loop to call repeatedly; the work of the function itself is not measured.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco.batch
import numpy as np
from jaxtyping import Array, Float

from taic_jax import envs
from taic_jax.artifacts.experience import as_experience
from taic_jax.config import OptionsConfig, PPOConfig
from taic_jax.experiments.benchmark.timing import Loop
from taic_jax.options.execution import Executor, IdentityExecutor, make_executor
from taic_jax.options.learning import learn
from taic_jax.rl import ppo
from taic_jax.rl.rollout import Rollout, rollout, start
from taic_jax.runtime.devices import Devices
from taic_jax.types import as_arrays

WORK = PPOConfig(num_envs=64, rollout_length=256, epochs=10, minibatch_size=512)
"""An iteration of training, everywhere here: 64 x 256 ticks, 10 epochs of 32 minibatches, 64x64 networks."""
VARIABLE_LENGTH = 10  # The most ticks of an option that may end earlier; those of termination fixed are 5 ticks long.
EXPERIENCE = 16, 1024  # Environments, and ticks of each, that options are learnt from.
ONE_DEVICE = Devices()
ITERATIONS = 100  # Iterations over which the step size decays; one is measured.


def has_engine(env: envs.Env) -> bool:
    """Return whether MuJoCo's C engine steps this task."""
    return hasattr(getattr(env, "physics", None), "engine")


def untrained_rollout(env: envs.Env, num_envs: int, length: int) -> Loop:
    """Return a compiled rollout of `length` ticks with an untrained policy; it returns the carry and the ticks."""
    executor, key = IdentityExecutor(env.action_size), jax.random.key(0)
    state = ppo.init(as_arrays(PPOConfig(num_envs=num_envs)), env, executor, key)
    decide = ppo.as_agent(PPOConfig(), executor, state).decide()
    wrapped = envs.AutoReset(env)
    compiled = jax.jit(lambda carry: rollout(wrapped, executor, decide, carry, key, length))
    return Loop(partial(compiled, start(wrapped, executor, num_envs, key)), num_envs * length)


def random_actions(env: envs.Env, num_envs: int, length: int) -> Float[Array, "T B A"]:
    """Draw actions from a uniform distribution."""
    return jax.random.uniform(jax.random.key(1), (length, num_envs, env.action_size), minval=-1.0)


def stepping(
    env: envs.Env,
    actions: Float[Array, "T B A"],
    read: Callable[[envs.State, Array, envs.State], Any] = lambda before, action, after: (before.obs, before.reward),
) -> Loop:
    """Return the task's own compiled loop: engine, rewards, time limit and automatic resets under these actions.

    It returns the last state, and `read` of each state, the action there, and the state after.
    """
    wrapped = envs.AutoReset(env)
    begin = jax.jit(jax.vmap(wrapped.reset))(jax.random.split(jax.random.key(0), actions.shape[1]))
    step = jax.vmap(wrapped.step)

    def tick(before: envs.State, action: Array) -> tuple[envs.State, Any]:
        after = step(before, action)
        return after, read(before, action, after)

    compiled = jax.jit(lambda state: jax.lax.scan(tick, state, actions))
    return Loop(partial(compiled, begin), actions[..., 0].size)


def bare_engine(env: envs.Env, actions: Float[Array, "T B A"]) -> Loop:
    """Return a loop over `mujoco.batch` from NumPy that steps the same states as `stepping`.

    The states are set at each tick: robots that nothing resets soon lie on the ground or fall through it, at another
    cost to the engine.
    """

    def sent(state: envs.State, action: Array, _: envs.State) -> Array:
        physics = state.physics
        return jnp.concatenate([physics.qpos, physics.qvel, physics.qacc_warmstart, action], axis=1)

    states = np.asarray(stepping(env, actions, sent).run()[1], np.float64)
    batch = mujoco.batch.Batch(env.model, actions.shape[1], env.physics.num_threads)
    rows = batch.state[:, 1 : 1 + states.shape[2]]  # behind the time

    def run() -> None:
        for row in states:
            rows[...] = row
            batch.step(nstep=env.physics.substeps)

    return Loop(run, actions[..., 0].size)


class Training:
    """A compiled iteration of PPO: rollout, advantages and all updates, of all seeds, split over devices."""

    def __init__(
        self, env: envs.Env, executor: Executor, config: PPOConfig, seeds: int = 1, devices: Devices = ONE_DEVICE
    ):
        self.ticks, self.duration = seeds * config.num_envs * config.rollout_length, 1.0
        arrays, keys = as_arrays(config), jax.random.split(jax.random.key(0), seeds)
        init = partial(ppo.init, arrays, env, executor)
        iterate = partial(ppo.iterate, arrays, env, executor, ITERATIONS)
        self.state = devices.place(jax.jit(jax.vmap(init))(keys) if seeds > 1 else jax.jit(init)(keys[0]))
        step = jax.vmap(lambda state: iterate(state)[:2]) if seeds > 1 else lambda state: iterate(state)[:2]
        self._step = devices.compile(step, self.state, donate=True)

    def __call__(self) -> None:
        """Train for one iteration."""
        self.state, metrics = jax.block_until_ready(self._step(self.state))
        self.duration = float(jnp.mean(metrics["duration"]))


def untrained_ticks(env: envs.Env) -> Rollout:
    """Return ticks [T, B] to learn options from: enough of each environment for a held-out part."""
    return untrained_rollout(env, *EXPERIENCE).run()[1]


def executor_of(env: envs.Env, config: OptionsConfig | None, ticks: Rollout | None = None) -> Executor:
    """Return options learnt from ticks of an untrained policy, or actions themselves without a config.

    The options' duration changes the speed, their quality does not. Raise `ShortExperienceError` if delta is a
    quantile, and the ticks are too few for a held-out part.
    """
    if config is None:
        return IdentityExecutor(env.action_size)
    experience = as_experience(untrained_ticks(env) if ticks is None else ticks, env.proprioceptive_size)
    model, _ = jax.jit(lambda experience: learn(config, experience, jax.random.key(0)))(experience)
    return make_executor(config, model)


def options_config(rule: str, decoder: str, steps: int, **changes: Any) -> OptionsConfig:
    """Return the options of one termination rule and decoder."""
    length = {} if rule == "fixed" else {"length": VARIABLE_LENGTH}
    settings: dict[str, Any] = {"termination": rule, "decoder": decoder, "steps": steps} | length | changes
    return OptionsConfig(**settings)
