"""All that a run starts from: its environments, and the parts that it takes from another run."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax
import psutil

from taic_jax.artifacts.agents import Weights, load_policy, load_taic
from taic_jax.artifacts.experience import gather_experience
from taic_jax.artifacts.models import Body, describe, load_options
from taic_jax.config import (
    COLLECT,
    PRACTISE,
    Config,
    ConfigError,
    DQNConfig,
    ReplayConfig,
    impossible,
    settings_of,
)
from taic_jax.config.base import CONTINUOUS, DISCRETE
from taic_jax.envs import environment_options, make_env
from taic_jax.envs.base import Env
from taic_jax.envs.errors import UnknownNameError
from taic_jax.options.model import OptionModel
from taic_jax.summary import replay_sizes


def make_envs(config: Config) -> tuple[Env, Env]:
    """Return the task and the environment of stage collect.

    Raises:
      ConfigError: there is no such environment, or options learnt in one do not fit the other.
    """
    options = dataclasses.asdict(config.env)
    field, name = "env.name", options.pop("name")
    try:
        env = source = make_env(name, **options)
        if config.collect.env:
            field, name = "collect.env", config.collect.env
            shared = ("backend", "num_threads", *environment_options(name))
            source = make_env(name, **{option: options[option] for option in shared})
    except UnknownNameError as error:
        raise ConfigError(f"{field}: {error}") from None
    bodies = [(*describe(e).values(),)[1:-2] for e in (source, env)]
    if bodies[0] != bodies[1]:
        expected = f"the body of {config.env.name} (proprioceptive slice, its size, and action size {bodies[1]})"
        raise impossible("collect.env", f"{config.collect.env} with {bodies[0]}", expected)
    if config.train.ppo.reset_at_change and "changed" not in jax.eval_shape(env.reset, jax.random.key(0)).metrics:
        expected = "a task that changes, as nav2d does with env.change_after"
        raise impossible("train.ppo.reset_at_change", f"{config.env.name}, which never does", expected, False)
    check_sides(config, source)
    if config.options.length > (longest := env.episode_length):
        expected = f"at most the {longest} ticks of an episode of {env.name}"
        raise impossible("options.length", config.options.length, expected, longest)
    for name, group, task in (("collect", config.collect, source), ("train", config.train, env)):
        learner = settings_of(group)
        if isinstance(learner, ReplayConfig) and learner.relabel and task.goals is None:
            expected = "a task with goals in its observations, as nav2d_random and the arenas have"
            got = f"{learner.relabel} on {task.name}, which has none"
            raise impossible(f"{name}.{group.learner}.relabel", got, expected, 0)
    _check_actions(config, env, source)
    return env, source


def check_sides(config: Config, source: Env | Body) -> None:
    """Raise ConfigError if options need a heading, or equal sides, that the body lacks."""
    options = config.options
    for field, value, neutral in (("frame", options.frame, "world"), ("way_weight", options.way_weight, 0)):
        if value != neutral and source.heading is None:
            got = f"{value} with {source.name}, which has none"
            raise impossible(f"options.{field}", got, "a body with a heading, as ant has", neutral)
    if options.views == "all" and len(source.views) == 1 and not options.source:
        expected = "a body with several equal sides, as ant has"
        raise impossible("options.views", f"all with {source.name}, which has one", expected, "one")


def _check_actions(config: Config, env: Env, source: Env) -> None:
    """Raise ConfigError for what does not fit the kind of actions: a flat learner, or noise on D's actions."""
    if config.collect.learner in (CONTINUOUS if source.discrete else DISCRETE):
        kind, nearest = ("discrete", "dqn") if source.discrete else ("continuous", "sac")
        expected = f"ppo or {nearest} for {kind} actions, as of {source.name}"
        raise impossible("collect.learner", config.collect.learner, expected, nearest)
    if config.train.fine_tune.epochs and env.discrete:
        expected = f"none for discrete actions, as of {env.name}"
        raise impossible("train.fine_tune.epochs", config.train.fine_tune.epochs, expected, 0)


def check_memory(config: Config, env: Env, source: Env) -> None:
    """Raise ConfigError if a replay buffer alone is larger than the memory of the machine."""
    total = psutil.virtual_memory().total
    for name, size in replay_sizes(config, env, source).items():
        if size > total:
            group = {COLLECT: config.collect, PRACTISE: config.practise}.get(name, config.train)
            learner: Any = settings_of(group)
            field = f"{name}.{'dqn' if isinstance(learner, DQNConfig) else 'sac'}.capacity"
            fits = int(min(learner.capacity, group.ticks) * total / size / 2)
            expected = f"a buffer within the memory, {total / 2**30:.0f} GiB, for {config.seeds} seeds"
            raise impossible(field, learner.capacity, expected, fits)


class Inherited(NamedTuple):
    """The option models, the collector's policies and those over options [K] of another run, each None if not taken."""

    model: OptionModel | None = None
    flat: Weights | None = None
    policy: Weights | None = None


def take_over(config: Config, env: Env, source: Env) -> Inherited:
    """Return all that the config takes from another run; seed k takes the k-th, modulo their number.

    Experience is only checked, by reading that of one seed.

    Raises:
      ArtifactError: the source is missing, or has another body or another structure.
    """
    if not config.options.source:
        for name in config.options.experience:
            if name != COLLECT:
                gather_experience(Path(name), source, 1, config.options)
        return Inherited()
    name, flat, policy = config.options.source, None, None
    if config.train.init:
        model, policy = load_taic(name, env, config)
    else:
        model = load_options(name, env, config.options, config.seeds)
    if "transfer" in config.train.baselines:
        flat = load_policy(name, env, config.collect.ppo, config.seeds)
    return Inherited(model, flat, policy)
