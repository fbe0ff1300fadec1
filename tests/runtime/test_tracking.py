"""Trackers: each row once, means and seeds, the same run after a resume; the packages themselves where they are."""

import json
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from tiny_runs import CONFIG, KilledError, die, with_fields

from taic_jax import run
from taic_jax.config import Config, ConfigError, walk
from taic_jax.config.files import to_yaml
from taic_jax.envs.errors import MissingExtraError
from taic_jax.runtime import tracking
from taic_jax.runtime.logging import RunLogger
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.runtime.tracking import follow
from taic_jax.sweep.__main__ import main as sweep

TRACKERS = ("wandb", "trackio")
SUMMARY = {"methods": {"taic": {"return": {"per_seed": [1.0, None]}, "return_mean_option": {"per_seed": [2.0, 4.0]}}}}


class Fake(types.ModuleType):
    """A tracker that records its runs by name."""

    def __init__(self, name):
        super().__init__(name)
        self.runs: dict[str, list[dict]] = {}
        self.calls: list[dict] = []
        self.finished: list[str] = []
        self.login = lambda: True
        self.Histogram = lambda np_histogram: [x.tolist() for x in np_histogram]

    def init(self, *, name, **settings):
        print("a greeting")
        self.calls.append({"name": name, **settings})
        rows = self.runs.setdefault(name, [])
        return types.SimpleNamespace(
            log=lambda values, step=None: rows.append({"step": step, **values}),
            define_metric=lambda name, step_metric: None,
            finish=lambda: self.finished.append(name),
        )


