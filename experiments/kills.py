"""Kill runs at random moments, resume them, and compare each with a run that was left alone, bit by bit.

python -m taic_jax.experiments.kills --kills 50

Each is killed once by SIGKILL, at a moment drawn uniformly over the length of a whole run with a whole sweep after it,
start and compilation included. Compiled programs are kept in a cache, so that a run is mostly what is tested.
"""

import dataclasses
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from taic_jax.command_line import tell
from taic_jax.config import CollectConfig, Config, EnvConfig, EvaluateConfig, OptionsConfig, PPOConfig, TrainConfig
from taic_jax.config_io import to_yaml
from taic_jax.runtime.run_folder import RunFolder

POINTS = ("--axes", "train.ppo.learning_rate=3e-4,1e-3", "--chunk", "1")
"""Of the sweep: a chunk, that is a whole run, for each."""
SMALL = PPOConfig(num_envs=4, rollout_length=64, epochs=2, minibatch_size=64, hidden_sizes=(16,))


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Kill, resume, compare; exit code 1 if a resumed run differs."""

    kills: int = 50
    """Runs to kill."""
    env: str = "nav2d"
    """Task of the runs."""
    seeds: int = 2
    """Seeds of each run."""
    seed: int = 0
    """Of the moments."""
    iterations: int = 60
    """Iterations of collect, and of train; hundreds of gradient steps of learn."""
    jobs: int = 1
    """Runs to kill side by side."""


def config(arguments: Arguments) -> Config:
    """Return the config of the runs: every stage small, a checkpoint at nearly every iteration."""
    ticks = arguments.iterations * SMALL.num_envs * SMALL.rollout_length
    return Config(
        env=EnvConfig(name=arguments.env),
        collect=CollectConfig(ticks=ticks, capacity=ticks // 2, ppo=SMALL),
        options=OptionsConfig(hidden_size=16, mlp_sizes=(16,), steps=100 * arguments.iterations, batch_size=32),
        train=TrainConfig(ticks=ticks, ppo=SMALL),
        evaluate=EvaluateConfig(episodes=2, video_ticks=0),
        seeds=arguments.seeds,
    )


def start(folder: Path, kind: str, *args: str) -> subprocess.Popen:
    """Start a run or a sweep in a process of its own, that keeps its compiled programs beside the folder."""
    cache = {"JAX_COMPILATION_CACHE_DIR": str(folder.parent / "compiled")}
    cache |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, "-W", "ignore", "-m", f"taic_jax.{kind}", *args, "--run-dir", str(folder)]
    command += ["--checkpoint-seconds", "0", *(POINTS if kind == "sweep" else ())]
    return subprocess.Popen(command, env=os.environ | cache, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def finish(process: subprocess.Popen) -> None:
    """Wait for a run's end.

    Raises:
      RuntimeError: it failed.
    """
    _, err = process.communicate()
    if process.returncode:
        raise RuntimeError(err.decode())


def outcome(folder: Path) -> dict[str, Any]:
    """Return all that a run or a sweep leaves and that must not depend on interruptions, by name."""
    if not (folder / "summary.json").exists():
        chunks = {f"{path.name}/{name}": x for path in folder.glob("chunk-*") for name, x in outcome(path).items()}
        return chunks | {name: (folder / name).read_bytes() for name in ("table.csv", "best.yaml", "plan.json")}
    summary = json.loads((folder / "summary.json").read_text())
    rows = [{k: v for k, v in row.items() if k != "time"} for row in RunFolder(folder).metrics()]
    rows.sort(key=lambda row: row["stage"])  # an evaluation is told again after a resume, later than it was
    result: dict[str, Any] = {"methods": summary["methods"], "ticks": summary["ticks"], "rows": rows}
    return result | dict(_arrays(folder))


def _arrays(folder: Path) -> Iterator[tuple[str, bytes]]:
    from taic_jax.runtime.checkpoint import load_arrays

    for path in sorted(folder.rglob("*.npz")):
        with np.load(path) as blocks:
            for name in blocks.files:
                yield f"{path.relative_to(folder)}/{name}", blocks[name].tobytes()
    for marker in sorted(folder.rglob("_CHECKPOINT_METADATA")):
        tree = marker.parent
        for name, array in load_arrays(tree).items():
            yield f"{tree.relative_to(folder)}/{name}", array.tobytes()


def differences(a: dict[str, Any], b: dict[str, Any]) -> list[str]:
    """Return the names under which two outcomes differ."""
    return sorted(name for name in {**a, **b} if a.get(name) != b.get(name))


def stage_of(folder: Path, kind: str) -> str:
    """Return the stage that a run was in when it was killed, or that it was a sweep."""
    if kind == "sweep":
        return "sweep"
    run = RunFolder(folder)
    rows = run.metrics() if run.metrics_path.exists() else []
    return "end" if (folder / "summary.json").exists() else rows[-1]["stage"] if rows else "start"


def kill_one(folder: Path, kind: str, source: str, seconds: float) -> str:
    """Kill a run or a sweep after so many seconds, finish it, and return the stage it was killed in."""
    process = start(folder, kind, source)
    time.sleep(seconds)
    process.kill()
    process.communicate()
    stage = stage_of(folder, kind)
    begun = (folder / "config.yaml").exists()
    finish(start(folder, kind, "--resume" if begun else source))
    return stage


def whole(root: Path, kind: str, source: str) -> tuple[dict[str, Any], float]:
    """Return what is left of a run or a sweep that is not killed, and how long it takes."""
    begun = time.perf_counter()
    finish(start(root / kind, kind, source))
    return outcome(root / kind), time.perf_counter() - begun


def main() -> int:
    """Run the experiment; return 1 if any resumed run differs."""
    arguments = tyro.cli(Arguments)
    moments, killed, bad = random.Random(arguments.seed), [], 0
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(arguments.jobs) as pool:
        root = Path(name)
        source = root / "config.yaml"
        source.write_text(to_yaml(config(arguments)))
        finish(start(root / "warm", "run", str(source)))  # fills the cache
        expected = {kind: whole(root, kind, str(source)) for kind in ("run", "sweep")}
        run, sweep = (length for _, length in expected.values())
        drawn = [moments.uniform(-run, sweep) for _ in range(arguments.kills)]
        kinds = ["sweep" if seconds > 0 else "run" for seconds in drawn]
        seconds = [moment if moment > 0 else moment + run for moment in drawn]
        folders = [root / str(i) for i in range(arguments.kills)]
        stages = pool.map(kill_one, folders, kinds, [str(source)] * arguments.kills, seconds)
        for i, stage in enumerate(stages):
            killed.append(stage)
            found = differences(expected[kinds[i]][0], outcome(folders[i]))
            bad += bool(found)
            print(f"{i + 1:3}  killed after {seconds[i]:5.1f} s in {stage:8}", "differs:" if found else "identical",
                  *found[:3], flush=True)  # fmt: skip
            shutil.rmtree(folders[i])
    counts = ", ".join(f"{killed.count(stage)} in {stage}" for stage in dict.fromkeys(killed))
    print(f"{arguments.kills} runs killed ({counts}): {arguments.kills - bad} resumed runs identical, {bad} not")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(tell(main))
