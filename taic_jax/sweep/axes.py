"""Axes of a sweep: fields and their values, the points they span, and the chunks of points for one program."""

import dataclasses
import itertools
import math
import random
from collections.abc import Sequence
from typing import Any

from taic_jax.config import Config, ConfigError, field_types, replace, walk
from taic_jax.config.checks import validate
from taic_jax.config.files import from_text, nearest

RANGE = ".."
STATIC_FLOATS = "env."  # prefix of numbers that are constants of a program: environments are made outside of it

Point = dict[str, Any]  # values by the dotted names of their fields


@dataclasses.dataclass(frozen=True)
class Axis:
    """A field and its values, or an interval to draw them from."""

    name: str
    values: tuple[Any, ...] = ()
    low: float = 0.0
    high: float = 0.0
    logarithmic: bool = False

    @property
    def bounds(self) -> tuple[float, float]:
        """The least and the largest value of a number."""
        return (self.low, self.high) if self.is_range else (min(self.values), max(self.values))

    @property
    def is_range(self) -> bool:
        """Whether values are drawn from an interval."""
        return not self.values

    def draw(self, generator: random.Random) -> Any:
        """Return a random value: one of the values, or uniform in the interval, or in its logarithm."""
        if not self.is_range:
            return generator.choice(self.values)
        if self.logarithmic:
            return math.exp(generator.uniform(math.log(self.low), math.log(self.high)))
        return generator.uniform(self.low, self.high)


def parse_axis(text: str) -> Axis:
    """Read FIELD=V1,V2,... or FIELD=LOW..HIGH or FIELD=LOW..HIGH:log, or raise ConfigError."""
    name, equals, values = text.partition("=")
    kinds, name = field_types(), name.strip().replace("-", "_")
    if name not in kinds or not equals:
        problem = f"unknown field {name!r}" if equals else f"expected FIELD=VALUES, got {text!r}"
        raise ConfigError(f"--axes: {problem}{nearest(name, kinds)}")
    if name in ("seed", "seeds"):
        raise ConfigError(f"--axes: {name}: every point runs the same seeds; give them by --seed and --seeds")
    if not values:
        raise ConfigError(f"--axes: {name}: expected values with commas between, got none")
    if RANGE not in values:
        return Axis(name, tuple(from_text(f"--axes: {name}", kinds[name], x.strip()) for x in values.split(",")))
    if not is_leaf(name):
        raise ConfigError(f"--axes: {name}: an interval is for numbers that one program can vary, got {values!r}")
    interval, _, scale = values.partition(":")
    low, high = (from_text(f"--axes: {name}", float, x.strip()) for x in interval.split(RANGE, 1))
    if scale not in ("", "log") or not low < high or (scale and low <= 0):
        expected = "LOW..HIGH, or LOW..HIGH:log with 0 < LOW < HIGH"
        raise ConfigError(f"--axes: {name}: expected {expected}, got {values!r}")
    return Axis(name, (), low, high, bool(scale))


def is_leaf(name: str) -> bool:
    """Return whether one program can run many values of this field."""
    return type(dict(walk(Config()))[name]) is float and not name.startswith(STATIC_FLOATS)


def grid(axes: Sequence[Axis]) -> list[Point]:
    """Return every combination of the axes' values, or raise ConfigError for an interval."""
    for axis in axes:
        if axis.is_range:
            raise ConfigError(f"--axes: {axis.name}: an interval needs --samples or --optuna; a grid takes values")
    names = [axis.name for axis in axes]
    return [dict(zip(names, values, strict=True)) for values in itertools.product(*(axis.values for axis in axes))]


def sample(axes: Sequence[Axis], count: int, seed: int) -> list[Point]:
    """Return random points."""
    generator = random.Random(seed)
    return [{axis.name: axis.draw(generator) for axis in axes} for _ in range(count)]


def configs_of(config: Config, points: Sequence[Point]) -> list[Config]:
    """Return the config of each point, or raise ConfigError with the name of an impossible point."""
    result = []
    for point in points:
        result.append(config)
        for name, value in point.items():
            result[-1] = replace(result[-1], name, value)
        try:
            validate(result[-1])
        except ConfigError as error:
            raise ConfigError(f"--axes: point {show(point)}: {error}") from None
    return result


def chunks(points: Sequence[Point], size: int) -> list[list[int]]:
    """Cut the indices of points into chunks of at most `size` points that share every static field."""
    groups: dict[str, list[int]] = {}
    for i, point in enumerate(points):
        static = sorted((name, value) for name, value in point.items() if not is_leaf(name))
        groups.setdefault(repr(static), []).append(i)
    return [group[i : i + size] for group in groups.values() for i in range(0, len(group), size)]


def show(point: Point) -> str:
    """Return a point in one line."""
    texts = {name: f"{value:g}" if isinstance(value, float) else value for name, value in point.items()}
    return " ".join(f"{name}={text}" for name, text in texts.items())
