"""Chunks of a sweep as tasks on a Ray cluster, one a node at a time; a task of a lost node resumes on another."""

import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from taic_jax.config import ConfigError
from taic_jax.envs.errors import MissingExtraError
from taic_jax.runtime.run_folder import BusyError
from taic_jax.runtime.signals import Signals

try:
    import ray  # pyright: ignore[reportMissingImports]
except ImportError:
    raise MissingExtraError("ray", "cluster") from None

LOCAL = "local"
PATIENCE = 15.0  # seconds for a cluster to answer
RETRIES = 100  # lost nodes per task
RELEASE = 60.0  # seconds that a task waits for the process of a lost node to unlock the folder
_PROBE = "import ray, sys; ray.init(sys.argv[1], logging_level='ERROR', log_to_driver=False)"


def connect(address: str) -> None:
    """Connect to a cluster, or start one here for `local`; raise ConfigError for a silent one or another version."""
    if address != LOCAL and (problem := _probe(address)):
        expected = f"expected the HOST:PORT of a Ray cluster, got no answer of {address} {problem}"
        raise ConfigError(f"--cluster: {expected}; {LOCAL} starts one here")
    ray.init(address, logging_level=logging.ERROR, namespace="taic_jax")


def _probe(address: str) -> str | None:
    """Return a cluster's failure to answer, if any; by another process, as Ray waits longer and cannot be stopped."""
    command = [sys.executable, "-c", _PROBE, address]
    try:
        probe = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        return f"in {PATIENCE:.0f} s"
    return f"({(probe.stderr.strip().splitlines() or [''])[-1]})" if probe.returncode else None


def run_tasks(work: Callable[..., Any], tasks: Sequence[tuple], signals: Signals | None = None) -> Iterator[Any]:
    """Yield the results of `work(*task)` as tasks end; each takes a node of the smallest kind, in this folder."""
    remote: Any = ray.remote(max_retries=RETRIES, scheduling_strategy="SPREAD", **_smallest_node())(_in_folder)
    waiting = [remote.remote(Path.cwd(), work, task) for task in tasks]
    try:
        while waiting:
            ended, waiting = ray.wait(waiting, timeout=1.0)
            if signals:
                signals.check()
            for task in ended:
                yield ray.get(task)
    finally:
        for task in waiting:
            ray.cancel(task, force=True)


def _in_folder(folder: Path, work: Callable[..., Any], task: tuple) -> Any:
    os.chdir(folder)
    deadline = time.monotonic() + RELEASE
    while True:
        try:
            return work(*task)
        except BusyError:
            if time.monotonic() > deadline:
                raise
            time.sleep(1.0)


def _smallest_node() -> dict[str, Any]:
    """Return the least number of processors of each kind over the nodes that have any."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    least = {kind: min((node[kind] for node in nodes if node.get(kind)), default=0.0) for kind in ("CPU", "GPU")}
    return {"num_cpus": least["CPU"], "num_gpus": least["GPU"]}
