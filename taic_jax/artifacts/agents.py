"""Trained agents [K] of a method as an artifact, whose description has the run's config."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from taic_jax.artifacts.models import (
    AGENTS,
    Body,
    check_description,
    describe,
    described,
    empty_model,
    for_seeds,
    load_artifact,
    read_body,
    rows_like,
    save_artifact,
    structure,
)
from taic_jax.artifacts.pretrained import locate
from taic_jax.config import COLLECT, TAIC, Config, ConfigError, PPOConfig, settings_of
from taic_jax.config.files import from_mapping
from taic_jax.envs.base import Env
from taic_jax.networks import PolicyParams
from taic_jax.options.execution import Executor, IdentityExecutor, make_executor
from taic_jax.options.model import OptionModel
from taic_jax.rl import normalize
from taic_jax.rl.agent import Agent
from taic_jax.rl.learner import learner_of
from taic_jax.runtime.checkpoint import ArtifactError
from taic_jax.runtime.files import DESCRIPTION

Weights = tuple[PolicyParams, normalize.Statistics]
"""A policy without its executor: its parameters, and the statistics that normalise its observations."""


class Description(NamedTuple):
    """Agents without their arrays: all that is needed to act with them."""

    body: Body
    observation_size: int
    method: str
    seeds: int
    config: Config


def save_agents(folder: Path, agents: Agent, env: Env, config: Config, method: str) -> None:
    """Save the agents [K] of a method as the artifact `folder`, or raise SaveError."""
    description = {
        "method": method,
        **describe(env),
        "observation_size": env.observation_size,
        "learner": (config.train if method == TAIC else config.collect).learner,
        "hidden_sizes": list(agents.policy.hidden_sizes),
        **(structure(config.options) if method == TAIC else {}),
        "seeds": len(jax.tree.leaves(agents.params)[0]),
        "config": dataclasses.asdict(config),
    }
    save_artifact(folder, agents, description)


def read_agents(folder: Path) -> Description:
    """Read the description of agents, or raise ArtifactError."""
    description = described(folder, "agents")
    try:
        size, method, seeds = (description[name] for name in ("observation_size", "method", "seeds"))
        return Description(read_body(folder), size, method, seeds, from_mapping(description["config"]))
    except (KeyError, ConfigError) as error:
        raise ArtifactError(f"{folder / DESCRIPTION}: expected the description of agents: {error}") from None


def load_agents(folder: Path) -> Agent:
    """Load agents [K], or raise ArtifactError if their files are damaged or of another structure."""
    description = read_agents(folder)
    return load_artifact(folder, "agents", rows_like(description.seeds, lambda: _empty_agent(description)))


def _empty_agent(description: Description) -> Agent:
    """Return an agent of this structure, whose numbers are not meaningful."""
    body, config = description.body, description.config
    if description.method == TAIC:
        executor: Executor = make_executor(config.options, empty_model(body, config.options))
        settings = settings_of(config.train)
    else:
        hold = config.options.length if description.method == "repeat" else 1
        executor, settings = IdentityExecutor(body.action_size, hold, body.discrete), settings_of(config.collect)
    size = description.observation_size
    policy = learner_of(settings).make_policy(executor, settings)
    return Agent(executor, policy.init(jax.random.key(0), size, 1.0), normalize.init((size,)), policy)


def load_taic(source: str, env: Env, config: Config) -> tuple[OptionModel, Weights]:
    """Load a run's options, fine-tuned if it did so, and its policies over them, for the seeds of another config.

    Seed k takes the k-th, modulo their number. Raise ArtifactError for another body, observation or structure.
    """
    folder = locate(source) / AGENTS / TAIC
    fields = {
        "learner": "ppo",
        "observation_size": env.observation_size,
        "hidden_sizes": list(config.train.ppo.hidden_sizes),
    }
    check_description(folder, "policy over options", env, fields | structure(config.options))
    agents: Any = load_agents(folder)
    return for_seeds(config.seeds, (agents.executor.model, (agents.params, agents.obs_statistics)))


def load_policy(source: str | Path, env: Env, config: PPOConfig, seeds: int) -> Weights:
    """Load the collector's policies [seeds] of a run on another task of the same body, or raise ArtifactError.

    Input weights of the proprioceptive slice are copied; other observations of `env` get zeros and new statistics.
    """
    folder = locate(source) / AGENTS / COLLECT
    check_description(folder, "flat policy", env, {"learner": "ppo", "hidden_sizes": list(config.hidden_sizes)})
    agents = load_agents(folder)
    params, statistics = for_seeds(seeds, (agents.params, agents.obs_statistics))
    fit = jax.vmap(lambda p, s: _fit(p, s, env.proprioceptive_size, env.observation_size))
    return fit(params, statistics)


def _fit(params: PolicyParams, statistics: normalize.Statistics, shared: int, size: int) -> Weights:
    """Copy the weights of the first `shared` inputs of a policy into one of `size` inputs."""

    def widen(layers: dict) -> dict:
        first = layers["params"]["Dense_0"]
        kernel = jnp.zeros((size, first["kernel"].shape[1])).at[:shared].set(first["kernel"][:shared])
        return {"params": {**layers["params"], "Dense_0": {**first, "kernel": kernel}}}

    params = params.replace(actor=widen(params.actor), critic=widen(params.critic))
    return params, normalize.carry_over(statistics, shared, size)
