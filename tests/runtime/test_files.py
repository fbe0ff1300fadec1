"""A run that cannot write ends in one line, loses nothing that was saved, and goes on when it can."""

import json
import os
import re
from pathlib import Path

import pytest
from tiny_runs import CONFIG, assert_same_arrays, last_state, rows_of, tiny_steps

from taic_jax import pipeline
from taic_jax.config.files import to_yaml
from taic_jax.run import main
from taic_jax.runtime.checkpoint import Checkpoints
from taic_jax.runtime.files import PARTIAL, TEMPORARY
from taic_jax.runtime.logging import RunLogger


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with tiny_steps():
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    (folder / "config.yaml").write_text(to_yaml(CONFIG))
    assert main([str(folder / "config.yaml"), "--run-dir", str(folder / "whole")]) == 0
    return folder / "whole"


@pytest.fixture(autouse=True)
def in_folder_with_config(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("config.yaml").write_text(to_yaml(CONFIG))


# The disk is full from so many calls of a function on, and what is told then. A checkpoint is written while the next
# iteration is done, so it may be the one before that is told, and is lost.
FULL = {
    "checkpoint": (Checkpoints, "save", 3, "checkpoints/collect/[23]"),
    "metrics": (RunLogger, "log", 5, "metrics.jsonl"),
    "events": (RunLogger, "_write_events", 3, "tensorboard"),
    "artifact": (pipeline, "save_agents", 1, "agents/collect/arrays.safetensors"),
    "summary": (pipeline, "as_summary", 1, "summary.json"),
}


@pytest.mark.parametrize("case", FULL)
def test_a_full_disk_ends_the_run_in_one_line_and_it_goes_on(whole, monkeypatch, capsys, limit, case):
    owner, method, count, told = FULL[case]
    with monkeypatch.context() as patch:
        fill_at(patch, limit, owner, method, count)
        assert main(["config.yaml", "--run-dir", "run", "--checkpoint-seconds", "0", "--quiet"]) == 74
    limit(None)
    (line,) = capsys.readouterr().err.splitlines()
    assert re.match(rf"taic_jax: error: (/.*/)?run/{told}: cannot be written: File too large;", line), line
    assert line.endswith("--resume --run-dir run goes on")
    assert Checkpoints(Path("run/checkpoints/collect")).steps() and no_leftovers(Path("run"))
    assert main(["--run-dir", "run", "--resume"]) == 0
    assert rows_of(Path("run")) == rows_of(whole)
    a, b = (json.loads((folder / "summary.json").read_text()) for folder in (whole, Path("run")))
    assert a["methods"] == b["methods"] and a["ticks"] == b["ticks"]
    for stage in ("collect", "learn", "train"):
        assert_same_arrays(last_state(whole, stage), last_state(Path("run"), stage))


def no_leftovers(folder: Path) -> bool:
    return not list(folder.rglob(f"*{PARTIAL}")) and not list(folder.rglob(f"*{TEMPORARY}"))


def fill_at(patch: pytest.MonkeyPatch, limit, owner, method: str, count: int) -> None:
    """Let no file grow any more from the `count`-th call of a function on."""
    original, calls = getattr(owner, method), []

    def call(*args):
        calls.append(args)
        if len(calls) == count:
            limit(1)
        return original(*args)

    patch.setattr(owner, method, call)


def test_where_nothing_can_be_written_nothing_is_begun(capsys, limit):
    Path("file").touch()
    limit(100)
    try:
        for folder in ("file", "file/run", "new"):
            assert main(["config.yaml", "--run-dir", folder]) == 2
            line = capsys.readouterr().err
            assert line.count("\n") == 1 and f"error: {folder}" in line, line
    finally:
        limit(None)
    assert Path("file").read_bytes() == b"" and no_leftovers(Path())
    assert main(["config.yaml", "--run-dir", "new", "--dry-run", "--quiet"]) == 0


def test_a_read_only_run_is_not_resumed(whole, monkeypatch, capfd):
    original = os.open

    def read_only(path, flags, *args, **kwargs):
        if Path(path).is_relative_to(whole) and flags & (os.O_RDWR | os.O_WRONLY):
            raise OSError(30, "Read-only file system", str(path))
        return original(path, flags, *args, **kwargs)

    monkeypatch.setattr(os, "open", read_only)
    assert main(["--run-dir", str(whole), "--resume"]) == 2
    assert f"{whole} cannot be written: Read-only file system" in capfd.readouterr().err


def test_what_a_killed_run_left_half_written_is_removed(whole):
    (whole / "experience" / f"000009.npz{PARTIAL}").write_text("half")
    (whole / "checkpoints/train" / f"3{TEMPORARY}/state").mkdir(parents=True)
    assert main(["--run-dir", str(whole), "--resume"]) == 0
    assert no_leftovers(whole)


def test_a_run_begun_by_a_damaged_clock_is_refused(whole, capfd):
    text = (whole / "clock.json").read_text()
    (whole / "clock.json").write_text(text[:5])
    assert main(["--run-dir", str(whole), "--resume"]) == 2
    assert "clock.json: expected the seconds of a run" in capfd.readouterr().err
    (whole / "clock.json").write_text(text)
