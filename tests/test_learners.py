"""Runs of SAC and DQN: resumed, swept, as collectors, and all that they are asked for and cannot do."""

from pathlib import Path

import jax
import numpy as np
import psutil
import pytest
from tiny_runs import (
    CONFIG,
    KilledError,
    assert_same_arrays,
    die,
    last_state,
    methods_of,
    rows_of,
    tiny_steps,
    with_fields,
)

import taic_jax as taic
from taic_jax.artifacts.experience import ExperienceStore
from taic_jax.config import ConfigError
from taic_jax.config.checks import validate
from taic_jax.run import main
from taic_jax.runtime.checkpoint import Checkpoints
from taic_jax.summary import plan

SAC = with_fields(CONFIG, collect__learner="sac", train__learner="sac", evaluate__video_ticks=0)
DQN = with_fields(
    CONFIG, env__name="four_rooms", collect__env="four_rooms_random", collect__learner="dqn", train__learner="dqn",
    collect__dqn__relabel=1, options__codes=3, options__sample_actions=True, train__baselines=("flat", "repeat"),
    evaluate__video_ticks=0,
)  # fmt: skip
CONFIGS = {"sac": SAC, "dqn": DQN}


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with tiny_steps():
        yield


@pytest.fixture(scope="module", params=CONFIGS)
def finished(request, tmp_path_factory) -> tuple[Path, str]:
    """Return the folder of a run of each learner that nothing interrupted, and the learner."""
    folder = tmp_path_factory.mktemp("runs") / "finished"
    taic.run_pipeline(CONFIGS[request.param], folder, quiet=True)
    return folder, request.param


sac_alone = pytest.mark.parametrize("finished", ["sac"], indirect=True)
"""Tests that one learner is enough for."""


def test_an_interrupted_run_ends_as_if_it_had_not_been(finished, tmp_path, monkeypatch):
    (finished, learner), folder = finished, tmp_path / "run"
    config, learnt = CONFIGS[learner], {"sac": "log_temperature", "dqn": "policy.epsilon"}[learner]
    for i, death in enumerate([(ExperienceStore, "write", 2), (Checkpoints, "save", 1 + 2 + 2)]):
        with monkeypatch.context() as patch, pytest.raises(KilledError):
            die(patch, *death)
            taic.run_pipeline(config, folder, resume=i > 0, quiet=True)
    taic.run_pipeline(config, folder, resume=True, quiet=True)
    for stage in ("collect", "train"):
        state = last_state(finished, stage)
        assert_same_arrays(last_state(folder, stage), state)
        assert {"state.replay.rows", f"state.learnt.{learnt}", "state.owed"} <= set(state)
        assert (state["state.replay.count"] > 0).all() and state["state.replay.rows"].any()
    assert methods_of(folder) == methods_of(finished) and rows_of(folder) == rows_of(finished)


def test_points_of_a_sweep_are_the_runs_that_they_would_be_alone(finished, tmp_path):
    (finished, learner), config = finished, CONFIGS[finished[1]]
    fields = (f"train__{learner}__learning_rate", f"train__{learner}__gamma")
    points = [with_fields(config, **dict(zip(fields, (rate, 0.9), strict=True))) for rate in (3e-4, 1e-2)]
    summary = taic.run_pipeline(config, tmp_path / "sweep", points=[config, *points], quiet=True).summary
    swept = summary["methods"]["taic"]["return"]["per_seed"]
    alone = taic.run_pipeline(points[1], tmp_path / "alone", quiet=True).summary["methods"]["taic"]
    state = last_state(tmp_path / "alone", "train")
    name = next(name for name in state if "targets" in name)
    np.testing.assert_allclose(swept[:2], methods_of(finished)["taic"]["return"]["per_seed"], rtol=1e-3)
    np.testing.assert_allclose(swept[4:], alone["return"]["per_seed"], rtol=1e-3)
    targets = last_state(tmp_path / "sweep", "train")[name]
    np.testing.assert_allclose(targets[4:], state[name], rtol=1e-3, atol=1e-4)
    assert np.abs(targets[2:4] - targets[4:]).max() > 1e-3  # the step size has an effect


@sac_alone
def test_the_experience_is_that_of_the_collector_and_the_plan_counts_its_ticks(finished):
    finished, _ = finished
    assert sorted(path.name for path in (finished / "experience").glob("*.npz")) == ["000001.npz", "000002.npz"]
    env = taic.make_env("nav2d")
    lines = plan(with_fields(SAC, collect__sac__num_envs=4), env, env).splitlines()
    assert lines[0] == "collect  nav2d: 32 ticks x 2 seeds in 1 iterations"
    assert lines[2] == "train    nav2d: 48 ticks x 2 seeds in 3 iterations"


def test_a_library_call_collects_with_the_same_learner():
    agent, metrics, experience = taic.collect(SAC.collect, taic.make_env("nav2d"), jax.random.key(0))
    assert agent.params.bound == 1.0 and len(metrics["temperature"]) == 3
    assert experience.obs.shape[:2] == (16, 2)


def test_experience_of_discrete_actions_is_one_hot_and_every_option_is_one_of_the_book():
    env = taic.make_env("four_rooms_random")
    _, _, experience = taic.collect(DQN.collect, env, jax.random.key(0))
    assert set(np.unique(experience.action)) == {0.0, 1.0} and (experience.action.sum(axis=-1) == 1.0).all()
    model, _ = taic.learn(DQN.options, experience, jax.random.key(0), discrete=True)
    executor = taic.make_executor(DQN.options, model)
    agent, _ = taic.train(DQN.train.dqn, taic.make_env("four_rooms"), executor, jax.random.key(0), ticks=16)
    obs = env.reset(jax.random.key(0)).obs
    _, action, tick = agent.act(agent.start(obs), obs, jax.random.key(1))
    assert tick.option.shape == (3,) and tick.option.sum() == 1.0 and action.sum() == 1.0


