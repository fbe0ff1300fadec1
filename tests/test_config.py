"""Configurations: defaults are valid, files are read strictly, impossible values are told."""

import dataclasses
import functools
import math
from pathlib import Path
from typing import get_args, get_origin, get_type_hints

import jax
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from taic_jax import config as config_module
from taic_jax.config import CONFIG_CLASSES, Config, ConfigError, PPOConfig, replace, walk
from taic_jax.config.checks import validate
from taic_jax.config.files import closest, load_config, to_yaml
from taic_jax.types import as_arrays


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "experiment.yaml"
    path.write_text(text)
    return path


def test_defaults_are_valid():
    validate(Config())


def test_what_baselines_and_sources_need_is_told():
    default = Config()
    few = replace(replace(default, "collect.ppo.rollout_length", 16), "options.length", 17)
    transfer = replace(default, "train.baselines", ("transfer",))
    many = replace(replace(default, "collect.ppo.num_envs", 100), "collect.ppo.rollout_length", 10_000)
    both = replace(replace(default, "options.source", "a"), "options.experience", ("b",))
    for config, expected in {
        transfer: "train.baselines: expected with transfer a run",
        replace(few, "train.baselines", ("repeat",)): "options.length: expected with baseline repeat",
        replace(many, "train.ticks", 999_999): "train.ticks: expected at least an iteration of baselines",
        both: "options.experience: expected none with options.source",
    }.items():
        with pytest.raises(ConfigError, match=expected) as error:
            validate(config)
        assert "\n" not in str(error.value)
    for config in (few, replace(many, "train.baselines", ()), replace(default, "options.steps", 0)):
        validate(config)


def test_yaml_names_every_field():
    tree = yaml.safe_load(to_yaml(Config()))
    for name, value in walk(Config()):
        assert functools.reduce(dict.__getitem__, name.split("."), tree) == (
            list(value) if isinstance(value, tuple) else value
        )


# YAML keeps no lone surrogates and no control characters.
ITEMS = {
    "options.experience": st.text(st.characters(exclude_categories=("Cs", "Cc"))),
    "options.observations": st.text(st.characters(exclude_categories=("Cs", "Cc"))),
    "options.action_bounds": st.floats(allow_nan=False, allow_infinity=False),
    "train.baselines": st.sampled_from(["flat", "repeat", "total", "transfer"]),
}


@given(st.data())
def test_yaml_round_trip_of_any_values(tmp_path_factory, data):
    config = Config()
    for name, value in walk(config):
        if type(value) is float:
            config = replace(config, name, data.draw(st.floats(allow_nan=False, allow_infinity=False), name))
        elif type(value) is int:
            config = replace(config, name, data.draw(st.integers(), name))
        elif isinstance(value, tuple):
            items = ITEMS.get(name, st.integers())
            config = replace(config, name, tuple(data.draw(st.lists(items), name)))
    assert load_config(write(tmp_path_factory.mktemp("yaml"), to_yaml(config))) == config


def test_a_partial_group_keeps_its_own_defaults(tmp_path):
    # train.ppo starts from another log_std_init than PPOConfig() does.
    loaded = load_config(write(tmp_path, "train: {ppo: {num_envs: 8}}"))
    assert loaded == replace(Config(), "train.ppo.num_envs", 8)
    assert loaded.train.ppo.log_std_init != PPOConfig().log_std_init


def test_floats_may_be_written_as_yaml_misreads_them(tmp_path):
    loaded = load_config(write(tmp_path, "train: {ppo: {learning_rate: 1e-3, gamma: 1}}"))
    assert loaded.train.ppo.learning_rate == 1e-3
    assert type(loaded.train.ppo.gamma) is float


def test_yaml_anchors_and_merges_are_read(tmp_path):
    loaded = load_config(write(tmp_path, "collect: {ppo: &a {epochs: 3}}\ntrain: {ppo: {<<: *a, gamma: 0.5}}"))
    assert (loaded.train.ppo.epochs, loaded.train.ppo.gamma) == (3, 0.5)


BAD_YAML = {
    "unknown field": ("train: {ppo: {gama: 0.9}}", "train.ppo.gama", "train.ppo.gamma"),
    "unknown group": ("trian: {ticks: 3}", "trian", "train"),
    "field without its group": ("entropy_weight: 0.1", "entropy_weight", ".ppo.entropy_weight"),
    "key that is not text": ("1: 2", "unknown field 1", "there are env, collect, "),
    "group without fields": ("train: 3", "train: expected a mapping", "ticks"),
    "empty group": ("train:", "train: expected a mapping", "got nothing"),
    "bool for integer": ("seeds: true", "seeds: expected an integer, got True", "nearest is 1"),
    "float for integer": ("seeds: 2.7", "seeds: expected an integer, got 2.7", "nearest is 3"),
    "exponent for a fraction": ("collect: {ticks: 15e-1}", "collect.ticks", "nearest is 2"),
    "text for float": ("train: {ppo: {clip: wide}}", "train.ppo.clip: expected a number", "'wide'"),
    "bool for float": ("train: {ppo: {clip: true}}", "train.ppo.clip: expected a number", "True"),
    "text for bool": (
        "train: {ppo: {normalize_reward: 'no'}}",
        "train.ppo.normalize_reward: expected one of True, False",
        "'no'",
    ),
    "unknown baseline": (
        "train: {baselines: [flat, totl]}",
        "train.baselines: expected a list of some of flat",
        "totl",
    ),
    "number for text": ("env: {name: 3}", "env.name: expected text", "got 3"),
    "unknown choice": ("env: {backend: mujco}", "env.backend: expected one of auto", "nearest is mujoco"),
    "list as choice": ("env: {backend: [auto]}", "env.backend: expected one of auto", "['auto']"),
    "number for list": ("options: {mlp_sizes: 64}", "options.mlp_sizes: expected a list of integers", "64"),
    "mapping for list": ("options: {mlp_sizes: {64: 1}}", "options.mlp_sizes", "{64: 1}"),
    "float in list": ("options: {mlp_sizes: [64, 32.5]}", "options.mlp_sizes", "[64, 32.5]"),
    "key twice": ("seed: 1\nseed: 2", "seed stands twice", "line 1"),
    "empty file": ("", "expected a mapping", "got nothing"),
    "list": ("[1, 2]", "expected a mapping", "[1, 2]"),
    "malformed": ("train: [", "line 1", "expected"),
    "tab": ("train:\n\tticks: 3", "line 2", "cannot start any token"),
    "python object": ("seed: !!python/object/apply:os.getcwd []", "line 1", "constructor"),
    "control character": ("seed: \x07", "experiment.yaml", "special characters"),
}


