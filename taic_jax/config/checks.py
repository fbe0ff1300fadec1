"""Checks of a configuration: bounds of fields, and values that do not go together."""

import math
from operator import ge, le
from typing import Annotated, Any, get_args, get_origin

from taic_jax.config import USUAL_BOUNDS, Config, SACConfig, field_types, impossible, walk
from taic_jax.config.base import CONTINUOUS, DISCRETE

REPLAYS = ("collect.sac", "collect.dqn", "practise.sac", "train.sac", "train.dqn")


def validate(config: Config) -> None:
    """Raise `ConfigError` at the first impossible value, naming field, value, expectation and nearest."""
    types = field_types(bounds=True)
    for name, value in walk(config):
        _check_bounds(name, types[name], value)
    _check_limits(config)
    options, baselines = config.options, config.train.baselines
    if options.source and options.experience:
        raise impossible("options.experience", list(options.experience), "none with options.source")
    if options.delta_unit == "quantile" and options.delta > 1:
        raise impossible("options.delta", options.delta, "at most 1, being a quantile", 1.0)
    if options.delta_unit == "quantile" and options.termination == "predict" and not options.steps:
        expected = "error with options.steps 0, where no error of P was measured"
        raise impossible("options.delta_unit", "quantile", expected, "error")
    if options.since >= options.until:
        raise impossible("options.since", options.since, f"less than options.until = {options.until}", 0.0)
    if config.train.init and config.train.init != options.source:
        raise impossible(
            "options.source", repr(options.source), "the run that train.init names", repr(config.train.init)
        )
    if options.refresh_every and config.train.fine_tune.epochs:
        expected = "0 with train.fine_tune.epochs, which changes D too"
        raise impossible("options.refresh_every", options.refresh_every, expected, 0)
    _check_learners(config)
    _check_steering(config)
    if "transfer" in baselines and not options.source:
        expected = "with transfer a run with options and a flat policy"
        raise impossible("train.baselines", "none: add --options RUN", expected)


def _check_steering(config: Config) -> None:
    """Check that D stays as it is if options are chosen by their way; and that a choice by the way, or practice, has
    what it needs: codes that say where they lead from any heading, and for practice a D that sees the state."""
    options = config.options
    by_way = options.choose == "way"
    if by_way:
        changes = {
            "train.fine_tune.epochs": config.train.fine_tune.epochs,
            "options.refresh_every": options.refresh_every,
        }
        for name, value in (changes | {"options.codes": options.codes}).items():
            if value:
                raise impossible(name, value, "0 with options.choose way", 0)
    practises = config.practise.ticks > 0
    for applies, name, value, needed, why in (
        (practises, "decoder", options.decoder, "closed", "since an open-loop D cannot react"),
        (practises, "squash", options.squash, True, "since D is the actor of SAC"),
        (True, "frame", options.frame, "heading", "from which a code's direction is seen"),
        (True, "way_weight", options.way_weight or None, options.way_weight or 16, "so that P tells the ways of codes"),
    ):
        if applies and (practises or by_way) and value != needed:
            reason = "practise.ticks" if practises else "options.choose way"
            raise impossible(f"options.{name}", value or 0, f"{needed} with {reason}, {why}", needed)


