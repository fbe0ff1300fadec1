"""The environments that a config names, and whether the rest of it fits them."""

import dataclasses

import jax

from taic_jax.artifacts.models import describe
from taic_jax.config import Config, ConfigError
from taic_jax.envs import environment_options, make_env
from taic_jax.envs.base import Env
from taic_jax.envs.errors import UnknownNameError


def make_envs(config: Config) -> tuple[Env, Env]:
    """Return the task and the environment that experience is collected in.

    Raises:
      ConfigError: there is no such environment, or options learnt in one do not fit the other.
    """
    options = dataclasses.asdict(config.env)
    field, name = "env.name", options.pop("name")
    try:
        env = source = make_env(name, **options)
        if config.collect.env:
            field, name = "collect.env", config.collect.env
            kept = ("backend", "num_threads", *environment_options(name))
            source = make_env(name, **{option: options[option] for option in kept})
    except UnknownNameError as error:
        raise ConfigError(f"{field}: {error}") from None
    bodies = [(*describe(e).values(),)[1:] for e in (source, env)]
    if bodies[0] != bodies[1]:
        raise ConfigError(
            f"collect.env: expected the body of {config.env.name} (proprioceptive slice, its size, and action size "
            f"{bodies[1]}), got {config.collect.env} with {bodies[0]}"
        )
    if config.train.ppo.reset_at_change and "changed" not in jax.eval_shape(env.reset, jax.random.key(0)).metrics:
        raise ConfigError(
            f"train.ppo.reset_at_change: expected a task that changes, as nav2d does with env.change_after, "
            f"got {config.env.name}, which never does; the nearest valid value is False"
        )
    if config.options.views == "all" and len(source.views) == 1 and not config.options.source:
        raise ConfigError(
            f"options.views: expected a body with several equal sides, as ant has, got all with {source.name}, "
            "which has one; the nearest valid value is one"
        )
    if config.options.length > env.episode_length:
        raise ConfigError(
            f"options.length: expected at most the {env.episode_length} ticks of an episode of {env.name}, "
            f"got {config.options.length}; the nearest valid value is {env.episode_length}"
        )
    return env, source
