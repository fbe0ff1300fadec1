"""What values a configuration may hold: bounds of every field, and how fields must fit each other."""

import math
from typing import Any

from taic_jax.config import CollectConfig, Config, ConfigError, OptionsConfig, TrainConfig, walk

# Closed intervals by a field's name, or its dotted name. Other integers are at least 1, other floats at least 0.
TINY = 1e-6
BOUNDS: dict[str, tuple[float, float]] = {
    "since": (0, 1),
    "until": (0, 1),
    "steps": (0, math.inf),
    "capacity": (0, math.inf),
    "change_after": (0, math.inf),
    "num_threads": (0, math.inf),
    "seed": (0, 2**31 - 1),
    "video_ticks": (0, math.inf),
    "clip": (TINY, math.inf),
    "delta": (TINY, math.inf),
    "train.fine_tune.epochs": (0, math.inf),
    "std": (TINY, math.inf),
    "fraction": (TINY, 1),
    "gamma": (0, 1),
    "lambda_": (0, 1),
    "log_std_init": (-20, 2),
    "log_std_reset": (-20, 2),
    "max_grad_norm": (TINY, math.inf),
}
MAY_BE_EMPTY = ("options.experience", "train.baselines")


def validate(config: Config) -> None:
    """Raise `ConfigError` at the first impossible value, naming field, value, expectation and nearest."""
    for name, value in walk(config):
        _check_bounds(name, value)
    for stage in ("collect", "train"):
        _check_sizes(stage, getattr(config, stage))
    ticks, length = config.train.ppo.rollout_length, config.options.length
    if length > ticks:
        raise _impossible("options.length", length, f"at most train.ppo.rollout_length = {ticks}", ticks)
    _check_options(config.options)
    _check_baselines(config)


def _check_baselines(config: Config) -> None:
    """Check what flat PPO beside the options needs; it is configured by `collect.ppo`."""
    ppo, baselines = config.collect.ppo, config.train.baselines
    ticks, length = ppo.num_envs * ppo.rollout_length, config.options.length
    if "transfer" in baselines and not config.options.source:
        needed = "a run with options and a flat policy"
        raise ConfigError(f"train.baselines: expected with transfer {needed}, got none: add --options RUN")
    if "repeat" in baselines and length > (longest := ppo.rollout_length):
        expected = f"with baseline repeat at most collect.ppo.rollout_length = {longest}"
        raise _impossible("options.length", length, expected, longest)
    if baselines and config.train.ticks < ticks:
        iteration = f"collect.ppo.num_envs * collect.ppo.rollout_length = {ticks}"
        raise _impossible("train.ticks", config.train.ticks, f"at least an iteration of baselines, {iteration}", ticks)


def _check_options(options: OptionsConfig) -> None:
    if options.source and options.experience:
        raise ConfigError(f"options.experience: expected none with options.source, got {list(options.experience)}")
    if options.shortest > options.length:
        expected = f"at most options.length = {options.length}"
        raise _impossible("options.shortest", options.shortest, expected, options.length)
    if options.delta_unit == "quantile" and options.delta > 1:
        raise _impossible("options.delta", options.delta, "at most 1, being a quantile", 1.0)
    if options.delta_unit == "quantile" and options.termination == "predict" and not options.steps:
        expected = "error with options.steps 0, where no error of P was measured"
        raise ConfigError(f"options.delta_unit: expected {expected}, got quantile; the nearest valid value is error")
    if options.since >= options.until:
        raise _impossible("options.since", options.since, f"less than options.until = {options.until}", 0.0)


def _check_bounds(name: str, value: Any) -> None:
    if value == () and name not in MAY_BE_EMPTY:
        raise ConfigError(f"{name}: expected at least one size, got none; the nearest valid value is 64")
    for number in value if isinstance(value, tuple) else (value,):
        if isinstance(number, bool) or not isinstance(number, int | float):
            continue
        bounds = BOUNDS.get(name.rpartition(".")[2], (1 if isinstance(number, int) else 0, math.inf))
        low, high = BOUNDS.get(name, bounds)
        if not (low <= number <= high and math.isfinite(number)):
            expected = f"at least {low}" if high == math.inf else f"in [{low}, {high}]"
            nearest = low if math.isnan(number) or number < low else high
            raise _impossible(name, value, f"a finite number {expected}", nearest)


def _check_sizes(stage: str, config: CollectConfig | TrainConfig) -> None:
    ppo, ticks = config.ppo, config.ppo.num_envs * config.ppo.rollout_length
    iteration = f"{stage}.ppo.num_envs * {stage}.ppo.rollout_length = {ticks}"
    if ppo.minibatch_size > ticks:
        raise _impossible(f"{stage}.ppo.minibatch_size", ppo.minibatch_size, f"at most {iteration}", ticks)
    fine = config.fine_tune if isinstance(config, TrainConfig) else None
    if fine and fine.epochs and fine.minibatch_size > ticks:
        raise _impossible(f"{stage}.fine_tune.minibatch_size", fine.minibatch_size, f"at most {iteration}", ticks)
    if config.ticks < ticks:
        raise _impossible(f"{stage}.ticks", config.ticks, f"at least one iteration, {iteration}", ticks)


def _impossible(name: str, value: Any, expected: str, nearest: int | float) -> ConfigError:
    hint = f"; the nearest valid value is {nearest}" if math.isfinite(nearest) else ""
    return ConfigError(f"{name}: expected {expected}, got {value!r}{hint}")
