"""A finished run, or an artifact, as an object: its config, environment, option models and agents."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from taic_jax.artifacts.agents import load_agents, read_agents
from taic_jax.artifacts.models import (
    AGENTS,
    DATA,
    EARLIER,
    OPTIONS,
    STRUCTURE,
    described,
    load_options,
    read_body,
)
from taic_jax.artifacts.pretrained import locate
from taic_jax.config import TAIC, CollectConfig, Config, ConfigError
from taic_jax.config.files import from_mapping
from taic_jax.data.arrays import Place
from taic_jax.data.read import bounds_of
from taic_jax.envs.base import Env
from taic_jax.options.model import OptionModel, Scale
from taic_jax.rl.agent import Agent
from taic_jax.runtime.checkpoint import ArtifactError
from taic_jax.runtime.files import read_description
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.types import Seeds


@dataclass(frozen=True)
class Handle:
    """All that a run leaves to act with; `agents` are those of each method: `taic`, the baselines, and `collect`."""

    config: Config
    agents: Mapping[str, Seeds[Agent]]
    models: Seeds[OptionModel] | None = None

    @property
    def options(self) -> Seeds[OptionModel]:
        """The option models that `taic` acts with, fine-tuned if the run did so; ArtifactError for a baseline alone."""
        if self.models is None:
            raise ArtifactError(f"expected options, got the agents of {', '.join(self.agents)} alone")
        return self.models

    @cached_property
    def env(self) -> Env:
        """The task."""
        from taic_jax.sources import make_envs  # its imports take a second, and acting needs none

        if self.config.env.name == DATA:
            raise ConfigError("--env.name: expected a task of the same sizes, since options learnt from data have none")
        with jax.ensure_compile_time_eval():  # its first use may be in a function that is traced
            return make_envs(dataclasses.replace(self.config, collect=CollectConfig()))[0]


def load(source: str | Path) -> Handle:
    """Load a finished run by its folder, `pretrained:NAME`, or an artifact of a run, `options` or `agents/METHOD`.

    Raises:
      ArtifactError: there is none, the run was not finished, or its files are damaged or of a later version.
      ConfigError: the config of the run is of another version.
    """
    path = locate(source)
    run = RunFolder(path)
    if run.begun and not run.finished:
        raise ArtifactError(f"{path}: expected a finished run, got one that --resume goes on with")
    if run.begun or (path / AGENTS).is_dir():
        folders = sorted(folder for folder in (path / AGENTS).glob("*") if folder.is_dir())
        if not folders and (path / OPTIONS).is_dir() and read_body(path / OPTIONS).proprioception == DATA:
            return _load_model(path / OPTIONS, run.config())
        if path / AGENTS / TAIC not in folders:
            raise ArtifactError(f"{path / AGENTS}: expected the agents that a run of this version leaves, got none")
        agents = {folder.name: Seeds(load_agents(folder)) for folder in folders}
        return _handle(read_agents(path / AGENTS / TAIC).config, agents)
    description = read_description(path)
    if description is None:
        raise ArtifactError(f"{path}: expected the folder of a run, or of an artifact of one; got neither")
    if "method" in description:
        return _handle(read_agents(path).config, {description["method"]: Seeds(load_agents(path))})
    structure = {name: (EARLIER | description).get(f"options.{name}") for name in STRUCTURE}
    return _load_model(path, from_mapping({"env": {"name": read_body(path).name}, "options": structure}))


def _handle(config: Config, agents: dict[str, Seeds[Agent]]) -> Handle:
    executor: Any = agents[TAIC].rows.executor if TAIC in agents else None
    return Handle(config, agents, executor and Seeds(executor.model))


def _load_model(path: Path, config: Config) -> Handle:
    """Return the handle of option models, with the scale of their actions if they were learnt from recorded data."""
    body, seeds = read_body(path), described(path, "option model")["seeds"]
    models = load_options(path, body, config.options, seeds)
    if body.action_bounds:
        low, high = bounds_of(Place(path, "action_bounds"), body.action_bounds, body.action_size)
        scale = Scale(*(jnp.tile(x, (seeds, 1)) for x in ((low + high) / 2, (high - low) / 2)))
        models = models.replace(action_scale=scale)
    return Handle(config, {}, Seeds(models))
