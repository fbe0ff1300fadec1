"""Whole runs, as small as can be: their config, how to make them quick, and how to look at what they leave."""

import contextlib
import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taic_jax import trainer
from taic_jax.config import (
    CollectConfig,
    Config,
    DQNConfig,
    EvaluateConfig,
    OptionsConfig,
    PPOConfig,
    SACConfig,
    TrainConfig,
)
from taic_jax.runtime import driver
from taic_jax.runtime.checkpoint import Checkpoints, load_arrays
from taic_jax.runtime.run_folder import RunFolder

PPO = PPOConfig(num_envs=2, rollout_length=8, epochs=1, minibatch_size=16, hidden_sizes=(4,))
REPLAY = {
    "num_envs": 2, "rollout_length": 8, "update_every": 4, "warmup": 16, "capacity": 20, "batch_size": 4,
    "hidden_sizes": (4,),
}  # fmt: skip
SAC, DQN = SACConfig(**REPLAY), DQNConfig(**REPLAY)
CONFIG = Config(
    collect=CollectConfig(ticks=3 * 16, capacity=2 * 16, ppo=PPO, sac=SAC, dqn=DQN),
    options=OptionsConfig(length=2, size=2, hidden_size=4, mlp_sizes=(4,), steps=4, batch_size=8),
    train=TrainConfig(ticks=3 * 16, ppo=PPO, sac=SAC, dqn=DQN),
    evaluate=EvaluateConfig(episodes=2, video_ticks=3),
    seeds=2,
)

# A task for a run's folder, `slope.py:Slope`, on which learning changes the return.
SLOPE = """
from probes import NO, Probe


class Slope(Probe):
    name = "slope"
    episode_length = 8

    def move(self, x, action):
        return 0.5 * x + action, action - x, NO, NO
"""


def with_fields(config: Config, **fields: Any) -> Config:
    """Replace fields given by their dotted names, each dot written as two underscores."""
    for name, value in fields.items():
        config = _replace(config, name.split("__"), value)
    return config


def _replace(config: Any, path: list[str], value: Any) -> Any:
    value = _replace(getattr(config, path[0]), path[1:], value) if path[1:] else value
    return dataclasses.replace(config, **{path[0]: value})


@contextlib.contextmanager
def tiny_steps() -> Iterator[None]:
    """Save a checkpoint at every step, and log every second one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driver, "CHECKPOINT_SECONDS", 0.0)
        patch.setattr(trainer, "STEPS_PER_LOG", 2)
        yield


class KilledError(Exception):
    """The process died here."""


def die(monkeypatch: pytest.MonkeyPatch, owner: type, method: str, count: int) -> None:
    """Make the `count`-th call of a method from now on the last thing that happens."""
    original, calls = getattr(owner, method), []

    def dying(self, *args):
        calls.append(args)
        if len(calls) == count:
            raise KilledError
        return original(self, *args)

    monkeypatch.setattr(owner, method, dying)


def files_of(folder: Path) -> dict[str, bytes]:
    """Return what every file under a folder holds."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def methods_of(folder: Path) -> dict:
    """Return the evaluations of a finished run, by method."""
    return json.loads((folder / "summary.json").read_text())["methods"]


def rows_of(folder: Path) -> list[dict]:
    """Return the rows of the metrics in one order, without the time they were written."""
    rows = [{**row, "time": None} for row in RunFolder(folder).metrics()]
    return sorted(rows, key=lambda row: (row["stage"], row.get("ticks", row.get("steps")), sorted(row)))


def last_state(folder: Path, stage: str) -> dict[str, np.ndarray]:
    """Return the last checkpoint of a stage, array by array."""
    checkpoints = Checkpoints(folder / "checkpoints" / stage)
    return load_arrays(checkpoints.directory / str(checkpoints.latest_step()))


def assert_same_arrays(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> None:
    """Compare exactly."""
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)
