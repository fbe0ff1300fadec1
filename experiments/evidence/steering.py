"""Measure how far a navigator without learning gets over the options of runs: the gate before long runs.

python -m taic_jax.experiments.evidence.steering RUN... --out FILE [--picture FILE.png]

Writes a row per run and measure, see `navigate`; a picture shows the codes and ways of the first model.
"""

import dataclasses
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from jaxtyping import Array

from taic_jax.analysis.measures import distance_correlation
from taic_jax.analysis.option_space import prior_effects
from taic_jax.artifacts.models import load_options
from taic_jax.command_line import tell
from taic_jax.config import Config, ConfigError
from taic_jax.envs import make_env
from taic_jax.envs.base import Env
from taic_jax.envs.menagerie import MENAGERIE_PREFIX
from taic_jax.experiments.evidence.navigate import (
    measure_codes,
    measures_of,
    measures_of_codes,
    navigate,
    straight,
)
from taic_jax.experiments.evidence.plan import ARENAS
from taic_jax.experiments.evidence.table import with_interval, write_numbers
from taic_jax.experiments.evidence.ways import draw_navigation
from taic_jax.options.execution import OptionExecutor, make_executor
from taic_jax.pipeline import make_envs
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.types import as_arrays


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Lead robots through the arenas by the options of runs."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of finished runs with options of the ant, or of a robot of MuJoCo Menagerie."""
    out: Path = Path("ways.csv")  # The table of numbers.
    picture: Path | None = None  # Of the navigated ways.


def executors_of(folder: Path) -> tuple[Config, Env, list[OptionExecutor]]:
    """Return the config of a run, its source, and the executor of every seed's options; raise `ConfigError` if its
    robot cannot go in every direction, and `ArtifactError` if there are no options."""
    config = RunFolder(folder).config()
    _, env = make_envs(config)
    if env.heading is None:
        expected = "options of a robot that walks in every direction, as ant"
        raise ConfigError(f"{folder}: expected {expected}, got {env.name}")
    models = load_options(folder, env, config.options, config.seeds)
    rows = (jax.tree.map(lambda x, k=seed: x[k], models) for seed in range(config.seeds))
    return config, env, [make_executor(as_arrays(config.options), model) for model in rows]


def ground_and_arenas(config: Config, env: Env) -> tuple[Env, dict[str, Any]]:
    """Return the open ground of the run's robot, and the arenas there are for it, by name."""
    backend, body, robot = config.env.backend, config.env.body, env.proprioception
    if robot.startswith(MENAGERIE_PREFIX):
        return make_env(robot, backend), {f"{robot}_maze": make_env(f"{robot}_maze", backend)}
    arenas = {name: make_env(name, backend, body=body) for name in ARENAS}
    return make_env("ant", backend, body=body, contacts="body"), arenas


def navigation_of(folder: Path, picture: Path | None = None) -> dict[str, np.ndarray]:
    """Return of every seed [K] of a run the measures of codes, `codes/NAME`, and of the robots that a navigator leads
    by them, `ARENA/NAME`; draw the first seed."""
    config, source, executors = executors_of(folder)
    ground, arenas = ground_and_arenas(config, source)
    rows = []
    for seed, executor in enumerate(executors):
        key_codes, key_run, key_order = jax.random.split(jax.random.key(config.seed + seed), 3)
        frame = None if executor.by_way else executor.model.networks.frame  # ways are in the world's axes
        compass = jax.device_get(measure_codes(ground, executor, frame, key_codes))
        leading = None if executor.by_way else compass
        ticks = {name: jax.device_get(navigate(env, executor, leading, frame, key_run)) for name, env in arenas.items()}
        measures = {"codes": measures_of_codes(compass) | orders(ground, config, executor, key_order)} | {
            name: measures_of(run, arenas[name].dt) for name, run in ticks.items()
        }
        rows.append({f"{name}/{key}": x for name, values in measures.items() for key, x in values.items()})
        if picture and seed == 0:
            ways = {n: (arenas[n].arena, run.extras[1], measures[n]["success"]) for n, run in ticks.items()}
            draw_navigation(compass, ways, picture)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def orders(ground: Env, config: Config, executor: OptionExecutor, key: Array) -> dict[str, float]:
    """Return the distance correlation of codes from the prior and the ways they lead, from one start and from many."""
    args = ground, dataclasses.replace(config.options, choose="code"), executor.model, key
    effects = {name: prior_effects(*args, many=many) for name, many in (("one", False), ("many", True))}
    return {f"order_{name}": distance_correlation(x.option, x.way) for name, x in effects.items()}


def reference_levels(names: Iterable[str]) -> list[dict[str, Any]]:
    """Return a row each for the distance in m from an arena's goal of whoever stands, or goes to it at 1 m/s."""
    rows = []
    for name in names:
        env: Any = make_env(name, "mujoco")
        for level, speed in (("stand", 0.0), ("go straight", 1.0)):
            distance = straight(env.arena, speed, env.dt * env.episode_length)
            rows.append({"run": level, "measure": f"{name}/final_distance", "iqm": distance})
    return rows


def write_measures(arguments: Arguments) -> None:
    """Measure the runs, and write the rows."""
    if not arguments.runs:
        raise ConfigError("expected the folder of at least one run, got none")
    rows: list[dict[str, Any]] = []
    for folder in arguments.runs:
        for name, values in navigation_of(folder, arguments.picture).items():
            row = {"run": "/".join(folder.parts[-2:]), "seeds": len(values), "measure": name}
            rows.append(row | with_interval(values) | {"per_seed": values})
    arenas = dict.fromkeys(row["measure"].rpartition("/")[0] for row in rows)  # a set in their order
    rows += reference_levels(name for name in arenas if name != "codes")
    write_numbers(rows, arguments.out, ("run", "seeds", "measure", "iqm", "low", "high", "per_seed"))


def main(args: Sequence[str] | None = None) -> int:
    """Measure runs, and return the exit code."""
    return tell(lambda: write_measures(tyro.cli(Arguments, args=args)))


if __name__ == "__main__":
    sys.exit(main())
