"""Two processes, as on two hosts, do what one does: over seeds, environments, told to stop, and resumed."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_devices import assert_same_run
from tiny_runs import CONFIG, SLOPE, with_fields

from taic_jax.config.files import to_yaml
from taic_jax.run import main
from taic_jax.runtime import hosts

TESTS = Path(__file__).parents[1]
LONG = with_fields(CONFIG, env__name="slope.py:Slope", collect__ticks=20 * 16, train__ticks=20 * 16, seeds=3)
"""Long enough to be stopped while it collects."""


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    """Run three seeds in one process."""
    folder = tmp_path_factory.mktemp("one")
    (process,) = begin(folder, 1, "--shard", "none")
    assert process.communicate()[1] == "" and process.returncode == 0
    return folder / "run"


def begin(folder: Path, count: int, *args: str, differ: tuple[str, ...] = ()) -> list[subprocess.Popen]:
    """Start a run in a folder on so many hosts, the last of them with the arguments `differ` too."""
    folder.mkdir(exist_ok=True)
    (folder / "slope.py").write_text(SLOPE)
    (folder / "config.yaml").write_text(to_yaml(LONG))
    paths = os.pathsep.join(str(path) for path in (TESTS, TESTS.parent))
    line = [sys.executable, "-W", "ignore", "-m", "taic_jax.run", "config.yaml", "--run-dir", "run", "--quiet", *args]
    if count > 1:
        line += ["--hosts", str(count), "--coordinator", f"127.0.0.1:{free_port()}"]
    return [
        subprocess.Popen(
            [*line, *(["--host", str(host)] if count > 1 else []), *(differ if host == count - 1 else ())],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": paths},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for host in range(count)
    ]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def ends(processes: list[subprocess.Popen]) -> list[tuple[int, str]]:
    """Wait for processes; return their exit codes and what they told."""
    told = [process.communicate()[1] for process in processes]
    return [(process.returncode, text) for process, text in zip(processes, told, strict=True)]


def test_seeds_over_two_hosts_do_as_on_one_and_a_signal_to_one_stops_both(one, tmp_path):
    processes = begin(tmp_path, 2, "--shard", "seeds")
    log = tmp_path / "run/metrics.jsonl"
    while not (log.exists() and "collect" in log.read_text()):
        assert processes[1].poll() is None, processes[1].communicate()[1]
        time.sleep(0.05)
    processes[1].send_signal(signal.SIGTERM)
    for code, told in ends(processes):
        assert code == 75 and "stopped by SIGTERM" in told, told
    assert not (tmp_path / "run/summary.json").exists()
    for code, told in ends(begin(tmp_path, 2, "--shard", "seeds", "--resume")):
        assert code == 0, told
    assert_same_run(one, tmp_path / "run", ("collect", "learn", "train"))
    assert kept(one) == kept(tmp_path / "run")


def kept(run: Path) -> set[str]:
    """Return the names of the files of a run, but for those of trees."""
    names = (str(path.relative_to(run)) for path in run.rglob("*.*"))
    return {name for name in names if name.endswith((".json", ".jsonl", ".npz", ".webp")) and "/state/" not in name}


def test_environments_over_two_hosts_do_as_on_one(one, tmp_path):
    # Each host has two devices.
    args = ["--options", str(one), "--train.baselines", "--shard", "envs"]
    args += ["--train.ppo.num-envs", "4", "--collect.ppo.num-envs", "4"]
    (alone,) = ends(begin(tmp_path / "a", 1, *args))
    assert alone[0] == 0, alone[1]
    for code, told in ends(begin(tmp_path / "b", 2, *args)):
        assert code == 0, told
    assert_same_run(tmp_path / "a/run", tmp_path / "b/run", ("train",))


def test_hosts_that_were_told_different_things_say_so(tmp_path):
    for code, told in ends(begin(tmp_path, 2, "--shard", "seeds", differ=("--seed", "7"))):
        assert code == 2 and "expected the same config on every host" in told.splitlines()[-1]
    assert not (tmp_path / "run").exists()


def test_a_first_host_that_does_not_answer_is_told_in_one_line(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(hosts, "PATIENCE", 0.5)
    address = f"127.0.0.1:{free_port()}"
    args = ["--seeds", "2", "--hosts", "2", "--host", "1", "--run-dir", "new", "--coordinator", address]
    assert main(args) == 2
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and f"{address} has not answered" in err and not Path("new").exists()