REFUSED = {
    "fine-tuning": (
        {"train__fine_tune__epochs": 1, "train__fine_tune__minibatch_size": 8},
        "train.learner: expected ppo with train.fine_tune.epochs, got sac",
    ),
    "init": (
        {"train__init": "a", "options__source": "a"},
        "train.learner: expected ppo with train.init, got sac; the nearest valid value is ppo",
    ),
    "transfer": ({"train__baselines": ("transfer",), "options__source": "a"}, "collect.learner: expected ppo with"),
    "uneven rounds": (
        {"train__sac__update_every": 3},
        "train.sac.update_every: expected a divisor of train.sac.rollout_length = 8, got 3; "
        "the nearest valid value is 2",
    ),
    "a buffer smaller than a round": (
        {"train__sac__capacity": 7},
        "train.sac.capacity: expected the decisions of a round, train.sac.num_envs * train.sac.update_every = 8, got 7",
    ),
    "a round longer than an iteration": (
        {"collect__sac__update_every": 9},
        "collect.sac.update_every: expected at most collect.sac.rollout_length = 8, got 9",
    ),
    "few ticks": (
        {"train__ticks": 15, "train__baselines": ()},
        "train.ticks: expected at least one iteration, train.sac.num_envs * train.sac.rollout_length = 16, got 15",
    ),
    "dqn over codes of any value": (
        {"train__learner": "dqn"},
        "train.learner: expected with options.codes = 0 ppo or sac, got dqn; the nearest valid value is sac",
    ),
    "sac over a code book": (
        {"options__codes": 4},
        "train.learner: expected with options.codes = 4 ppo or dqn, got sac",
    ),
    "a book of one": (
        {"options__codes": 1, "train__learner": "dqn"},
        "options.codes: expected 0 or at least 2, got 1; the nearest valid value is 2",
    ),
}
MISFITS = {
    "dqn": (
        SAC,
        {"collect__learner": "dqn"},
        "collect.learner: expected ppo or sac for continuous actions",
    ),
    "sac": (
        DQN,
        {"collect__learner": "sac"},
        "collect.learner: expected ppo or dqn for discrete actions",
    ),
    "relabel": (SAC, {"train__sac__relabel": 2}, "train.sac.relabel: expected a task with goals in its observations"),
    "fine-tuning": (
        DQN,
        {"train__learner": "ppo", "train__fine_tune__epochs": 1, "train__fine_tune__minibatch_size": 8},
        "train.fine_tune.epochs: expected none for discrete actions, as of four_rooms, got 1",
    ),
}


@pytest.mark.parametrize("name", MISFITS)
def test_a_learner_that_does_not_fit_the_task_is_refused_before_anything_is_written(name, tmp_path):
    config, changes, message = MISFITS[name]
    with pytest.raises(ConfigError) as error:
        taic.run_pipeline(with_fields(config, **changes), tmp_path / "run", quiet=True)
    assert str(error.value).startswith(message) and not (tmp_path / "run").exists()


def test_a_code_book_larger_than_the_data_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"options.codes: expected at most the \d+ windows in collect .*, got 1000"):
        taic.run_pipeline(with_fields(DQN, options__codes=1000), tmp_path / "run", quiet=True)


@pytest.mark.parametrize("name", REFUSED)
def test_what_sac_cannot_do_is_refused(name):
    changes, message = REFUSED[name]
    with pytest.raises(ConfigError) as error:
        validate(with_fields(SAC, **changes))
    assert message in str(error.value)
    validate(SAC)


def test_a_buffer_larger_than_the_memory_is_refused_with_the_nearest_that_fits(capsys, tmp_path):
    large = ["nav2d", "--train.learner", "sac", "--train.ticks", "1e12", "--train.sac.capacity", "1e12"]
    run = ["--run-dir", str(tmp_path / "run"), "--quiet"]
    for more in (["--dry-run"], []):
        assert main([*large, *run, *more]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "train.sac.capacity: expected a buffer within the memory" in line and not (tmp_path / "run").exists()
    fits = int(line.rpartition(" ")[2])
    bytes_ = 4 * fits * (2 * taic.make_env("nav2d").observation_size + 6 + 4)
    assert 0.45 < bytes_ / psutil.virtual_memory().total < 0.55


def test_an_unknown_learner_is_one_line(capsys):
    assert main(["nav2d", "--train.learner", "sack", "--dry-run", "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "train.learner" in line and "sac" in line


@sac_alone
def test_a_policy_of_sac_is_not_taken_for_one_of_ppo(finished, tmp_path, capsys):
    ppo = [
        "nav2d",
        "--options.length",
        "2",
        "--options.size",
        "2",
        "--options.hidden-size",
        "4",
        "--quiet",
        "--dry-run",
    ]
    ppo += ["--options.mlp-sizes", "4", "--train.ppo.hidden-sizes", "4", "--collect.ppo.hidden-sizes", "4"]
    for more in (["--init", str(finished[0])], ["--options", str(finished[0]), "--train.baselines", "transfer"]):
        assert main([*ppo, *more]) == 2
        assert "learner: expected 'ppo', as in this config; got 'sac'" in capsys.readouterr().err
