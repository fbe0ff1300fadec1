"""The main job, tiny but whole: what it leaves behind, what it refuses, and what an interruption changes (nothing)."""

import dataclasses
import gc
import json
import shutil
import subprocess
import sys
import weakref
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from probes import assert_trees_equal
from safetensors.numpy import load_file
from tiny_runs import (
    CONFIG,
    KilledError,
    assert_same_arrays,
    die,
    files_of,
    methods_of,
    rows_of,
    tiny_steps,
    with_fields,
)

from taic_jax import pipeline
from taic_jax.artifacts.experience import ExperienceStore, read_experience
from taic_jax.config import Config, ConfigError
from taic_jax.config.files import load_config
from taic_jax.envs import make_env
from taic_jax.options.dataset import Experience
from taic_jax.pipeline import run_pipeline
from taic_jax.runtime import driver
from taic_jax.runtime.checkpoint import Checkpoints, load_arrays
from taic_jax.runtime.logging import RunLogger
from taic_jax.runtime.run_folder import BusyError, RunFolder, RunFolderError
from taic_jax.sources import make_envs
from taic_jax.trainer import init_rows, make_trainer
from taic_jax.types import as_rows

STAGES = {"collect": 3, "learn": 2, "train": 3}


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with tiny_steps():
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """Return the folder of a run that nothing interrupted."""
    folder = tmp_path_factory.mktemp("runs") / "finished"
    run_pipeline(CONFIG, folder)
    return folder


