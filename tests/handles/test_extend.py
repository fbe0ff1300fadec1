"""A finished run goes on: evaluated otherwise, trained for longer, or as the beginning of another run."""

from pathlib import Path

import jax
import numpy as np
import pytest
from probes import assert_trees_equal
from tiny_runs import CONFIG, KilledError, assert_same_arrays, die, last_state, rows_of, tiny_steps, with_fields

import taic_jax as taic
from taic_jax.config import ConfigError
from taic_jax.config.checks import validate
from taic_jax.runtime.checkpoint import ArtifactError, Checkpoints
from taic_jax.runtime.driver import STAGE_STREAMS
from taic_jax.runtime.run_folder import RunFolder, RunFolderError

SHORT = with_fields(
    CONFIG, collect__ticks=2 * 16, train__ppo__learning_rate_decay=False, collect__ppo__learning_rate_decay=False,
    evaluate__video_ticks=0,
)  # fmt: skip
LONG = with_fields(SHORT, train__ticks=5 * 16)


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with tiny_steps():
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """Return a run that trained for five iterations at once."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    taic.run_pipeline(LONG, folder, quiet=True)
    return folder


@pytest.fixture
def short(tmp_path) -> Path:
    taic.run_pipeline(SHORT, tmp_path / "run", quiet=True)
    return tmp_path / "run"


def test_a_run_that_trains_for_longer_ends_as_if_it_had_been_asked_at_once(short, whole, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(KilledError):
        die(patch, Checkpoints, "save", 2)
        taic.run_pipeline(LONG, short, resume=True, quiet=True)
    assert not RunFolder(short).finished and RunFolder(short).config() == LONG
    with pytest.raises(ArtifactError, match="expected a finished run"):
        taic.load(short)
    taic.run_pipeline(LONG, short, resume=True, quiet=True)
    for stage in ("collect", "learn", "train", "flat"):
        assert_same_arrays(last_state(short, stage), last_state(whole, stage))
    assert rows_of(short) == rows_of(whole)
    for name, agents in taic.load(whole).agents.items():
        assert_trees_equal(taic.load(short).agents[name].rows, agents.rows)


def test_evaluation_is_no_part_of_a_run(short):
    before = {stage: last_state(short, stage) for stage in ("train", "flat")}
    other = with_fields(SHORT, evaluate__episodes=5)
    result = taic.run_pipeline(other, short, resume=True, quiet=True)
    assert RunFolder(short).config() == other and RunFolder(short).summary() == result.summary
    for stage, state in before.items():
        assert_same_arrays(last_state(short, stage), state)
    keys = [jax.random.fold_in(jax.random.key(k), STAGE_STREAMS["evaluate"]) for k in range(2)]
    handle = taic.load(short)
    direct = [float(taic.evaluate(handle.env, handle.agents["taic"][k], keys[k], 5, 0.0)["return"]) for k in range(2)]
    np.testing.assert_allclose(result.summary["methods"]["taic"]["return_mean_option"]["per_seed"], direct, rtol=1e-4)


@pytest.mark.parametrize("fields", [{"train__ticks": 2 * 16}, {"collect__ticks": 3 * 16}, {"options__steps": 8}])
def test_nothing_else_of_a_run_may_change(short, fields):
    summary = (short / "summary.json").read_bytes()
    with pytest.raises(RunFolderError, match=next(iter(fields)).replace("__", ".")):
        taic.run_pipeline(with_fields(SHORT, **fields), short, resume=True, quiet=True)
    assert (short / "summary.json").read_bytes() == summary and RunFolder(short).config() == SHORT


FINE_TUNED = with_fields(SHORT, train__fine_tune__epochs=1, train__fine_tune__minibatch_size=16, train__baselines=())


@pytest.mark.parametrize("config", [SHORT, FINE_TUNED], ids=["frozen", "fine-tuned"])
def test_a_run_begins_with_the_policy_and_the_options_of_another(config, tmp_path):
    source = str(tmp_path / "source")
    taic.run_pipeline(config, Path(source), quiet=True)
    begun = with_fields(config, train__init=source, options__source=source, seeds=3, train__ppo__learning_rate=0.0)
    begun = with_fields(begun, train__fine_tune__learning_rate=0.0)
    taic.run_pipeline(begun, tmp_path / "run", quiet=True)
    old, new = taic.load(source).agents["taic"], taic.load(tmp_path / "run").agents["taic"]
    assert not (tmp_path / "run/checkpoints/collect").exists()
    for k in range(3):  # with step size 0 they are as they began, and seed 2 took the first again
        for part in ("actor", "critic"):
            assert_trees_equal(getattr(new[k].params, part), getattr(old[k % 2].params, part))
        assert_trees_equal(new[k].executor, old[k % 2].executor)
        assert (np.asarray(new[k].params.log_std) == np.float32(config.train.ppo.log_std_init)).all()
        assert new[k].obs_statistics.count.lo > old[k % 2].obs_statistics.count.lo


def test_a_policy_of_another_structure_is_refused(short, tmp_path):
    begun = with_fields(SHORT, train__init=str(short), options__source=str(short), train__ppo__hidden_sizes=(5,))
    with pytest.raises(ArtifactError, match=r"agents/taic/description.json: hidden_sizes: expected \[5\]"):
        taic.run_pipeline(begun, tmp_path / "new", quiet=True)
    with pytest.raises(ConfigError, match=r"source: expected the run that train[.]init names"):
        validate(with_fields(SHORT, train__init="runs/a"))
    assert not (tmp_path / "new").exists()
