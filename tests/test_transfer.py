"""Whole runs that start from others: options used as they are, a policy carried over, experience from elsewhere."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest
from safetensors.numpy import load_file
from tiny_runs import (
    CONFIG,
    KilledError,
    assert_same_arrays,
    die,
    files_of,
    last_state,
    rows_of,
    tiny_steps,
    with_fields,
)

from taic_jax import nonfinite, pipeline
from taic_jax.config import Config, ConfigError, collector_is_baseline, needs_collect
from taic_jax.pipeline import run_pipeline
from taic_jax.runtime.checkpoint import Checkpoints
from taic_jax.runtime.driver import STAGE_STREAMS
from taic_jax.sources import make_envs, take_over
from taic_jax.summary import plan

QUIET = with_fields(CONFIG, evaluate__video_ticks=0)
SOURCE = with_fields(QUIET, env__name="nav2d_random", options__steps=0)  # a random decoder does as well


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with tiny_steps():
        yield


def killed(*args) -> None:
    raise KilledError


@pytest.fixture(scope="module")
def source(tmp_path_factory) -> Path:
    """Return the folder of a run on random tasks in the room, that has got as far as its options."""
    folder = tmp_path_factory.mktemp("runs") / "source"
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KilledError):
        patch.setattr(pipeline, "train_over_options", killed)
        run_pipeline(SOURCE, folder)
    return folder


def using(source: Path, **fields) -> Config:
    """Return the config of a run on the fixed task with options learnt on random ones."""
    return with_fields(QUIET, options__source=str(source), **{"train__baselines": ("transfer",), **fields})


@pytest.fixture(scope="module")
def transferred(source, tmp_path_factory) -> Path:
    """Return the folder of a run with another's options, on a third seed too, that nothing interrupted."""
    folder = tmp_path_factory.mktemp("runs") / "transferred"
    run_pipeline(using(source, seeds=3), folder)
    return folder


def stages_of(folder: Path) -> set[str]:
    return {path.name for path in (folder / "checkpoints").iterdir()}


def methods_of(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())["methods"]


def test_a_run_with_options_of_another_learns_and_collects_nothing(transferred):
    assert stages_of(transferred) == {"train", "transfer"}
    assert not any((transferred / name).exists() for name in ("experience", "options", "agents/collect"))
    assert set(methods_of(transferred)) == {"taic", "transfer"}
    assert json.loads((transferred / "summary.json").read_text())["ticks"] == 3 * 2 * 48
    assert {row["stage"] for row in rows_of(transferred)} == {"train", "transfer", "evaluate"}


def test_frozen_options_are_what_acts_and_stay_as_they_are(source, transferred, tmp_path, monkeypatch):
    """And a run is the same source as the artifact in it."""
    before, agents = files_of(source), []
    train = pipeline.train_over_options
    monkeypatch.setattr(pipeline, "train_over_options", lambda *args: agents.append(train(*args)) or agents[-1])
    run_pipeline(using(source / "options", seeds=3, train__baselines=()), tmp_path / "run")
    assert files_of(source) == before
    stored = load_file(source / "options/arrays.safetensors")
    acting = jax.tree_util.tree_flatten_with_path(agents[0].agent.executor.model)[0]
    named = {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in acting}
    assert_same_arrays(named, {name: array[[0, 1, 0]] for name, array in stored.items()})
    assert_same_arrays(last_state(tmp_path / "run", "train"), last_state(transferred, "train"))
    assert methods_of(tmp_path / "run") == {"taic": methods_of(transferred)["taic"]}


def test_the_transferred_policy_starts_where_the_source_run_ended(source, tmp_path, monkeypatch):
    """nav2d observes the slice alone, nav2d_random the goal besides: the first two rows of weights carry over."""
    config, states = using(source), []

    def drive(run, stage, step, state, *args, **kwargs):
        states.append(state)
        run.record_divergence(stage, nonfinite.begin(state, run.inherited(stage)), 1)
        return state

    env = make_envs(config)[0]
    policy = take_over(config, env, env).flat
    monkeypatch.setattr(pipeline, "drive", drive)
    with pipeline.Run.open(config, tmp_path) as run:
        pipeline.train_baseline(run, env, "transfer", policy)
    saved, (start,) = load_file(source / "agents/collect/arrays.safetensors"), states
    first, second = (saved[f"params.actor.params.Dense_{i}.kernel"] for i in range(2))
    np.testing.assert_array_equal(start.params.actor["params"]["Dense_0"]["kernel"], first[:, :2])
    np.testing.assert_array_equal(start.params.actor["params"]["Dense_1"]["kernel"], second)
    np.testing.assert_array_equal(start.obs_statistics.mean, saved["obs_statistics.mean"][:, :2])
    # It explores afresh.
    assert (np.asarray(start.params.log_std) == np.float32(config.collect.ppo.log_std_init)).all()
    assert not (saved["params.log_std"] == np.float32(config.collect.ppo.log_std_init)).all()


