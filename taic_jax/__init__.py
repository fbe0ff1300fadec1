"""Temporal abstraction with information-theoretic constraints, trained end to end in JAX.

The names below are the whole public surface. They are imported on first use, so that the command line can answer
before JAX is loaded. None is the name of a module too: to import that module would put it in the name's place.
"""

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from taic_jax.analysis.evaluate import evaluate, record
    from taic_jax.analysis.measures import measure_option_space
    from taic_jax.analysis.statistics import bootstrap_interval, iqm
    from taic_jax.artifacts.experience import collect
    from taic_jax.artifacts.models import load_options
    from taic_jax.config import (
        CollectConfig,
        Config,
        EnvConfig,
        EvaluateConfig,
        FineTuneConfig,
        OptionsConfig,
        TrainConfig,
    )
    from taic_jax.config.files import load_config
    from taic_jax.config.learners import DQNConfig, PPOConfig, SACConfig
    from taic_jax.data.read import read_data
    from taic_jax.envs import AutoReset, Env, State, environment_names, make_env
    from taic_jax.envs.adapters import to_gymnasium
    from taic_jax.handles.load import Handle, load
    from taic_jax.options.dataset import Experience
    from taic_jax.options.execution import Executor, IdentityExecutor, OptionExecutor, make_executor
    from taic_jax.options.learning import learn
    from taic_jax.options.model import OptionModel
    from taic_jax.pipeline import run_pipeline
    from taic_jax.rl.agent import Agent
    from taic_jax.rl.learner import train

_MODULES = {
    "analysis.evaluate": "evaluate record",
    "analysis.measures": "measure_option_space",
    "analysis.statistics": "bootstrap_interval iqm",
    "config": "CollectConfig Config EnvConfig EvaluateConfig FineTuneConfig OptionsConfig TrainConfig",
    "config.learners": "DQNConfig PPOConfig SACConfig",
    "config.files": "load_config",
    "data.read": "read_data",
    "envs": "AutoReset Env State environment_names make_env",
    "envs.adapters": "to_gymnasium",
    "artifacts.experience": "collect",
    "artifacts.models": "load_options",
    "handles.load": "Handle load",
    "options.dataset": "Experience",
    "options.execution": "Executor IdentityExecutor OptionExecutor make_executor",
    "options.learning": "learn",
    "options.model": "OptionModel",
    "pipeline": "run_pipeline",
    "rl.agent": "Agent",
    "rl.learner": "train",
}
_HOME = {name: module for module, names in _MODULES.items() for name in names.split()}

__all__ = sorted(["__version__", *_HOME])  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'taic_jax' has no attribute {name!r}")
    return getattr(importlib.import_module(f"taic_jax.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return __all__
