"""Measure whether codes steer: the way of an ant under one code, and its turn under another.

python -m taic_jax.experiments.evidence.steering RUN... --out FILE [--navigate [--picture FILE.png]]

Takes the options of finished runs, draws codes from the prior, and writes a row per run and measure. With `--navigate`
it measures instead how far a navigator gets over the options, see `navigate`; a picture shows the first model's ways.
"""

import dataclasses
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Array, Float, Key

from taic_jax.analysis.option_space import always
from taic_jax.artifacts.models import load_options
from taic_jax.command_line import tell
from taic_jax.config import Config, ConfigError
from taic_jax.envs import make_env
from taic_jax.envs.base import Env
from taic_jax.envs.wrappers import AutoReset
from taic_jax.experiments.evidence.navigate import (
    Unending,
    measure_codes,
    measures_of,
    measures_of_codes,
    navigate,
    straight,
)
from taic_jax.experiments.evidence.table import RESULTS, with_interval, write_numbers
from taic_jax.experiments.evidence.ways import draw_navigation
from taic_jax.options.execution import Executor, OptionExecutor, make_executor
from taic_jax.pipeline import make_envs
from taic_jax.rl.rollout import RolloutCarry, rollout, start
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.types import as_arrays

CODES, STARTS = 64, 8
"""Codes of each model, and starts of each code."""
SECONDS = 3.0  # Time under one code.
ARENAS = ("ant_maze", "ant_push", "ant_fall")


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure whether the options of runs steer."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of finished runs with options of the ant."""
    out: Path = RESULTS / "steering.csv"  # The table of numbers.
    navigate: bool = False  # Lead ants through the arenas.
    picture: Path | None = None  # Of the navigated ways.


def follow(
    env: Env, executor: Executor, begin: RolloutCarry, codes: Float[Array, "N D"], key: Key[Array, ""]
) -> tuple[RolloutCarry, Float[Array, "N 2"]]:
    """Choose one code in each environment, again whenever its option ends; return the end and the way to it in m."""
    begin = begin.replace(ended=jnp.ones_like(begin.ended))
    after, _ = rollout(env, executor, partial(always, codes), begin, key, round(SECONDS / env.dt))
    return after, after.env.physics.qpos[:, :2] - begin.env.physics.qpos[:, :2]


def walk(env: Env, executor: Executor, key: Key[Array, ""]) -> dict[str, Array]:
    """Return the ways in m, [CODES, STARTS, 2], `before` a change of code, and after it under the `same` or a `changed`
    code; `over` [CODES, STARTS] marks the ants on their backs after the change."""
    key_codes, key_start, key_before, key_after = jax.random.split(key, 4)
    env = AutoReset(Unending(env))
    codes, others = jnp.repeat(jax.random.normal(key_codes, (2, CODES, executor.option_size)), STARTS, axis=1)
    after, before = follow(env, executor, start(env, executor, len(codes), key_start), codes, key_before)
    _, same = follow(env, executor, after, codes, key_after)
    last, changed = follow(env, executor, after, others, key_after)
    over = last.env.metrics["upside_down"] > 0.5
    ways = {"before": before, "same": same, "changed": changed, "over": over}
    return jax.tree.map(lambda x: x.reshape(CODES, STARTS, *x.shape[1:]), ways)


def angle(a: Float[np.ndarray, "*batch 2"], b: Float[np.ndarray, "*#batch 2"]) -> np.ndarray:
    """Return the angle between two ways, in [0, 180] degrees."""
    cross, dot = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], (a * b).sum(axis=-1)
    return np.degrees(np.abs(np.arctan2(cross, dot)))


