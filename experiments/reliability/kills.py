"""Kill runs at random moments, resume them, and compare each with a run that was left alone, bit by bit.

python -m taic_jax.experiments.reliability.kills --kills 50

Each is killed once by SIGKILL, at a moment drawn uniformly over the length of a whole run with a whole sweep after it,
start and compilation included. Compiled programs are cached, so that a run is mostly what is tested.
"""

import contextlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from taic_jax.command_line import tell
from taic_jax.config import CollectConfig, Config, EnvConfig, EvaluateConfig, OptionsConfig, PPOConfig, TrainConfig
from taic_jax.config_io import to_yaml
from taic_jax.runtime.checkpoint import load_arrays
from taic_jax.runtime.run_folder import RunFolder

POINTS = ("--axes", "train.ppo.learning_rate=3e-4,1e-3", "--chunk", "1")
"""Of the sweep: a chunk, that is a whole run, for each."""
SMALL = PPOConfig(num_envs=4, rollout_length=64, epochs=2, minibatch_size=64, hidden_sizes=(16,))


@dataclass(frozen=True)
class Arguments:
    """Kill, resume, compare; exit code 1 if a resumed run differs."""

    kills: int = 50  # Runs to kill.
    env: str = "nav2d"  # Task of the runs.
    seeds: int = 2  # Seeds of each run.
    seed: int = 0  # Of the moments.
    iterations: int = 60  # Iterations of collect, and of train; hundreds of gradient steps of learn.
    jobs: int = 1  # Runs to kill side by side.


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


def execute(folder: Path, kind: str, source: str, seconds: float | None = None) -> None:
    """Execute a run or a sweep, which keeps its compiled programs beside the folder; kill it after so many seconds.

    Raises:
      RuntimeError: it failed.
    """
    cache = {"JAX_COMPILATION_CACHE_DIR": str(folder.parent / "compiled")}
    cache |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    command = [sys.executable, "-W", "ignore", "-m", f"taic_jax.{kind}", source, "--run-dir", str(folder)]
    command += ["--checkpoint-seconds", "0", *(POINTS if kind == "sweep" else ())]
    with contextlib.suppress(subprocess.TimeoutExpired):
        done = subprocess.run(command, env=os.environ | cache, capture_output=True, text=True, timeout=seconds)
        if done.returncode:
            raise RuntimeError(done.stderr)


def outcome(folder: Path) -> dict[str, Any]:
    """Return all that a run or a sweep leaves and that must not depend on interruptions, by name."""
    run = RunFolder(folder)
    if not run.finished:
        chunks = {f"{path.name}/{name}": x for path in folder.glob("chunk-*") for name, x in outcome(path).items()}
        return chunks | {name: (folder / name).read_bytes() for name in ("table.csv", "best.yaml", "plan.json")}
    summary = run.summary()
    rows = [{k: v for k, v in row.items() if k != "time"} for row in run.metrics()]
    rows.sort(key=lambda row: row["stage"])  # a resumed run repeats an evaluation, later than it was
    return {"methods": summary["methods"], "ticks": summary["ticks"], "rows": rows, **dict(_arrays(folder))}


def _arrays(folder: Path) -> Iterator[tuple[str, bytes]]:
    for path in folder.rglob("*"):
        if path.suffix == ".npz":
            with np.load(path) as file:
                arrays = dict(file)
        elif (path / "_CHECKPOINT_METADATA").is_file():
            arrays = load_arrays(path)
        else:
            continue
        yield from ((f"{path.relative_to(folder)}/{name}", array.tobytes()) for name, array in arrays.items())


def differences(a: dict[str, Any], b: dict[str, Any]) -> list[str]:
    """Return the names under which two outcomes differ."""
    return sorted(name for name in {**a, **b} if a.get(name) != b.get(name))


def kill_one(folder: Path, kind: str, source: str, seconds: float) -> str:
    """Kill a run or a sweep after so many seconds, finish it, and return the stage of the run it was killed in."""
    execute(folder, kind, source, seconds)
    run = RunFolder(folder)
    rows = run.metrics() if run.metrics_path.is_file() else []
    stage = "end" if run.finished else rows[-1]["stage"] if rows else "start"
    execute(folder, kind, "--resume" if run.begun else source)
    return "sweep" if kind == "sweep" else stage


def kill_all(arguments: Arguments, root: Path) -> Iterator[tuple[str, float, list[str]]]:
    """Yield of each run the stage it was killed in, after how many seconds, and what then differs from a whole run."""
    source = str(root / "config.yaml")
    Path(source).write_text(to_yaml(config(arguments)))
    execute(root / "warm", "run", source)  # fills the cache
    times = [time.perf_counter()]
    for kind in ("run", "sweep"):
        execute(root / kind, kind, source)
        times.append(time.perf_counter())
    expected = {kind: outcome(root / kind) for kind in ("run", "sweep")}
    run, sweep = np.diff(times)
    moments = random.Random(arguments.seed)
    drawn = [moments.uniform(-run, sweep) for _ in range(arguments.kills)]
    kinds = ["sweep" if moment > 0 else "run" for moment in drawn]
    seconds = [moment if moment > 0 else moment + run for moment in drawn]
    folders = [root / str(i) for i in range(arguments.kills)]
    with ThreadPoolExecutor(arguments.jobs) as pool:
        stages = pool.map(kill_one, folders, kinds, [source] * arguments.kills, seconds)
        for stage, kind, moment, folder in zip(stages, kinds, seconds, folders, strict=True):
            yield stage, moment, differences(expected[kind], outcome(folder))
            shutil.rmtree(folder)


def main() -> int:
    """Run the experiment; return 1 if any resumed run differs."""
    arguments, stages, bad = tyro.cli(Arguments), Counter(), 0
    with tempfile.TemporaryDirectory() as name:
        for i, (stage, seconds, names) in enumerate(kill_all(arguments, Path(name)), 1):
            stages[stage] += 1
            bad += bool(names)
            print(f"{i:3}  killed after {seconds:5.1f} s in {stage:8}", "differs:" if names else "identical",
                  *names[:3], flush=True)  # fmt: skip
    counts = ", ".join(f"{count} in {stage}" for stage, count in stages.items())
    print(f"{arguments.kills} runs killed ({counts}): {arguments.kills - bad} resumed runs identical, {bad} not")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(tell(main))
