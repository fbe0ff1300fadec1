"""One step of a stage: training of a policy on a task, or learning of options; both vmapped over rows of configs."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from taic_jax.analysis.evaluate import evaluate
from taic_jax.artifacts.experience import as_experience
from taic_jax.artifacts.models import Body
from taic_jax.config import COLLECT, PRACTISE, Config, OptionsConfig, ReplayConfig, replace, settings_of
from taic_jax.envs.base import Env
from taic_jax.networks import PolicyParams
from taic_jax.options import learning
from taic_jax.options.dataset import Dataset, Experience
from taic_jax.options.execution import Executor, IdentityExecutor, OptionExecutor, make_executor
from taic_jax.options.learning import LearnState
from taic_jax.options.model import OptionModel, make_networks
from taic_jax.rl import fine_tune, normalize, ppo, practise, refresh
from taic_jax.rl.agent import Agent
from taic_jax.rl.fine_tune import Tuned
from taic_jax.rl.learner import Settings, learner_of, num_iterations
from taic_jax.rl.off_policy import OffPolicyState
from taic_jax.rl.practise import Practising
from taic_jax.rl.refit import refit

STEPS_PER_LOG = 100


@dataclass(frozen=True)
class Trainer:
    """Flat control, configured by the learner of `collect`; options are actions, each applied for `hold` ticks."""

    env: Env
    config: Config
    ticks: int
    hold: int = 1
    model: OptionModel | None = None

    @property
    def settings(self) -> Settings:
        """Settings of the learner."""
        return self._within(settings_of(self.config.collect))

    def _within(self, settings: Settings) -> Settings:
        """Keep no more decisions than there are ticks."""
        if isinstance(settings, ReplayConfig):
            return replace(settings, "capacity", min(settings.capacity, self.ticks))
        return settings

    @property
    def executor(self) -> Executor:
        """The executor of the policy's options."""
        return IdentityExecutor(self.env.action_size, self.hold, self.env.discrete)

    @property
    def unit(self) -> int:
        """Ticks of one step."""
        return self.settings.num_envs * self.settings.rollout_length

    @property
    def num_steps(self) -> int:
        """Whole steps in the budget of ticks."""
        return num_iterations(self.settings, self.ticks)

    def init(self, key: Array) -> Any:
        """Return the state of an untrained policy."""
        return learner_of(self.settings).init(self.settings, self.env, self.executor, key)

    def begin(self, state: Any, params: PolicyParams, statistics: normalize.Statistics) -> Any:
        """Return the state of PPO with another policy's weights; it explores anew, with the config's deviation."""
        return state.replace(params=params.replace(log_std=state.params.log_std), obs_statistics=statistics)

    def step(self, state: Any) -> tuple[Any, dict, Experience | None]:
        """Run one iteration; return the next state, metrics and experience."""
        iterate = learner_of(self.settings).iterate
        state, metrics, ticks, *_ = iterate(self.settings, self.env, self.executor, self.num_steps, state)
        return state, metrics, as_experience(ticks, self.env.proprioceptive_size)

    def assess(self, key: Array, state: Any) -> dict[str, dict[str, Array]]:
        """Evaluate the policy with exploration, and with its mean options."""
        both = partial(evaluate, self.env, self.agent(state), key, self.config.evaluate.episodes)
        results = jax.vmap(both)(jnp.array([1.0, 0.0]))
        modes = ("return", "return_mean_option")
        return {mode: jax.tree.map(lambda x, i=i: x[i], results) for i, mode in enumerate(modes)}

    def agent(self, state: Any) -> Agent:
        """Return the policy with its executor, ready to act."""
        return learner_of(self.settings).as_agent(self.settings, self.executor, state)


class OptionTrainer(Trainer):
    """A policy over the options of a frozen model, configured by the learner of `train`."""

    @property
    def settings(self) -> Settings:
        """Settings of the learner."""
        return self._within(settings_of(self.config.train))

    @property
    def executor(self) -> OptionExecutor:
        """D and the termination rule."""
        assert self.model is not None
        return make_executor(self.config.options, self.model)


class PractiseTrainer(Trainer):
    """D of a model, by flat SAC on the task of going where codes say."""

    @property
    def settings(self) -> Settings:
        """Settings of SAC, with D's layers."""
        return self._within(practise.settings(self.config.practise, self.config.options))

    def init(self, key: Array) -> OffPolicyState:
        """Return the state whose actor is the learnt D."""
        assert self.model is not None
        state = super().init(key)
        learnt = state.learnt.replace(policy=practise.actor_of(self.model.params["decoder"], state.learnt.policy))
        return state.replace(learnt=learnt, obs_statistics=normalize.identity(self.env.observation_size))

    def step(self, state: OffPolicyState) -> tuple[OffPolicyState, dict, None]:
        """Run one iteration; return the next state and metrics."""
        return *super().step(state)[:2], None


class FineTuneTrainer(OptionTrainer):
    """A policy over options whose D is fine-tuned on the same ticks (§5)."""

    def init(self, key: Array) -> tuple[ppo.TrainState, Tuned]:
        """Return the state of an untrained policy, and the learnt D."""
        return super().init(key), fine_tune.init(self.config.train.ppo, self.executor)

    def begin(self, state: Any, params: PolicyParams, statistics: normalize.Statistics) -> Any:
        """Do so with the policy; D is that of the model."""
        return super().begin(state[0], params, statistics), state[1]

    def step(self, state: Any) -> tuple[Any, dict, None]:
        """Run one iteration of the policy and of D; return the next states and the metrics of both."""
        settings = self.config.train.ppo, self.config.train.fine_tune, self.env, self.executor, self.num_steps
        policy, tuned, metrics = fine_tune.iterate(*settings, *state)
        return (policy, tuned), metrics, None

    def agent(self, state: Any) -> Agent:
        """Return the policy over the fine-tuned options."""
        policy, tuned = state
        return ppo.as_agent(self.config.train.ppo, fine_tune.tuned_executor(self.executor, tuned.decoder), policy)


