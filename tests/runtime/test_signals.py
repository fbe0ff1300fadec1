"""Being asked to stop: the iteration ends, everything is saved, the exit code tells, and the run can go on."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from tiny_runs import CONFIG, tiny_steps

from taic_jax.config.files import to_yaml
from taic_jax.run import main
from taic_jax.runtime import driver
from taic_jax.runtime.checkpoint import Checkpoints, load_arrays
from taic_jax.runtime.logging import RunLogger
from taic_jax.runtime.signals import Interrupted, Signals


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with tiny_steps():
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """Return the folder of a run that was not told to stop."""
    folder = tmp_path_factory.mktemp("whole")
    (folder / "config.yaml").write_text(to_yaml(CONFIG))
    assert main([str(folder / "config.yaml"), "--run-dir", str(folder / "run")]) == 0
    return folder / "run"


def receive_at(monkeypatch: pytest.MonkeyPatch, number: int, row: int) -> None:
    """Send this process a signal when it has logged so many rows."""
    original, rows = RunLogger.log, []

    def log(self, *args):
        original(self, *args)
        rows.append(args)
        if len(rows) == row:
            signal.raise_signal(number)

    monkeypatch.setattr(RunLogger, "log", log)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 75)])
def test_a_signal_lets_the_iteration_end_and_saves(whole, tmp_path, monkeypatch, capfd, number, code):
    monkeypatch.setattr(driver, "CHECKPOINT_SECONDS", 1e9)  # nothing is saved before its time but by the signal
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.yaml").write_text(to_yaml(CONFIG))
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with monkeypatch.context() as patch:
        receive_at(patch, number, 2)
        assert main(["config.yaml", "--run-dir", "run"]) == code
    err = capfd.readouterr().err.splitlines()
    assert "--resume --run-dir run" in err[-1] and number.name in err[-1]
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before
    assert Checkpoints(tmp_path / "run/checkpoints/collect").steps() == [2]
    assert main(["--run-dir", "run", "--resume"]) == 0
    expected, resumed = (json.loads((folder / "summary.json").read_text()) for folder in (whole, tmp_path / "run"))
    assert expected["methods"] == resumed["methods"] and expected["ticks"] == resumed["ticks"]
    trees = [folder / "checkpoints/train/3" for folder in (whole, tmp_path / "run")]
    for a, b in zip(*(jax.tree.leaves(load_arrays(tree)) for tree in trees), strict=True):
        np.testing.assert_array_equal(a, b)


def test_without_a_signal_nothing_is_raised():
    with Signals() as signals:
        signals.check()
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(Interrupted, match="SIGTERM"):
            signals.check()
    Signals().check()


CHILD = """
import time
from taic_jax.runtime.signals import Signals
with Signals():
    print("ready", flush=True)
    for _ in range(600):
        time.sleep(0.1)
"""


def test_a_second_ctrl_c_ends_at_once():
    child = subprocess.Popen([sys.executable, "-c", CHILD], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout and child.stderr and child.stdout.readline() == "ready\n"
    child.send_signal(signal.SIGINT)
    assert "stopping after this iteration" in child.stderr.readline()
    assert child.poll() is None
    child.send_signal(signal.SIGINT)
    assert child.wait(timeout=10) == -signal.SIGINT
    child.stdout.close()
    child.stderr.close()
