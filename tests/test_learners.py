"""Runs of SAC: resumed, swept, as a collector, and all that it is asked for and cannot do."""

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


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with tiny_steps():
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """Return the folder of a run that nothing interrupted."""
    folder = tmp_path_factory.mktemp("runs") / "finished"
    taic.run_pipeline(SAC, folder, quiet=True)
    return folder


def test_an_interrupted_run_ends_as_if_it_had_not_been(finished, tmp_path, monkeypatch):
    folder = tmp_path / "run"
    for i, death in enumerate([(ExperienceStore, "write", 2), (Checkpoints, "save", 1 + 2 + 2)]):
        with monkeypatch.context() as patch, pytest.raises(KilledError):
            die(patch, *death)
            taic.run_pipeline(SAC, folder, resume=i > 0, quiet=True)
    taic.run_pipeline(SAC, folder, resume=True, quiet=True)
    for stage in ("collect", "train"):
        state = last_state(finished, stage)
        assert_same_arrays(last_state(folder, stage), state)
        assert {"state.replay.rows", "state.learnt.log_temperature", "state.owed"} <= set(state)
        assert (state["state.replay.count"] > 0).all() and state["state.replay.rows"].any()
    assert methods_of(folder) == methods_of(finished) and rows_of(folder) == rows_of(finished)


def test_points_of_a_sweep_are_the_runs_that_they_would_be_alone(finished, tmp_path):
    points = [with_fields(SAC, train__sac__learning_rate=rate, train__sac__gamma=0.9) for rate in (3e-4, 1e-2)]
    summary = taic.run_pipeline(SAC, tmp_path / "sweep", points=[SAC, *points], quiet=True).summary
    swept = summary["methods"]["taic"]["return"]["per_seed"]
    alone = taic.run_pipeline(points[1], tmp_path / "alone", quiet=True).summary["methods"]["taic"]
    np.testing.assert_allclose(swept[:2], methods_of(finished)["taic"]["return"]["per_seed"], rtol=1e-3)
    np.testing.assert_allclose(swept[4:], alone["return"]["per_seed"], rtol=1e-3)
    rates = last_state(tmp_path / "sweep", "train")["state.learnt.log_temperature"]
    assert np.abs(rates[2:4] - rates[4:]).min() > 1e-4  # the step size has an effect


def test_the_experience_is_that_of_the_collector_and_the_plan_counts_its_ticks(finished):
    assert sorted(path.name for path in (finished / "experience").glob("*.npz")) == ["000001.npz", "000002.npz"]
    env = taic.make_env("nav2d")
    lines = plan(with_fields(SAC, collect__sac__num_envs=4), env, env).splitlines()
    assert lines[0] == "collect  nav2d: 32 ticks x 2 seeds in 1 iterations"
    assert lines[2] == "train    nav2d: 48 ticks x 2 seeds in 3 iterations"


def test_a_library_call_collects_with_the_same_learner():
    agent, metrics, experience = taic.collect(SAC.collect, taic.make_env("nav2d"), jax.random.key(0))
    assert agent.params.bound == 1.0 and len(metrics["temperature"]) == 3
    assert experience.obs.shape[:2] == (16, 2)


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
    "a round longer than an iteration": (
        {"collect__sac__update_every": 9},
        "collect.sac.update_every: expected at most collect.sac.rollout_length = 8, got 9",
    ),
    "few ticks": (
        {"train__ticks": 15, "train__baselines": ()},
        "train.ticks: expected at least one iteration, train.sac.num_envs * train.sac.rollout_length = 16, got 15",
    ),
}


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
    for more in (["--init", str(finished)], ["--options", str(finished), "--train.baselines", "transfer"]):
        assert main([*ppo, *more]) == 2
        assert "learner: expected 'ppo', as in this config; got 'sac'" in capsys.readouterr().err
