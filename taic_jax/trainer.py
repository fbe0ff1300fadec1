"""Training of one policy on one task, for one seed: stages drive it, vmapped over seeds."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from taic_jax.analysis.evaluate import evaluate
from taic_jax.artifacts.experience import as_experience
from taic_jax.config import FineTuneConfig, PPOConfig
from taic_jax.envs.base import Env
from taic_jax.options.dataset import Experience
from taic_jax.options.execution import Executor
from taic_jax.options.model import OptionModel
from taic_jax.rl import fine_tune, ppo
from taic_jax.rl.fine_tune import Tuned


@dataclass(frozen=True)
class Trainer:
    """Flat control, or a policy over frozen options: the methods are vmapped over keys, states and models.

    `executor_of` takes the option model, or nothing where options are actions.
    """

    env: Env
    config: PPOConfig
    ticks: int
    episodes: int
    executor_of: Callable[..., Executor]

    @property
    def unit(self) -> int:
        """Ticks of one step."""
        return self.config.num_envs * self.config.rollout_length

    @property
    def num_steps(self) -> int:
        """How many steps the budget buys."""
        return self.ticks // self.unit

    def init(self, key: Array, *model: OptionModel) -> Any:
        """Return the state of an untrained policy."""
        return ppo.init(self.config, self.env, self.executor_of(*model), key)

    def step(self, state: Any, *model: OptionModel) -> tuple[Any, dict, Experience | None]:
        """Run one iteration; return its metrics and its experience."""
        executor = self.executor_of(*model)
        state, metrics, rollout = ppo.iterate(self.config, self.env, executor, self.num_steps, state)
        return state, metrics, as_experience(rollout, self.env.proprioceptive_size)

    def assess(self, key: Array, state: Any, *model: OptionModel) -> dict[str, dict[str, Array]]:
        """Evaluate the policy as it explores, and taking its mean options."""
        both = partial(evaluate, self.env, self.agent(state, *model), key, self.episodes)
        results = jax.vmap(both)(jnp.array([1.0, 0.0]))
        modes = ("return", "return_mean_option")
        return {mode: jax.tree.map(lambda x, i=i: x[i], results) for i, mode in enumerate(modes)}

    def agent(self, state: Any, *model: OptionModel) -> ppo.Agent:
        """Return what acts."""
        return ppo.as_agent(self.config, self.executor_of(*model), state)


@dataclass(frozen=True)
class FineTuneTrainer(Trainer):
    """A policy over options whose D is fine-tuned on the same ticks."""

    fine_tune: FineTuneConfig

    def init(self, key: Array, *model: OptionModel) -> tuple[ppo.TrainState, Tuned]:
        """Return the state of an untrained policy, and the learnt D."""
        executor: Any = self.executor_of(*model)
        return super().init(key, *model), fine_tune.init(self.config, executor)

    def step(self, state: Any, *model: OptionModel) -> tuple[Any, dict, None]:
        """Run one iteration of the policy and of D; return the metrics of both."""
        learnt: Any = self.executor_of(*model)
        policy, tuned, metrics = fine_tune.iterate(
            self.config, self.fine_tune, self.env, learnt, self.num_steps, *state
        )
        return (policy, tuned), metrics, None

    def agent(self, state: Any, *model: OptionModel) -> ppo.Agent:
        """Return what acts: the policy over the fine-tuned options."""
        learnt: Any = self.executor_of(*model)
        policy, tuned = state
        return ppo.as_agent(self.config, fine_tune.tuned_executor(learnt, tuned.decoder), policy)


class Trained(NamedTuple):
    """What training one policy per seed gives, leading axis K."""

    agent: ppo.Agent
    first: dict[str, dict[str, Array]]  # evaluation of the untrained policy
    last: dict[str, dict[str, Array]]