@pytest.mark.parametrize(("text", "first", "second"), BAD_YAML.values(), ids=BAD_YAML)
def test_bad_yaml_is_told_in_one_line(tmp_path, text, first, second):
    with pytest.raises(ConfigError) as error:
        load_config(write(tmp_path, text))
    message = str(error.value)
    assert first in message and second in message and "\n" not in message


def test_bad_sources_are_told_in_one_line(tmp_path):
    (tmp_path / "folder.yaml").mkdir()
    (tmp_path / "binary.yaml").write_bytes(b"\xff\x00")
    for source, expected in {
        "half_cheeta": "nearest is half_cheetah",
        tmp_path / "folder.yaml": "directory",
        tmp_path / "binary.yaml": "not text",
        tmp_path / "missing.yaml": "No such file",
    }.items():
        with pytest.raises(ConfigError, match=expected) as error:
            load_config(source)
        assert "\n" not in str(error.value)


IMPOSSIBLE = [
    ("seeds", 0, 1),
    ("seed", -1, 0),
    ("collect.ticks", 100, 16 * 512),
    ("train.ticks", 0, 1),
    ("train.ppo.num_envs", 0, 1),
    ("train.ppo.minibatch_size", 10_000, 16 * 512),
    ("collect.ppo.gamma", 1.01, 1),
    ("train.ppo.lambda_", -0.1, 0),
    ("train.ppo.clip", 0.0, 1e-6),
    ("train.ppo.learning_rate", -1e-3, 0),
    ("train.ppo.entropy_weight", math.nan, 0),
    ("train.ppo.max_grad_norm", math.inf, None),
    ("train.ppo.hidden_sizes", (64, 0), 1),
    ("options.mlp_sizes", (), 64),
    ("options.length", 513, 512),
    ("options.fraction", 1.5, 1),
    ("options.steps", -1, 0),
    ("options.since", 1.0, 0.0),
    ("options.until", 1.1, 1),
    ("evaluate.video_ticks", -1, 0),
    ("env.num_threads", -2, 0),
    ("train.ppo.lambda_", 1.5, 1),
    ("train.ppo.log_std_init", 3.0, 2),
    ("seed", 2**31, 2**31 - 1),
    ("collect.capacity", -1, 0),
    ("env.change_after", -1, 0),
    ("train.fine_tune.epochs", -1, 0),
    ("train.fine_tune.std", 0.0, 1e-6),
    ("options.delta", 0.0, 1e-6),
    ("collect.ppo.log_std_reset", -20.5, -20),
]


@pytest.mark.parametrize(("name", "value", "nearest"), IMPOSSIBLE)
def test_impossible_values_name_field_value_and_nearest(name, value, nearest):
    with pytest.raises(ConfigError) as error:
        validate(replace(Config(), name, value))
    message = str(error.value)
    assert message.startswith(f"{name}: expected") and "\n" not in message
    assert repr(value) in message or value == ()
    assert nearest is None or message.endswith(f"the nearest valid value is {nearest}")


def test_every_float_is_a_leaf_whatever_its_bounds():
    numbers = [value for _, value in walk(Config()) if type(value) is float]
    np.testing.assert_allclose(jax.tree.leaves(as_arrays(Config())), numbers, rtol=1e-6)


def test_every_field_has_a_type_that_can_be_checked():
    for cls in CONFIG_CLASSES:
        for name, kind in get_type_hints(cls).items():
            kind = get_args(kind)[0] if get_origin(kind) is tuple else kind
            simple = kind in (int, float, bool, str) or kind in CONFIG_CLASSES
            assert simple or all(isinstance(choice, str) for choice in get_args(kind)), f"{cls.__name__}.{name}"


def test_config_classes_are_all_there():
    classes = {kind for kind in vars(config_module).values() if dataclasses.is_dataclass(kind)}
    assert classes == set(CONFIG_CLASSES)


def test_closest_prefers_the_same_last_part():
    names = ["train.ppo.learning_rate", "options.learning_rate", "train.ppo.learning_rate_decay"]
    assert closest("ppo.learning_rate", names) == "train.ppo.learning_rate"
    assert closest("gamma", ["gamma_x.clip", "train.ppo.gamma"]) == "train.ppo.gamma"
    assert closest("train.ppo.learning_rat", names) == "train.ppo.learning_rate"
