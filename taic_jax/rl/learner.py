"""The learners of a policy, PPO, SAC and DQN, behind the same functions."""

from functools import partial
from types import ModuleType

import jax
from jaxtyping import Array, Key

from taic_jax.config import DQNConfig, PPOConfig, SACConfig
from taic_jax.envs.base import Env
from taic_jax.options.execution import Executor
from taic_jax.rl import dqn, ppo, sac
from taic_jax.rl.agent import Agent
from taic_jax.types import as_arrays

Settings = PPOConfig | SACConfig | DQNConfig


def learner_of(settings: Settings) -> ModuleType:
    """Return `ppo`, `sac` or `dqn`: modules with the functions `init`, `iterate`, `as_agent` and `make_policy`."""
    return {PPOConfig: ppo, SACConfig: sac, DQNConfig: dqn}[type(settings)]


def num_iterations(settings: Settings, ticks: int) -> int:
    """Return the number of whole iterations in a budget of ticks."""
    return ticks // (settings.num_envs * settings.rollout_length)


def train(
    settings: Settings, env: Env, executor: Executor, key: Key[Array, ""], ticks: int
) -> tuple[Agent, dict[str, Array]]:
    """Train a policy over the executor's options for `ticks` interactions; pure, so keys may be vmapped.

    Returns the agent and the metrics of every iteration, leading axis the iteration.
    """
    learner, settings = learner_of(settings), as_arrays(settings)
    iterations = num_iterations(settings, ticks)
    step = partial(learner.iterate, settings, env, executor, iterations)
    state = learner.init(settings, env, executor, key)
    state, metrics = jax.lax.scan(lambda s, _: step(s)[:2], state, None, iterations)
    return learner.as_agent(settings, executor, state), metrics