def measure(ways: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the measures of one model's ways.

    `distance` in m; the share `ahead`, within 45 degrees of the ant's first heading; the shares that turn by more than
    45 degrees under a changed or the same code; the `agreement` of one code's ways from several starts, the length of
    the mean of their unit vectors; and the share that ends `upside_down`.
    """
    before = ways["before"]
    distance = np.linalg.norm(before, axis=-1, keepdims=True)
    measures = {
        "distance": distance.mean(),
        "ahead": (angle(before, np.array([1.0, 0.0])) < 45).mean(),
        "turned_when_changed": (angle(ways["changed"], before) > 45).mean(),
        "turned_when_kept": (angle(ways["same"], before) > 45).mean(),
        "agreement": np.linalg.norm((before / np.maximum(distance, 1e-9)).mean(axis=1), axis=-1).mean(),
        "upside_down": ways["over"].mean(),
    }
    return {name: float(value) for name, value in measures.items()}


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


def steering_of(folder: Path) -> tuple[int, dict[str, np.ndarray]]:
    """Return the most ticks of an option of a run, and the measures of every seed's model [K]."""
    config, env, executors = executors_of(folder)
    run = jax.jit(partial(walk, env))  # one program for all seeds
    keys = (jax.random.key(config.seed + seed) for seed in range(config.seeds))
    rows = [measure(jax.device_get(run(executor, key))) for executor, key in zip(executors, keys, strict=True)]
    return config.options.length, _by_name(rows)


def navigation_of(folder: Path, picture: Path | None) -> tuple[int, dict[str, np.ndarray]]:
    """Return the most ticks of an option of a run, and of every seed [K] the measures of codes, `codes/NAME`, and of
    the ants that a navigator leads by them, `ARENA/NAME`; draw the first seed."""
    config, _, executors = executors_of(folder)
    body = config.env.body
    ground = make_env("ant", config.env.backend, body=body, contacts="body")
    arenas: dict[str, Any] = {name: make_env(name, config.env.backend, body=body) for name in ARENAS}
    rows = []
    for seed, executor in enumerate(executors):
        key_codes, key_run = jax.random.split(jax.random.key(config.seed + seed))
        frame = None if executor.by_way else executor.model.networks.frame  # ways are in the world's axes
        compass = jax.device_get(measure_codes(ground, executor, frame, key_codes))
        ticks = {name: jax.device_get(navigate(env, executor, compass, frame, key_run)) for name, env in arenas.items()}
        measures = {"codes": measures_of_codes(compass)} | {
            name: measures_of(run, arenas[name].dt) for name, run in ticks.items()
        }
        rows.append({f"{name}/{key}": x for name, values in measures.items() for key, x in values.items()})
        if picture and seed == 0:
            ways = {n: (arenas[n].arena, run.extras[1], measures[n]["success"]) for n, run in ticks.items()}
            draw_navigation(compass, ways, picture)
    return config.options.length, _by_name(rows)


def reference_levels() -> dict[str, dict[str, float]]:
    """Return the distance in m from each arena's goal of whoever stands, or goes straight to it at 1 m/s."""
    levels = {}
    for name in ARENAS:
        env: Any = make_env(name, "mujoco")
        seconds = env.dt * env.episode_length
        levels[name] = {"stand": straight(env.arena, 0.0, seconds), "go straight": straight(env.arena, 1.0, seconds)}
    return levels


def _by_name(rows: Sequence[dict[str, float]]) -> dict[str, np.ndarray]:
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def write_measures(arguments: Arguments) -> None:
    """Measure the runs, and write the rows."""
    if not arguments.runs:
        raise ConfigError("expected the folder of at least one run, got none")
    rows = []
    for folder in arguments.runs:
        length, measures = navigation_of(folder, arguments.picture) if arguments.navigate else steering_of(folder)
        for name, values in measures.items():
            row = {"run": "/".join(folder.parts[-2:]), "seeds": len(values), "length": length, "measure": name}
            rows.append(row | with_interval(values) | {"per_seed": values})
    for name, levels in reference_levels().items() if arguments.navigate else ():
        rows += [{"run": level, "measure": f"{name}/final_distance", "iqm": x} for level, x in levels.items()]
    write_numbers(rows, arguments.out, ("run", "seeds", "length", "measure", "iqm", "low", "high", "per_seed"))


def main(args: Sequence[str] | None = None) -> int:
    """Measure runs, and return the exit code."""
    return tell(lambda: write_measures(tyro.cli(Arguments, args=args)))


if __name__ == "__main__":
    sys.exit(main())
