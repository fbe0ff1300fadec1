"""The parts that fields of the configuration are made of: types with bounds, and the error of a value outside."""

import math
from typing import Annotated, Any, Literal, NamedTuple


class ConfigError(ValueError):
    """A mistake in a configuration, in one line."""


def impossible(name: str, value: Any, expected: str, nearest: Any = math.inf) -> ConfigError:
    """Return the error for an impossible value, with the nearest valid one if there is one."""
    hint = "" if nearest == math.inf else f"; the nearest valid value is {nearest}"
    return ConfigError(f"{name}: expected {expected}, got {value}{hint}")


class Bounds(NamedTuple):
    """Closed interval of the numbers that a field may hold."""

    low: float
    high: float = math.inf


USUAL_BOUNDS: dict[Any, Bounds] = {int: Bounds(1), tuple[int, ...]: Bounds(1), float: Bounds(0)}
"""Bounds of a field that is not annotated with others, by its type."""

TINY = 1e-6
Natural = Annotated[int, Bounds(0)]
Positive = Annotated[float, Bounds(TINY)]
Share = Annotated[float, Bounds(0, 1)]
LogStd = Annotated[float, Bounds(-20, 2)]
Learner = Literal["ppo", "sac", "dqn"]
CONTINUOUS, DISCRETE = ("sac",), ("dqn",)
"""Learners of continuous options or actions alone, and of discrete ones alone."""
Shard = Literal["auto", "none", "seeds", "envs"]
Track = Literal["none", "wandb", "trackio"]
"""The axis to split over devices, and a tracker; no parts of an experiment, but needed without JAX."""