@pytest.fixture(params=TRACKERS)
def fake(request, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    package = Fake(request.param)
    monkeypatch.setitem(sys.modules, request.param, package)
    return package


def begin(path: Path) -> RunFolder:
    path.mkdir()
    (path / "config.yaml").write_text(to_yaml(CONFIG))
    return RunFolder(path)


def steps(package: Fake, stage: str, run: str | None = None) -> list[int]:
    """Return the ticks of all that was sent of a stage, which stand in a place of their own with each tracker."""
    rows = package.runs[run or next(iter(package.runs))]
    place = "step" if package.__name__ == "trackio" else f"{stage}/count"
    return [row[place] for row in rows if any(name.startswith(f"{stage}/") for name in row)]


def test_rows_are_means_and_seeds_and_counts_are_a_histogram(fake, tmp_path, capsys):
    folder = begin(tmp_path / "a")
    with follow(fake.__name__, folder, CONFIG, "a"), RunLogger(folder.path, quiet=True) as logger:
        row = {"return": np.array([1.0, 3.0]), "episodes": 3, "durations": np.array([[1.0, 0, 4], [2, 0, 3]])}
        logger.log("train", 16, row | {"lost": np.array([np.nan, 5.0]), "none": np.nan})
        folder.summary_path.write_text(json.dumps(SUMMARY))
    (name,), (call,) = fake.runs, fake.calls
    first, last = fake.runs[name]
    place = {"step": 16} if fake.__name__ == "trackio" else {"step": None, "train/count": 16}
    assert first == place | {
        "train/return": 2.0, "train/return/seed0": 1.0, "train/return/seed1": 3.0, "train/episodes": 3,
        "train/durations": [[3.0, 0.0, 7.0], [0.5, 1.5, 2.5, 3.5]], "train/lost": 5.0, "train/lost/seed1": 5.0,
    }  # fmt: skip
    assert last["summary/taic/return"] == 1.0 and last["summary/taic/return_mean_option/seed1"] == 4.0
    assert "summary/taic/return/seed1" not in last and fake.finished == [name] and name.startswith("a ")
    assert call["config"] == dict(walk(CONFIG)) and call["project"] == "taic_jax" and call["resume"] == "allow"
    assert ("id" in call) == (fake.__name__ == "wandb") and capsys.readouterr().out == ""


def test_rows_are_sent_while_the_run_goes_on(fake, tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "INTERVAL", 0.01)
    monkeypatch.setenv("WANDB_PROJECT", "mine")
    folder = begin(tmp_path / "a")
    with follow(fake.__name__, folder, CONFIG, "a"), RunLogger(folder.path, quiet=True) as logger:
        for ticks in (16, 32):
            logger.log("train", ticks, {"return": 1.0})
            while len(steps(fake, "train")) < ticks // 16:  # the test's own timeout ends it
                pass
    assert steps(fake, "train") == [16, 32] and fake.calls[0]["project"] == "mine"


def test_a_killed_run_goes_on_as_the_same_and_nothing_is_sent_twice(fake, tmp_path, monkeypatch):
    Path("tiny.yaml").write_text(to_yaml(with_fields(CONFIG, evaluate__video_ticks=0)))
    args = ["--run-dir", "a", "--track", fake.__name__, "--checkpoint-seconds", "1000", "--quiet"]
    with monkeypatch.context() as patch:
        die(patch, RunLogger, "log", 8)  # in stage train, none of whose steps is saved
        with pytest.raises(KilledError):
            run.main(["tiny.yaml", *args])
    (name,) = fake.runs
    assert steps(fake, "train") == [16, 32] and fake.finished == [name]
    assert run.main([*args, "--resume"]) == 0
    assert list(fake.runs) == [name] and fake.calls[0] == fake.calls[1]
    assert [steps(fake, stage) for stage in ("collect", "train")] == [[16, 32, 48]] * 2
    rows = {name for row in fake.runs[name] for name in row}
    assert {"evaluate/train/return", "evaluate/collect/return", "summary/flat/return_mean_option/seed1"} <= rows
    # Another run in the same place is another run of the tracker, and has none of the rows of the first.
    assert run.main(["tiny.yaml", *args, "--overwrite"]) == 0
    _, second = fake.runs
    assert second != name and steps(fake, "train", second) == [16, 32, 48]
    assert "track" not in (tmp_path / "a/config.yaml").read_text()


def test_points_of_a_sweep_are_runs_with_their_own_config_and_seeds(fake):
    Path("tiny.yaml").write_text(to_yaml(CONFIG))
    args = ["--axes", "train.ppo.gamma=0.5,0.9", "--run-dir", "s", "--quiet", "--chunk", "2", "--track", fake.__name__]
    assert sweep(["tiny.yaml", *args]) == 0
    first, second = fake.runs
    assert first.startswith("s-0 ") and second.startswith("s-1 ")
    assert [call["config"]["train.ppo.gamma"] for call in fake.calls] == [0.5, 0.9]
    summary = RunFolder(Path("s/chunk-000")).summary()["methods"]["taic"]["return"]["per_seed"]
    for k, rows in enumerate(fake.runs.values()):
        assert [rows[-1][f"summary/taic/return/seed{i}"] for i in range(2)] == summary[2 * k : 2 * k + 2]
        assert len({name for row in rows for name in row if "seed2" in name}) == 0
    assert steps(fake, "train", second) == [16, 32, 48]


def refuse(message):
    raise RuntimeError(message)


COMMANDS = {
    "run": (run.main, []),
    "dry run": (run.main, ["--dry-run"]),
    "sweep": (sweep, ["--axes", "train.ppo.gamma=0.5,0.9"]),
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("missing", [True, False], ids=["missing", "silent"])
def test_a_tracker_that_refuses_is_one_line_and_nothing_is_written(fake, monkeypatch, capsys, missing, command):
    name, (main, args) = fake.__name__, COMMANDS[command]
    if missing:
        monkeypatch.setitem(sys.modules, name, None)
    elif name == "wandb":
        monkeypatch.setattr(fake, "login", lambda: refuse("no\nlogin"))
    else:
        monkeypatch.setattr(fake, "init", lambda **settings: refuse("no\nlogin"))
        main, args = COMMANDS["run"]  # the one that opens a run of the tracker at once
    assert main([*args, "--track", name, "--run-dir", "a", "--quiet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    absent = f"error: the package {name} is not installed: pip install 'taic-jax[{name}]'"
    assert line.endswith(absent if missing else f"error: --track {name}: no login")
    assert not any(Path().iterdir())


def test_a_folder_in_use_is_refused_before_the_tracker_has_a_run(fake, capsys):
    begin(Path("a").resolve())
    assert run.main(["--run-dir", "a", "--track", fake.__name__]) == 2
    assert "a already holds files" in capsys.readouterr().err and fake.calls == []


def test_an_unknown_tracker_and_a_damaged_file_are_told_in_one_line(fake, tmp_path, capsys):
    assert run.main(["--track", "wandbb"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--track: expected one of none, wandb, trackio, got 'wandbb'; the nearest is wandb" in line
    folder = begin(tmp_path / "a")
    (folder.path / f"{fake.__name__}-a.json").write_text("{")
    with pytest.raises(ConfigError, match=f"--track {fake.__name__}: "), follow(fake.__name__, folder, CONFIG, "a"):
        pass


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", TRACKERS)
def test_the_tracker_itself_takes_the_rows(name, tmp_path, monkeypatch):
    """Skipped where the extra is missing."""
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    monkeypatch.chdir(tmp_path)
    package = pytest.importorskip(name)
    folder = begin(tmp_path / "a")
    for ticks in (16, 32):  # the second goes on
        with follow(name, folder, Config(), "a"), RunLogger(folder.path, quiet=True) as logger:
            logger.log("train", ticks, {"return": np.array([1.0, 3.0]), "durations": np.array([[1.0, 2.0], [0, 1]])})
    if name == "wandb":
        text = b"".join(path.read_bytes() for path in (tmp_path / "wandb").rglob("*.wandb"))
        assert text.count(b"train/return/seed1") >= 2 and b"train.ppo.gamma" in text
        (code,) = {path.name.rpartition("-")[2] for path in (tmp_path / "wandb").glob("offline-run-*")}
        assert code == json.loads((folder.path / "wandb-a.json").read_text())["id"]
    else:
        from trackio.sqlite_storage import SQLiteStorage  # pyright: ignore[reportMissingImports]

        (run_name,) = SQLiteStorage.get_runs("taic_jax")
        rows = SQLiteStorage.get_logs("taic_jax", run_name)
        sent = [(row["step"], row["train/return"], row["train/return/seed1"]) for row in rows]
        assert sent == [(16, 2, 3), (32, 2, 3)]
        assert (SQLiteStorage.get_run_config("taic_jax", run_name) or {})["train.ppo.gamma"] == 0.99
    assert package.__name__ == name


def test_without_the_extra_the_line_names_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(MissingExtraError, match=r"taic-jax\[wandb\]"):
        tracking.tracker_package("wandb")
