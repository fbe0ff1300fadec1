"""Chunks of a sweep on a Ray cluster: two nodes of which one is taken away, and an address that does not answer."""

import os
import socket
import threading
import time
from pathlib import Path

import pytest

ray = pytest.importorskip("ray", reason="Ray is not installed (extra cluster)")
cluster_utils = pytest.importorskip("ray.cluster_utils")

from taic_jax.sweep import ray_tasks as clusters  # noqa: E402
from taic_jax.sweep.__main__ import main  # noqa: E402

TESTS = Path(__file__).parents[1]


def work(folder: Path, name: str) -> tuple[str, str, int]:
    """Count to 20 in a file, going on from where another process was; return on which node it ended."""
    node = ray.get_runtime_context().get_node_id()
    count = folder / name
    (folder / f"{name}-{node}").touch()
    for i in range(int(count.read_text()) if count.exists() else 0, 20):
        count.write_text(str(i + 1))
        with (folder / f"{name}-steps").open("a") as steps:
            steps.write(f"{i}\n")
        time.sleep(0.2)
    return name, node, int(count.read_text())


@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_a_task_of_a_lost_node_goes_on_on_another_from_where_it_was(tmp_path, monkeypatch):
    monkeypatch.setenv("RAY_health_check_period_ms", "300")
    monkeypatch.setenv("RAY_health_check_failure_threshold", "3")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(str(path) for path in (TESTS, TESTS.parent)))
    monkeypatch.setattr(clusters, "PATIENCE", 150.0)  # of a machine that has much else to do
    nodes = cluster_utils.Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        other = nodes.add_node(num_cpus=1)
        clusters.connect(nodes.address)
        taken = []

        def take_away() -> None:
            while not (marks := list(tmp_path.glob(f"*-{other.node_id}"))):
                time.sleep(0.1)
            time.sleep(1.0)
            nodes.remove_node(other, allow_graceful=False)
            taken.extend(marks)

        thread = threading.Thread(target=take_away)
        thread.start()
        results = list(clusters.run_tasks(work, [(tmp_path, "a"), (tmp_path, "b")]))
        thread.join()
    finally:
        ray.shutdown()
        nodes.shutdown()
    lost = taken[0].name.partition("-")[0]
    assert sorted((name, count) for name, _, count in results) == [("a", 20), ("b", 20)]
    assert other.node_id not in [node for _, node, _ in results]
    assert len(list(tmp_path.glob(f"{lost}-*"))) == 3  # its steps, and the nodes that it was on
    assert len((tmp_path / f"{lost}-steps").read_text().split()) <= 21  # not from the start again


def test_a_cluster_that_does_not_answer_is_told_in_one_line(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    args = ["--axes", "train.ppo.gamma=0.9,0.99", "--chunk", "1", "--run-dir", "new", "--cluster"]
    with socket.create_server(("127.0.0.1", 0)) as silent:
        assert main([*args, f"127.0.0.1:{silent.getsockname()[1]}"]) == 2
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and "got no answer" in err and not Path("new").exists()
