"""Presets: valid, no longer than they must be, and what a file may start from."""

import itertools
from pathlib import Path

import pytest
import yaml
from tiny_runs import with_fields

import taic_jax
from taic_jax.config import Config, ConfigError, walk
from taic_jax.config.checks import validate
from taic_jax.config.files import load_config, preset_names, to_yaml


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "experiment.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", preset_names())
def test_presets_load_are_valid_and_hold_only_differences(name):
    preset = load_config(name)
    validate(preset)
    text = (Path(taic_jax.__file__).parent / "experiments/presets" / f"{name}.yaml").read_text()
    changes = yaml.safe_load(text)
    base = changes.pop("base", None)
    defaults = yaml.safe_load(to_yaml(load_config(base) if base else Config()))
    # On top stands what it is for, and the presets that start from another say how they are run.
    assert text.startswith("# ") and (base is None or f"# {' ' * 4}python -m taic_jax.run {name} --" in text)

    def same(changes: dict, old: dict) -> list[str]:
        nested = [same(changes[key], old[key]) for key in changes if isinstance(changes[key], dict)]
        return [key for key in changes if changes[key] == old[key]] + list(itertools.chain(*nested))

    assert same(changes, defaults) == []


STEERING = {"options.length": 20, "options.views": "all", "options.state_noise": 1.0, "options.lambda_adv": 0.0}
MANY = {"num_envs": 64, "rollout_length": 250}
CARRIED = STEERING | {"train.ppo.learning_rate": 6e-4, "train.ppo.minibatch_size": 64}
CARRIED |= {f"train.ppo.{field}": value for field, value in MANY.items()}
PPO_IN_ARENAS = {f"collect.ppo.{field}": value for field, value in MANY.items()} | {"collect.ppo.gamma": 0.999}
ARENA = {"env.goal": "mixed", "collect.env": "", "collect.learner": "ppo", "practise.ticks": 0} | PPO_IN_ARENAS
ARENA |= {"options.source": "pretrained:steering", "env.contacts": "feet"}
TICKS = {"collect.ticks": 1_000_000, "train.ticks": 1_000_000, "train.baselines": ("flat",), "train.learner": "sac"}


def test_the_preset_of_turning_differs_from_ant_in_what_the_task_asks_for():
    own = {"env.name": "ant_turn", "train.ticks": 3_000_000, "train.baselines": ("flat", "transfer")}
    own |= {"options.source": "pretrained:ant_steering", "train.fine_tune.std": 0.2}
    expected = dict(walk(load_config("ant"))) | CARRIED | own
    assert dict(walk(load_config("transfer_ant_turn"))) == expected


@pytest.mark.parametrize("task", ["ant_maze", "ant_push", "ant_fall"])
def test_presets_of_the_arenas_differ_from_steering_in_task_and_learner(task):
    preset = dict(walk(load_config(f"transfer_{task}")))
    expected = dict(walk(load_config("steering"))) | ARENA | TICKS | {"env.name": task}
    expected["train.ticks"] = {"ant_maze": 1_000_000, "ant_push": 2_000_000, "ant_fall": 2_000_000}[task]
    differing = {name for name in expected if preset[name] != expected[name]}
    assert all(name.startswith("train.sac.") for name in differing) and preset["train.sac.relabel"] == 4


def test_options_that_steer_differ_from_those_of_ant_in_how_they_are_learnt():
    assert dict(walk(load_config("ant_steering"))) == dict(walk(load_config("ant"))) | STEERING


CONTROLS = {
    "repeat": {"train.baselines": ("flat", "repeat")},
    "total": {"train.baselines": ("flat", "total")},
    "rvae_only": {"options.lambda_pred": 0.0, "options.lambda_adv": 0.0},
    "pred_only": {"options.lambda_adv": 0.0},
    "adv_only": {"options.lambda_pred": 0.0},
    "random_decoder": {"options.steps": 0},
}


@pytest.mark.parametrize("name", CONTROLS)
def test_controls_differ_from_half_cheetah_in_one_thing(name):
    expected = dict(walk(load_config("half_cheetah"))) | CONTROLS[name]
    assert dict(walk(load_config(f"control_{name}"))) == expected


def test_a_file_may_start_from_a_preset_or_a_file_that_does(tmp_path):
    first = tmp_path / "first.yaml"
    first.write_text("base: half_cheetah\ntrain: {ppo: {gamma: 0.5}, ticks: 7}")
    loaded = load_config(write(tmp_path, f"base: {first}\ntrain: {{ticks: 9}}"))
    expected = with_fields(load_config("half_cheetah"), train__ppo__gamma=0.5, train__ticks=9)
    assert loaded == expected
    # What was resolved is whole: it starts from nothing.
    assert "base" not in yaml.safe_load(to_yaml(loaded))


BAD_BASES = {
    "unknown": ("base: half_cheeta", "experiment.yaml: base: unknown preset 'half_cheeta'", "nearest is half_cheetah"),
    "missing": ("base: ./none.yaml", "experiment.yaml: base: ./none.yaml: expected a YAML file", "No such file"),
    "not text": ("base: [ant]", "experiment.yaml: base: expected a preset's name or a file", "got ['ant']"),
    "nothing": ("base:", "experiment.yaml: base: expected a preset's name or a file", "got nothing"),
    "empty": ("base: ''", "experiment.yaml: base: unknown preset ''", "there are ant, "),
    "itself": ("base: FOLDER/experiment.yaml", "base: expected an end", "experiment.yaml -> "),
    "cycle": ("base: FOLDER/second.yaml", "base: expected an end", "second.yaml -> "),
    "bad field in it": ("base: FOLDER/bad.yaml", "unknown field trian", "nearest is train"),
    "misspelt": ("bse: ant", "unknown field bse", "nearest is base"),
    "below": ("env: {base: ant}", "unknown field env.base", "nearest"),
}


@pytest.mark.parametrize(("text", "first", "second"), BAD_BASES.values(), ids=BAD_BASES)
def test_bad_bases_are_told_in_one_line(tmp_path, text, first, second):
    (tmp_path / "second.yaml").write_text(f"base: {tmp_path}/experiment.yaml")
    (tmp_path / "bad.yaml").write_text("trian: 3")
    with pytest.raises(ConfigError) as error:
        load_config(write(tmp_path, text.replace("FOLDER", str(tmp_path))))
    assert first in str(error.value) and second in str(error.value) and "\n" not in str(error.value)