def test_a_transfer_run_that_was_interrupted_ends_as_if_it_had_not_been(source, transferred, tmp_path, monkeypatch):
    config, folder = using(source, seeds=3), tmp_path / "run"
    with monkeypatch.context() as patch, pytest.raises(KilledError):
        die(patch, Checkpoints, "save", 3 + 2)  # in transfer, with a row that no checkpoint covers
        run_pipeline(config, folder)
    run_pipeline(config, folder, resume=True)
    for stage in ("train", "transfer"):
        assert_same_arrays(last_state(folder, stage), last_state(transferred, stage))
    assert methods_of(folder) == methods_of(transferred) and rows_of(folder) == rows_of(transferred)


def test_baselines_take_their_ticks_and_hold_their_actions(source, tmp_path):
    """The collector would have had other ticks than flat, so that it is not run; but its PPO is that of flat ones."""
    fields = {"collect__ticks": 64, "collect__ppo__rollout_length": 4, "collect__ppo__minibatch_size": 8}
    run_pipeline(using(source, seeds=3, **fields, train__baselines=("flat", "repeat", "total")), tmp_path)
    assert stages_of(tmp_path) == {"train", "flat", "repeat", "total"}
    assert list(methods_of(tmp_path)) == ["taic", "flat", "repeat", "total"]
    rows = {name: [row for row in rows_of(tmp_path) if row["stage"] == name] for name in STAGE_STREAMS}
    assert {name: [row["ticks"] for row in rows[name]] for name in ("train", "flat", "repeat", "total")} == {
        "train": [16, 32, 48],
        "flat": list(range(8, 49, 8)),
        "repeat": list(range(8, 49, 8)),
        "total": list(range(8, 113, 8)),
    }
    # A rollout is 4 ticks in 2 environments, and no episode ends in it; an option lasts 2 ticks. Options take 8 ticks.
    for name, decisions in {"train": 8.0, "flat": 8.0, "repeat": 4.0, "total": 8.0}.items():
        assert all(row[f"{name}/decisions"] == [decisions] * 3 for row in rows[name])
    assert methods_of(tmp_path)["repeat"]["duration"]["histogram"][1] > 0.9
    assert json.loads((tmp_path / "summary.json").read_text())["ticks"] == 3 * (48 + 48 + 48 + 112)


NEEDS = [  # the fields, whether collect is needed, and whether it is the flat baseline too
    ({}, True, True),
    ({"collect__env": "nav2d"}, True, True),
    ({"train__ticks": 64}, True, False),
    ({"collect__env": "nav2d_random"}, True, False),
    ({"train__baselines": ()}, True, True),
    ({"options__source": "x"}, True, True),
    ({"options__source": "x", "train__ticks": 64}, False, False),
    ({"options__source": "x", "train__baselines": ("transfer", "total")}, False, True),
    ({"options__experience": ("x",)}, True, True),
    ({"options__experience": ("x",), "train__baselines": ()}, False, True),
    ({"options__experience": ("x", "collect"), "train__baselines": ()}, True, True),
]


@pytest.mark.parametrize(("fields", "needed", "baseline"), NEEDS, ids=[str(fields) for fields, *_ in NEEDS])
def test_collect_runs_only_where_something_needs_it(fields, needed, baseline):
    config = with_fields(CONFIG, **fields)
    assert (needs_collect(config), collector_is_baseline(config)) == (needed, baseline)


LEARN = "learn    4 gradient steps on windows of 2 ticks from"
KEEP = "keep     the newest 32 ticks of collect"
PLANS = [
    (
        {},
        [
            "collect  nav2d: 48",
            f"{LEARN} collect",
            "train    nav2d: 48",
            "keep     the newest 32 ticks",
            "memory   experience",
        ],
    ),
    (
        {"train__baselines": ("repeat", "total", "transfer"), "options__source": "a"},
        [
            "options  as learnt in a",
            "train    nav2d: 48",
            "repeat   nav2d: 48",
            "total    nav2d: 96",
            "transfer nav2d: 48",
        ],
    ),
    (
        {"options__source": "a"},
        [
            "collect  nav2d: 48",
            "options  as learnt in a",
            "train    nav2d: 48",
            "keep     the newest 32 ticks",
            "memory   experience 0 MiB on disk",
        ],
    ),
    (
        {"options__experience": ("collect", "a"), "collect__env": "nav2d_random"},
        [
            "collect  nav2d_random: 48",
            f"{LEARN} collect, a",
            "train    nav2d: 48",
            "flat     nav2d: 48",
            "keep     the newest 32 ticks",
            "memory   ",
        ],
    ),
    ({"options__experience": ("a",), "train__baselines": ()}, [f"{LEARN} a", "train    nav2d: 48"]),
]


@pytest.mark.parametrize(("fields", "expected"), PLANS, ids=[str(fields) for fields, _ in PLANS])
def test_the_plan_says_what_will_run(fields, expected):
    config = with_fields(CONFIG, **fields)
    lines = plan(config, *make_envs(config)).splitlines()
    assert len(lines) == len(expected)
    for line, start in zip(lines, expected, strict=True):
        assert line.startswith(start)


def test_a_reset_at_a_change_that_never_comes_is_refused():
    config = with_fields(CONFIG, train__ppo__reset_at_change=True)
    with pytest.raises(ConfigError, match=r"train\.ppo\.reset_at_change: expected a task that changes.*got nav2d"):
        make_envs(config)
    make_envs(with_fields(config, env__change_after=3))