class RefreshTrainer(OptionTrainer):
    """A policy over options that are learnt further from its own: so many iterations and a refresh are one step."""

    @property
    def unit(self) -> int:
        """Ticks of one step."""
        return super().unit * self.config.options.refresh_every

    @property
    def num_steps(self) -> int:
        """Whole steps in the budget of ticks."""
        return super().num_steps // self.config.options.refresh_every

    def init(self, key: Array) -> tuple[Any, LearnState]:
        """Return the state of an untrained policy, and the learnt options."""
        learnt = refresh.init(self.config.options, self.executor.model, jax.random.fold_in(key, 1))
        return super().init(key), learnt

    def begin(self, state: Any, params: PolicyParams, statistics: normalize.Statistics) -> Any:
        """Do so with the policy; the options are those of the model."""
        return super().begin(state[0], params, statistics), state[1]

    def step(self, state: Any) -> tuple[Any, dict, None]:
        """Run the iterations of the policy, then refresh; return the next states and the metrics of both."""
        options = self.config.options
        iterations = self.num_steps * options.refresh_every
        policy, learnt, metrics = refresh.iterate(options, self.settings, self.env, self.executor, iterations, *state)
        return (policy, learnt), metrics, None

    def agent(self, state: Any) -> Agent:
        """Return the policy over the refreshed options."""
        policy, learnt = state
        executor = refresh.refreshed_executor(self.executor, learnt)
        return learner_of(self.settings).as_agent(self.settings, executor, policy)


Row = tuple[Config, OptionModel | None]
"""The arrays that set one trainer apart from another of its stage; rows [K] have a leading axis."""


def make_trainer(stage: str, env: Env, config: Config, model: OptionModel | None = None) -> Trainer:
    """Return the trainer of a stage: `collect`, `practise` or `train` with a model, or one of `train.baselines`."""
    if stage == PRACTISE:
        assert model is not None
        task = Practising(env, config.options, config.practise, model)
        return PractiseTrainer(task, config, config.practise.ticks, model=model)
    if model is not None:
        kind = RefreshTrainer if config.options.refresh_every else OptionTrainer
        kind = FineTuneTrainer if config.train.fine_tune.epochs else kind
        return kind(env, config, config.train.ticks, model=model)
    ticks = {COLLECT: config.collect.ticks, "total": config.collect.ticks + config.train.ticks}
    hold = config.options.length if stage == "repeat" else 1
    return Trainer(env, config, ticks.get(stage, config.train.ticks), hold)


# A trainer is made within the program that uses it: as an argument it would put its environment into JAX's caches,
# which outlive the run. `make` is `make_trainer` of a stage and an environment.


def init_rows(make: Callable[..., Trainer], rows: Row, keys: Array) -> Any:
    """Return the states [K] of untrained policies."""
    return jax.vmap(lambda row, key: make(*row).init(key))(rows, keys)


def step_rows(make: Callable[..., Trainer], states: Any, rows: Row) -> tuple[Any, dict, Any]:
    """Run one iteration of every row."""
    return jax.vmap(lambda state, row: make(*row).step(state))(states, rows)


def assess_rows(make: Callable[..., Trainer], rows: Row, keys: Array, states: Any) -> dict[str, dict[str, Array]]:
    """Evaluate every row."""
    return jax.vmap(lambda row, key, state: make(*row).assess(key, state))(rows, keys, states)


def agents_of_rows(make: Callable[..., Trainer], rows: Row, states: Any) -> Agent:
    """Return the agents [K] of all rows, ready to act."""
    return jax.vmap(lambda row, state: make(*row).agent(state))(rows, states)


def init_learning(env: Env | Body, config: OptionsConfig, keys: Array) -> LearnState:
    """Return the states [K] before the first gradient step, for configs [K]."""
    networks = make_networks(config, env.proprioceptive_size, env.action_size, env.discrete, env.heading)
    return jax.vmap(lambda config, key: learning.init(config, networks, key))(config, keys)


def learn_rows(states: LearnState, config: OptionsConfig, dataset: Dataset) -> tuple[LearnState, dict, None]:
    """Take the gradient steps between two log lines, of every row."""
    unit = steps_per_log(config)
    return jax.vmap(lambda state, config, data: learning.steps(config, unit, state, data))(states, config, dataset)


def books_of_rows(config: OptionsConfig, states: LearnState, dataset: Dataset) -> Array:
    """Return the code books [K, M, D] of learnt models."""
    return jax.vmap(learning.code_book)(config, states, dataset)


def steps_per_log(config: OptionsConfig) -> int:
    """Return the gradient steps of one step of stage learn, a divisor of their total."""
    return max(n for n in range(1, STEPS_PER_LOG + 1) if config.steps % n == 0)


def refit_rows(env: Env, config: Config, models: OptionModel, keys: Array) -> tuple[OptionModel, dict[str, Array]]:
    """Refit E, P and F of practised models [K]."""

    def one(config: Config, model: OptionModel, key: Array) -> tuple[OptionModel, dict[str, Array]]:
        return refit(config.options, config.practise, env, model, key)

    return jax.vmap(one)(config, models, keys)


class Trained(NamedTuple):
    """A trained policy per seed, leading axis K, and its evaluations before and after training."""

    agent: Agent
    first: dict[str, dict[str, Array]]
    last: dict[str, dict[str, Array]]