def _check_learners(config: Config) -> None:
    """Check that each learner does all that is asked of it, and that the rounds of replay divide an iteration."""
    train, flat, codes = config.train, config.collect.learner, config.options.codes
    if train.learner in (CONTINUOUS if codes else DISCRETE):
        kind = f"with options.codes = {codes} ppo or dqn" if codes else "with options.codes = 0 ppo or sac"
        raise impossible("train.learner", train.learner, kind, "dqn" if codes else "sac")
    if codes == 1:
        raise impossible("options.codes", 1, "0 or at least 2", 2)
    for applies, name, learner, needed in (
        (train.fine_tune.epochs, "train.learner", train.learner, "ppo with train.fine_tune.epochs"),
        (train.init, "train.learner", train.learner, "ppo with train.init"),
        ("transfer" in train.baselines, "collect.learner", flat, "ppo with baseline transfer"),
    ):
        if applies and learner != "ppo":
            raise impossible(name, learner, needed, "ppo")
    practised, own = config.practise.sac, SACConfig().hidden_sizes
    if practised.relabel:
        raise impossible("practise.sac.relabel", practised.relabel, "0, since a code is no goal", 0)
    if practised.hidden_sizes != own:
        expected = f"{own}, unused: D's are options.decoder_sizes"
        raise impossible("practise.sac.hidden_sizes", practised.hidden_sizes, expected, own)
    values = dict(walk(config))
    for name in REPLAYS:
        fields = ("num_envs", "update_every", "rollout_length", "capacity")
        num_envs, every, length, capacity = (values[f"{name}.{field}"] for field in fields)
        if capacity < (fewest := num_envs * every):
            expected = f"the decisions of a round, {name}.num_envs * {name}.update_every = {fewest}"
            raise impossible(f"{name}.capacity", capacity, expected, fewest)
        if length % every:
            valid = max(n for n in range(1, every + 1) if length % n == 0)
            raise impossible(f"{name}.update_every", every, f"a divisor of {name}.rollout_length = {length}", valid)


def _check_bounds(name: str, kind: Any, value: Any) -> None:
    if kind == tuple[int, ...] and not value:
        raise impossible(name, "none", "at least one size", 64)
    bounds = get_args(kind)[1] if get_origin(kind) is Annotated else USUAL_BOUNDS.get(kind)
    for number in value if isinstance(value, tuple) else (value,):
        if bounds and not (math.isfinite(number) and bounds.low <= number <= bounds.high):
            interval = f"at least {bounds.low}" if bounds.high == math.inf else f"in [{bounds.low}, {bounds.high}]"
            nearest_valid = bounds.high if number >= bounds.low else bounds.low
            raise impossible(name, value, f"a finite number {interval}", nearest_valid)


def _check_limits(config: Config) -> None:
    """Check the fields whose bounds are other fields, or products of them."""
    values, baselines = dict(walk(config)), config.train.baselines
    flat, over_options = f"collect.{config.collect.learner}", f"train.{config.train.learner}"
    flats = (flat, over_options, "practise.sac")
    collected, trained, practised = (f"{x}.num_envs * {x}.rollout_length" for x in flats)
    by_ppo, refreshes = over_options == "train.ppo", config.options.refresh_every
    for applies, name, allowed, expected, other in (
        (flat == "collect.ppo", "collect.ppo.minibatch_size", le, "at most", collected),
        (True, "collect.ticks", ge, "at least one iteration,", collected),
        (by_ppo, "train.ppo.minibatch_size", le, "at most", trained),
        *((True, f"{x}.update_every", le, "at most", f"{x}.rollout_length") for x in REPLAYS),
        (config.train.fine_tune.epochs, "train.fine_tune.minibatch_size", le, "at most", trained),
        (True, "train.ticks", ge, "at least one iteration,", trained),
        (config.practise.ticks, "practise.ticks", ge, "at least one iteration,", practised),
        (refreshes, "train.ticks", ge, "at least one refresh,", f"{trained} * options.refresh_every"),
        (by_ppo, "options.length", le, "at most", "train.ppo.rollout_length"),
        (True, "options.shortest", le, "at most", "options.length"),
        ("repeat" in baselines, "options.length", le, "with baseline repeat at most", f"{flat}.rollout_length"),
        (baselines, "train.ticks", ge, "at least an iteration of baselines,", collected),
    ):
        limit = math.prod(values[factor] for factor in other.split(" * "))
        if applies and not allowed(values[name], limit):
            raise impossible(name, values[name], f"{expected} {other} = {limit}", limit)
