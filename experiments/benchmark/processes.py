"""Measurements in processes: starts with an empty and a filled cache, seeds over cores, a sweep run by run."""

import contextlib
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path

import jax

from taic_jax import envs
from taic_jax.config import OptionsConfig, PPOConfig
from taic_jax.envs.physics.mujoco import num_physical_cores
from taic_jax.experiments.benchmark.loops import Training, executor_of
from taic_jax.experiments.benchmark.timing import seconds
from taic_jax.options.execution import IdentityExecutor
from taic_jax.rl import learner
from taic_jax.runtime.devices import Devices, open_devices
from taic_jax.runtime.program_cache import keep_programs
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.types import as_arrays, as_rows

PATIENCE = 600.0  # Seconds after which a run that has logged nothing is stopped.
POLL = 0.02
SPAWN = multiprocessing.get_context("spawn")


def starts(task: str) -> dict[str, float]:
    """Return the seconds to the next logged iteration: with an empty cache, with a filled one, and resumed with that;
    raise `RuntimeError` if a run ends or logs nothing."""
    with tempfile.TemporaryDirectory() as folder:
        cold, warm = Path(folder) / "cold-run", Path(folder) / "warm-run"
        runs = {"cold": (cold,), "warm": (warm,), "resumed": (warm, "--resume")}
        return {name: _next_iteration(task, Path(folder), *run) for name, run in runs.items()}


def _next_iteration(task: str, folder: Path, run_dir: Path, *options: str) -> float:
    """Start a run whose cache is in the folder, stop it after the next row of its metrics, and return the seconds."""
    command = [sys.executable, "-m", "taic_jax.run", task, "--run-dir", str(run_dir), *options]
    run = RunFolder(run_dir)
    before, begun = len(run.metrics()), time.perf_counter()
    with subprocess.Popen(
        command, env=cache_in(folder / "cache"), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            while len(run.metrics()) <= before:
                if process.poll() is not None or time.perf_counter() - begun > PATIENCE:
                    raise RuntimeError(f"{' '.join(command)} logged nothing: exit code {process.poll()}")
                time.sleep(POLL)
            return time.perf_counter() - begun
        finally:
            process.terminate()


def cache_in(folder: Path) -> dict[str, str]:
    """Return the environment of a process that keeps its compiled programs in this folder."""
    others = {key: value for key, value in os.environ.items() if not key.startswith("JAX_COMPILATION_CACHE")}
    return others | {"XDG_CACHE_HOME": str(folder)}


class SeedsApart:
    """Training of K seeds in a process of its own, split over its devices as those of a run are: the cores of a CPU.

    A process cannot change its devices, and the loops of one seed need all cores as one device. The other process makes
    the task, and learns the options first; without options, training is flat.
    """

    def __init__(
        self, make_env: Callable[[], envs.Env], config: PPOConfig, seeds: int, options: OptionsConfig | None = None
    ):
        self.ticks, self.duration = seeds * config.num_envs * config.rollout_length, 1.0
        self._pipe, theirs = SPAWN.Pipe()
        arguments = (theirs, make_env, config, seeds, options)
        SPAWN.Process(target=_serve, args=arguments, daemon=True).start()  # a daemon ends with this process
        theirs.close()

    def __call__(self) -> None:
        """Train for one iteration; raise `RuntimeError` if the process has failed."""
        try:
            self._pipe.send(None)
            self.duration = self._pipe.recv()
        except (EOFError, OSError):
            raise RuntimeError("the process that trains several seeds has failed") from None


def _serve(
    pipe: Connection, make_env: Callable[[], envs.Env], config: PPOConfig, seeds: int, options: OptionsConfig | None
) -> None:
    """Train for an iteration at each message from the other end, and reply the ticks of a decision."""
    keep_programs()
    devices, env = Devices(open_devices("auto", seeds)), make_env()
    training = Training(env, executor_of(env, options), config, seeds, devices)
    with contextlib.suppress(EOFError):
        while True:
            pipe.recv()
            training()
            pipe.send(training.duration)


@dataclass(frozen=True)
class Sweep:
    """A grid of step sizes, each with seeds, of flat training on one task: `points` x `seeds` runs of `ticks` ticks."""

    task: str
    points: int
    seeds: int
    ticks: int
    config: PPOConfig

    def configs(self) -> list[PPOConfig]:
        """Return the configs of the points, equally far apart in the logarithm of the step size."""
        return [replace(self.config, learning_rate=1e-4 * 100 ** (i / self.points)) for i in range(self.points)]

    def rows(self) -> tuple[PPOConfig, jax.Array]:
        """Return the config and the key of every run, as arrays [points x seeds]."""
        return as_rows(self.configs(), self.seeds), jax.random.split(jax.random.key(0), self.points * self.seeds)

    def train(self) -> Callable[[PPOConfig, jax.Array], jax.Array]:
        """Return the function that does one run and returns its curve."""
        env = envs.make_env(self.task)
        executor = IdentityExecutor(env.action_size)
        return lambda config, key: learner.train(config, env, executor, key, self.ticks)[1]["return"]


def sweep_costs(sweep: Sweep, runs: int) -> dict[str, int | float]:
    """Return the seconds of a sweep in one program, in a loop over a compiled run, and in separate processes.

    The program, its rows split over devices as in a sweep, is measured whole; of the others `runs` runs each,
    extrapolated to all. A process per core runs at a time, with a filled cache. Compilation, once in the first two, is
    measured apart.
    """
    costs: dict[str, int | float] = {"runs": (total := sweep.points * sweep.seeds), "runs_measured": runs}
    with ProcessPoolExecutor(1, SPAWN) as pool:  # with devices of its own
        costs["compile_one_program"], costs["one_program"] = pool.submit(_one_program, sweep).result()
    rows, keys = sweep.rows()
    each = [(jax.tree.map(lambda x, i=i: x[i], rows), keys[i]) for i in range(runs)]
    begun = time.perf_counter()
    program = Devices().compile(sweep.train(), *each[0])
    costs["compile_loop"] = time.perf_counter() - begun
    costs["loop"] = seconds(lambda: [jax.block_until_ready(program(*run)) for run in each]) * total / runs
    _processes(sweep, 1)  # fills the cache
    cores = num_physical_cores()
    rounds = max(1, runs // cores)
    costs["processes"] = seconds(lambda: [_processes(sweep, cores) for _ in range(rounds)]) * total / (rounds * cores)
    return costs


def _one_program(sweep: Sweep) -> tuple[float, float]:
    """Run a sweep as one program, its rows split over devices; return the seconds of compilation and of the rest."""
    devices = Devices(open_devices("auto", sweep.points * sweep.seeds))
    begun, arguments = time.perf_counter(), devices.place(sweep.rows())
    program = devices.compile(lambda arguments: jax.vmap(sweep.train())(*arguments), arguments)
    return time.perf_counter() - begun, seconds(lambda: jax.block_until_ready(program(arguments)))


def _processes(sweep: Sweep, count: int) -> None:
    """Run the first points of a sweep in `count` new processes at once."""
    with ProcessPoolExecutor(count, SPAWN) as pool:
        list(pool.map(partial(_run_alone, sweep), range(count)))


def _run_alone(sweep: Sweep, point: int) -> None:
    """Run one seed of one point of a sweep in this process."""
    keep_programs()
    run = as_arrays(sweep.configs()[point]), jax.random.key(point)
    jax.block_until_ready(Devices().compile(sweep.train(), *run)(*run))
