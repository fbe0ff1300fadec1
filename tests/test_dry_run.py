"""What the command lines refuse before they begin, dry or not, and readers that have seen enough."""

import subprocess
import sys
from pathlib import Path

import pytest

from taic_jax import run
from taic_jax.run import main


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


MISSING_RUNS = {
    "options of no run": ("transfer_ant_turn --options runs/none", "runs/none: expected a run"),
    "experience of no run": ("nav2d --options.experience runs/none", "runs/none: expected a run"),
    "no run to resume": ("nav2d --resume --run-dir runs/none", "runs/none holds no run to resume"),
    "a folder in use": ("nav2d --run-dir used", "used already holds files"),
    "a folder that is no run's": ("nav2d --overwrite --run-dir used", "used is not a run's folder"),
}


@pytest.mark.parametrize("dry", ["", " --dry-run --quiet"], ids=["run", "dry run"])
@pytest.mark.parametrize(("args", "message"), MISSING_RUNS.values(), ids=MISSING_RUNS)
def test_a_dry_run_refuses_whatever_the_run_would(capfd, args, message, dry):
    Path("used").mkdir()
    Path("used/mine.txt").write_text("mine")
    assert main((args + dry).split()) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.count("\n") == 1 and message in err
    assert [str(path) for path in Path().rglob("*")] == ["used", "used/mine.txt"]


@pytest.mark.parametrize("module", ["run", "sweep", "experiments.evidence"])
def test_a_reader_that_has_seen_enough_is_no_error(module):
    """As `head -c 1` does: the pipe is closed before the process writes its last lines."""
    args = {"run": ["--dry-run", "--quiet"], "sweep": ["--help"], "experiments.evidence": ["--list"]}[module]
    command = [sys.executable, "-m", f"taic_jax.{module}", *args]
    root = Path(run.__file__).parents[1]
    child = subprocess.Popen(command, cwd=root, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout and child.stderr
    child.stdout.close()
    assert (child.stderr.read(), child.wait()) == ("", 0)
    child.stderr.close()
