"""Measure how flat policies of the ant walk: their speed, and how often they fall.

python -m taic_jax.experiments.evidence.walking RUN... --out FILE [--method collect]

Each seed's policy walks with the noise of its training and without, in episodes that no fall ends, as in the arenas.
`unhealthy_per_1000` counts how often in 1000 ticks the ant leaves its healthy state, by which its task ends, as by a
hop above 1 m; `overturned_per_1000` how often it turns onto its back.
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
from jaxtyping import Array, Key

from taic_jax.artifacts.agents import load_agents
from taic_jax.artifacts.models import AGENTS
from taic_jax.command_line import tell
from taic_jax.config import COLLECT, ConfigError
from taic_jax.envs.base import Env
from taic_jax.envs.wrappers import AutoReset
from taic_jax.experiments.evidence.navigate import Unending, onsets_per_1000
from taic_jax.experiments.evidence.table import RESULTS, with_interval, write_numbers
from taic_jax.rl.agent import Agent
from taic_jax.rl.rollout import rollout, start
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.sources import make_envs

EPISODES = 64


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure how flat policies walk."""

    runs: tyro.conf.Positional[tuple[Path, ...]]
    """Folders of runs that collected experience of the ant."""
    method: str = COLLECT  # Agents of the run.
    out: Path = RESULTS / "walking.csv"  # The table of numbers.


@partial(jax.jit, static_argnums=0)
def walk(env: Env, agent: Agent, key: Key[Array, ""]) -> dict[str, Array]:
    """Return the metrics [2, T, B] of episodes with noise and without, and the places [2, T, B, 2]."""
    env = AutoReset(Unending(env))

    def one(exploration: Array) -> dict[str, Array]:
        key_start, key_run = jax.random.split(key)
        begin = start(env, agent.executor, EPISODES, key_start)
        keep = lambda state: state.metrics | {"place": state.physics.qpos[..., :2]}  # noqa: E731
        decide = agent.decide(exploration)
        return rollout(env, agent.executor, decide, begin, key_run, env.episode_length - 1, keep)[1].extras

    return jax.vmap(one)(jnp.array([1.0, 0.0]))


def measures_of(ticks: dict[str, np.ndarray], dt: float) -> dict[str, float]:
    """Return the speed along x in m/s of ants that are not on their backs, and how often they fall."""
    over = ticks["upside_down"] > 0.5
    speed = np.diff(ticks["place"][..., 0], axis=0) / dt
    falls = {f"{name}_per_1000": onsets_per_1000(ticks[key] > 0.5) for name, key in FALLS.items()}
    return {"speed": float(speed[~over[1:]].mean()), **falls}


FALLS = {"unhealthy": "unhealthy", "overturned": "upside_down"}


def write_measures(arguments: Arguments) -> None:
    """Measure the runs, and write the rows."""
    rows = []
    for folder in arguments.runs:
        config = RunFolder(folder).config()
        env: Any = make_envs(config)[1]
        if env.heading is None:
            raise ConfigError(f"{folder}: expected a robot that can fall on its back, as ant, got {env.name}")
        agents = load_agents(folder / AGENTS / arguments.method)
        keys = [jax.random.key(config.seed + seed) for seed in range(config.seeds)]
        walks = [
            jax.device_get(walk(env, jax.tree.map(lambda x, k=k: x[k], agents), key)) for k, key in enumerate(keys)
        ]
        for i, mode in enumerate(("as it explores", "mean actions")):
            seeds = [measures_of({name: x[i] for name, x in ticks.items()}, env.dt) for ticks in walks]
            for name in seeds[0]:
                values = np.array([seed[name] for seed in seeds])
                row = {"run": folder.name, "seeds": len(values), "mode": mode, "measure": name}
                rows.append(row | with_interval(values) | {"per_seed": values})
    write_numbers(rows, arguments.out)


def main(args: Sequence[str] | None = None) -> int:
    """Measure runs, and return the exit code."""
    return tell(lambda: write_measures(tyro.cli(Arguments, args=args)))


if __name__ == "__main__":
    sys.exit(main())
