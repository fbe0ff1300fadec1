"""Measure whether codes steer: the way of an ant under one code, and its turn under another.

python -m taic_jax.experiments.evidence.steering RUN... --out FILE

Takes the options of finished runs, draws codes from the prior, and writes a row per run and measure.
"""

import dataclasses
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import tyro
from jaxtyping import Array, Float, Key

from taic_jax.analysis.option_space import always
from taic_jax.artifacts.models import load_options
from taic_jax.command_line import tell
from taic_jax.config import ConfigError
from taic_jax.envs.ant_tasks import upside_down
from taic_jax.envs.base import Env, State
from taic_jax.envs.wrappers import AutoReset, Wrapper
from taic_jax.experiments.evidence.table import RESULTS, with_interval, write_numbers
from taic_jax.options.execution import Executor, make_executor
from taic_jax.pipeline import make_envs
from taic_jax.rl.rollout import RolloutCarry, rollout, start
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.types import as_arrays

CODES, STARTS = 64, 8
"""Codes of each model, and starts of each code."""
SECONDS = 3.0  # Time under one code.


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure whether the options of runs steer."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of finished runs with options of the ant."""
    out: Path = RESULTS / "steering.csv"  # The table of numbers.


class Unending(Wrapper):
    """A task that continues after a fall, as the arenas do."""

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        return self.env.step(state, action).replace(terminated=jnp.zeros((), bool))


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
    over = jax.vmap(upside_down)(last.env.physics.qpos[:, 3:7])
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


def steering_of(folder: Path) -> tuple[int, dict[str, np.ndarray]]:
    """Return the most ticks of an option of a run, and the measures of every seed's model [K]; raise `ConfigError` if
    its robot cannot go in every direction, and `ArtifactError` if there are no options."""
    config = RunFolder(folder).config()
    _, env = make_envs(config)
    robot: Any = getattr(env, "model", None)
    if robot is None or robot.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        expected = "options of a robot that walks in every direction, as ant"
        raise ConfigError(f"{folder}: expected {expected}, got {env.name}")
    models = load_options(folder, env, config.options, config.seeds)
    run = jax.jit(partial(walk, env))  # one program for all seeds
    rows = []
    for seed in range(config.seeds):
        executor = make_executor(as_arrays(config.options), jax.tree.map(lambda x, k=seed: x[k], models))
        rows.append(measure(jax.device_get(run(executor, jax.random.key(config.seed + seed)))))
    return config.options.length, {name: np.array([row[name] for row in rows]) for name in rows[0]}


def write_measures(arguments: Arguments) -> None:
    """Measure the runs, and write the rows."""
    if not arguments.runs:
        raise ConfigError("expected the folder of at least one run, got none")
    rows = []
    for folder in arguments.runs:
        length, measures = steering_of(folder)
        for name, values in measures.items():
            row = {"run": "/".join(folder.parts[-2:]), "seeds": len(values), "length": length, "measure": name}
            rows.append(row | with_interval(values) | {"per_seed": values})
    write_numbers(rows, arguments.out)


def main(args: Sequence[str] | None = None) -> int:
    """Measure runs, and return the exit code."""
    return tell(lambda: write_measures(tyro.cli(Arguments, args=args)))


if __name__ == "__main__":
    sys.exit(main())