def last_states(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    return {name: load_arrays(folder / "checkpoints" / name / str(steps)) for name, steps in STAGES.items()} | {
        "options": load_file(folder / "options/arrays.safetensors")
    }


def assert_same_runs(a: Path, b: Path) -> None:
    states = last_states(b)
    for name, state in last_states(a).items():
        assert_same_arrays(state, states[name])
    assert methods_of(a) == methods_of(b) and rows_of(a) == rows_of(b)
    blocks = {name for name in files_of(b) if name.startswith("experience") or name == "config.yaml"}
    assert {name: files_of(a)[name] for name in blocks} == {name: files_of(b)[name] for name in blocks}


def test_leaves_a_whole_run_behind(finished):
    assert load_config(finished / "config.yaml") == CONFIG
    summary = json.loads((finished / "summary.json").read_text())
    assert set(summary) == {"ticks", "ticks_per_second", "seconds", "stopped", "methods", "versions", "commit"}
    assert summary["stopped"] == {}
    assert summary["ticks"] == 2 * (48 + 48) and summary["ticks_per_second"] > 0
    assert set(summary["seconds"]) == {"compile", "run"} and summary["versions"]["jax"] == jax.__version__
    assert set(summary["methods"]) == {"flat", "taic"}
    for method in summary["methods"].values():
        result = method["return"]
        assert {"per_seed", "first_per_seed", "iqm", "ci95"} <= set(result)
        assert len(result["per_seed"]) == len(result["first_per_seed"]) == 2
        assert len(result["ci95"]) == 2 and -200 <= result["iqm"] <= 100
    with Image.open(finished / "video.webp") as video:
        assert video.format == "WEBP"


def test_tensorboard_has_the_video_once_also_after_a_resume(finished, tmp_path):
    folder = Path(shutil.copytree(finished, tmp_path / "run"))
    run_pipeline(CONFIG, folder, resume=True)
    for path in (finished, folder):
        events = b"".join(file.read_bytes() for file in (path / "tensorboard").iterdir())
        assert events.count(b"GIF89a") == events.count(b"\x05video") == 1


def test_logs_every_step_of_every_stage(finished):
    of_ticks = [(row["stage"], row["ticks"]) for row in rows_of(finished) if "ticks" in row]
    collect, train = ([(name, ticks) for ticks in (16, 32, 48)] for name in ("collect", "train"))
    assert of_ticks == [*collect, ("evaluate", 48), ("evaluate", 48), *train]
    assert [(row["stage"], row["steps"]) for row in rows_of(finished) if "steps" in row] == [("learn", 2), ("learn", 4)]
    losses = [row["train/value_loss"] for row in rows_of(finished) if row["stage"] == "train"]
    assert np.shape(losses) == (3, 2) and np.isfinite(losses).all()
    assert any((finished / "tensorboard").iterdir())


def test_keeps_the_newest_experience_of_each_seed(finished):
    experience = [read_experience(finished / "experience", seed) for seed in range(2)]
    assert all(e.obs.shape == (16, 2, 2) and e.action.shape == (16, 2, 2) for e in experience)
    assert (experience[0].action != experience[1].action).all()


def refused(run_dir: Path, config: Config = CONFIG, **options: bool) -> str:
    """Return why a run is refused, having checked that nothing was touched."""
    before = files_of(run_dir)
    with pytest.raises(RunFolderError) as error:
        run_pipeline(config, run_dir, **options)
    assert files_of(run_dir) == before and "\n" not in str(error.value)
    return str(error.value)


def test_refuses_folders_that_are_not_its_own(finished, tmp_path):
    other = with_fields(CONFIG, train__ticks=32)
    assert "--resume" in refused(finished)
    assert "ticks: 32" in refused(finished, other, resume=True)
    assert "no config.yaml" in refused(tmp_path, resume=True)
    (tmp_path / "thesis.txt").write_text("years of work")
    assert "already holds files" in refused(tmp_path)
    assert "not overwritten" in refused(tmp_path, overwrite=True)
    with pytest.raises(RunFolderError):
        run_pipeline(CONFIG, tmp_path / "thesis.txt", overwrite=True)
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


CLAIM = """
import sys
from pathlib import Path
from taic_jax.runtime.run_folder import RunFolder
with RunFolder(Path(sys.argv[1])).claimed():
    print("claimed", flush=True)
    sys.stdin.read()
"""


def test_a_folder_is_given_back_by_a_process_that_is_killed(tmp_path):
    child = subprocess.Popen(
        [sys.executable, "-c", CLAIM, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert child.stdout and child.stdin and child.stdout.readline() == "claimed\n"
    with pytest.raises(BusyError, match="is being written by another process"), RunFolder(tmp_path).claimed():
        pytest.fail("two processes at one folder")
    child.kill()
    child.wait()
    child.stdout.close()
    child.stdin.close()
    with RunFolder(tmp_path).claimed(), pytest.raises(BusyError), RunFolder(tmp_path).claimed():
        pytest.fail("two runs of one process at one folder")
    with RunFolder(tmp_path).claimed():
        pass


def test_overwrites_a_run_when_asked(finished, tmp_path, monkeypatch):
    (tmp_path / "config.yaml").write_bytes((finished / "config.yaml").read_bytes())
    (tmp_path / "summary.json").write_text("old")
    die(monkeypatch, RunLogger, "truncate", 1)
    with pytest.raises(KilledError):
        run_pipeline(CONFIG, tmp_path, overwrite=True)
    assert "summary.json" not in files_of(tmp_path) and load_config(tmp_path / "config.yaml") == CONFIG


def test_an_interrupted_run_ends_as_if_it_had_not_been(finished, tmp_path, monkeypatch):
    deaths = [
        (ExperienceStore, "write", 2),  # in collect, between the row of an iteration and its block
        (RunLogger, "log", 2 + 1 + 1),  # the rows left of collect, its evaluation, then in learn before a row
        (Checkpoints, "save", 1 + 2),  # in learn, then in train, with rows that no checkpoint covers
    ]
    folder = tmp_path / "run"
    for i, death in enumerate(deaths):
        with monkeypatch.context() as patch, pytest.raises(KilledError):
            die(patch, *death)
            run_pipeline(CONFIG, folder, resume=i > 0)
    run_pipeline(CONFIG, folder, resume=True)
    assert_same_runs(folder, finished)
    assert json.loads((folder / "summary.json").read_text())["ticks"] == 2 * (48 + 48)


def test_a_run_repeated_is_the_same_to_the_last_bit_and_lets_go_of_its_environments(finished, tmp_path, monkeypatch):
    """A sweep of many runs in one process would otherwise hold the MuJoCo model of each."""
    envs: list[weakref.ref] = []

    def make(config):
        made = make_envs(config)
        envs.extend(map(weakref.ref, made))
        return made

    monkeypatch.setattr(pipeline, "make_envs", make)
    run_pipeline(CONFIG, tmp_path / "run")
    assert_same_runs(tmp_path / "run", finished)
    gc.collect()
    assert [env() for env in envs] == [None, None]


@pytest.mark.parametrize("stage", ["collect", "flat"])
def test_a_seed_starts_the_same_alone_among_others_and_in_a_sweep(stage):
    point = with_fields(CONFIG, train__ppo__learning_rate=0.01)
    env, _ = make_envs(CONFIG)
    init = jax.jit(lambda rows, keys: init_rows(partial(make_trainer, stage, env), (rows, None), keys))
    keys = jax.vmap(jax.random.key)(jnp.arange(4))
    alone = init(as_rows([CONFIG], 1), keys[3:])
    for row, many in ((3, init(as_rows([CONFIG], 4), keys)), (7, init(as_rows([point, CONFIG], 4), jnp.tile(keys, 2)))):
        assert_trees_equal(alone, jax.tree.map(lambda x, row=row: x[row : row + 1], many))


def test_a_seed_does_not_depend_on_how_many_run(finished, tmp_path):
    """Seed 1 of seeds 0 and 1 is the run with seed 1 alone."""
    no_video = dataclasses.replace(CONFIG.evaluate, video_ticks=0)
    run_pipeline(dataclasses.replace(CONFIG, evaluate=no_video, seed=1, seeds=1), tmp_path / "run")
    assert not (tmp_path / "run" / "video.webp").exists()
    for name, state in last_states(tmp_path / "run").items():
        both = last_states(finished)[name]
        for leaf in state:
            np.testing.assert_allclose(state[leaf][0], both[leaf][1], rtol=1e-3, atol=1e-5, err_msg=f"{name}: {leaf}")
    alone, both = methods_of(tmp_path / "run"), methods_of(finished)
    for method in both:
        for metric, values in both[method]["metrics"].items():
            got = alone[method]["metrics"][metric]["per_seed"][0]
            np.testing.assert_allclose(got, values["per_seed"][1], rtol=1e-3, err_msg=f"{method}: {metric}")


@pytest.mark.parametrize(
    ("since", "until", "message"),
    [
        (
            0.0,
            0.5,
            "options.delta_unit: quantile .* got none .* in collect between its shares 0 and 0.5; error",
        ),
        (0.99, 1.0, "options.length: .* got none of 2 in collect between its shares 0.99 and 1"),
    ],
)
def test_experience_without_the_windows_that_are_needed_is_refused(tmp_path, monkeypatch, since, until, message):
    """Of 160 ticks the last sixteen are held out, and the last two begin no window."""
    env = make_env("nav2d")
    obs, action = jnp.zeros((1, 160, 1, env.proprioceptive_size)), jnp.zeros((1, 160, 1, env.action_size))
    experience = Experience(obs, action, reward=obs[..., 0], done=jnp.zeros((1, 160, 1), bool))
    monkeypatch.setattr(pipeline, "gather_experience", lambda *_: experience)
    options = dataclasses.replace(CONFIG.options, termination="predict", since=since, until=until)
    config = dataclasses.replace(CONFIG, options=options, seeds=1)
    with driver.Run.open(config, tmp_path) as run, pytest.raises(ConfigError, match=message):
        pipeline.learn(run, env)
