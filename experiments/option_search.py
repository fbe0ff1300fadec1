"""Search option settings with one vmapped program: every point of a grid of leaf fields, for every seed at once.

python -m taic_jax.experiments.option_search half_cheetah --experience RUN --options.decoder closed \
    --grid options.lambda_kl=0.003,0.01 train.ppo.learning_rate=3e-4,1e-3

Learns options from a run's experience at each point, trains over them for --train.ticks, and appends a row per point.
"""

import csv
import dataclasses
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from taic_jax.analysis import option_space
from taic_jax.analysis.evaluate import evaluate
from taic_jax.artifacts.experience import gather_experience
from taic_jax.command_line import tell
from taic_jax.config import Config, ConfigError, walk
from taic_jax.config_io import load_config, validate
from taic_jax.envs.base import Env
from taic_jax.options.dataset import Experience
from taic_jax.options.execution import make_executor
from taic_jax.options.learning import learn
from taic_jax.options.model import OptionModel
from taic_jax.pipeline import make_envs
from taic_jax.rl import ppo
from taic_jax.summary import commit
from taic_jax.sweep.axes import configs_of, grid, is_leaf, parse_axis, replace
from taic_jax.types import as_arrays

FIELDS = (
    "task", "point", "seeds", "ticks", "untrained", "return", "mean_option", "duration", "kl_loss",
    "reconstruction_loss", "prediction_loss", "distance_correlation", "seconds", "commit",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Try every point of a grid of option settings."""

    preset: tyro.conf.Positional[str]
    """Preset or file to start from."""
    experience: Path
    """Run whose experience options are learnt from."""
    grid: tuple[str, ...] = ()
    """Leaf fields with their values, as in options.lambda_kl=0.003,0.01; every combination is tried."""
    out: Path = Path("experiments/results/option_search.csv")
    """The table."""
    config: Annotated[Config, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff] = Config()


def score(env: Env, config: Config, experience: Experience, key: jax.Array) -> tuple[OptionModel, dict[str, jax.Array]]:
    """Learn options, train over them, and return them and what came out, of one point and seed."""
    key_learn, key_train, key_evaluate = jax.random.split(key, 3)
    model, losses = learn(config.options, experience, key_learn, env.views)
    executor = make_executor(config.options, model)
    first = ppo.as_agent(config.train.ppo, executor, ppo.init(config.train.ppo, env, executor, key_train))
    agent, metrics = ppo.train(config.train.ppo, env, executor, key_train, config.train.ticks)
    told = partial(evaluate, env, key=key_evaluate, episodes=config.evaluate.episodes)
    return model, {
        "untrained": told(first)["return"],
        "return": told(agent)["return"],
        "mean_option": told(agent, exploration=0.0)["return"],
        "duration": metrics["duration"][-1],
        **{name: jnp.mean(losses[name][-50:]) for name in ("kl_loss", "reconstruction_loss", "prediction_loss")},
    }


def search(arguments: Arguments, config: Config) -> list[dict[str, Any]]:
    """Return a row per point of the grid.

    Raises:
      ConfigError: a point of the grid is no valid configuration.
    """
    started = time.time()
    env, _ = make_envs(config)
    points = grid([parse_axis(text) for text in arguments.grid])
    for name in points[0]:
        if not is_leaf(name):
            raise ConfigError(f"--grid: expected fields that one program can vary, got {name}")
    configs_of(config, points)
    swept, axes = as_arrays(config), jax.tree.map(lambda _: None, as_arrays(config))
    for name in points[0]:
        swept = replace(swept, name, jnp.array([point[name] for point in points], jnp.float32))
        axes = replace(axes, name, 0)
    experience = jax.tree.map(jnp.asarray, gather_experience(arguments.experience, env, config.seeds))
    keys = jnp.stack([jax.random.key(config.seed + k) for k in range(config.seeds)])
    over_seeds = jax.vmap(partial(score, env), in_axes=(None, 0, 0))
    over_points = jax.vmap(over_seeds, in_axes=(axes, None, None)) if points[0] else over_seeds
    models, scores = jax.device_get(jax.jit(over_points)(swept, experience, keys))
    seconds = round(time.time() - started)
    rows = []
    for i, point in enumerate(points):
        settings = {**_changes(arguments), **point}
        row = {
            "task": config.env.name, "point": " ".join(f"{k}={v}" for k, v in settings.items()),
            "seeds": config.seeds, "ticks": config.train.ticks, "seconds": seconds, "commit": commit(),
        }  # fmt: skip
        told, learnt = jax.tree.map(lambda x, i=i: x[i], (scores, models)) if points[0] else (scores, models)
        told["distance_correlation"] = [
            option_space.order(env, config.options, jax.tree.map(lambda x, k=k: x[k], learnt), key)
            for k, key in enumerate(keys)
        ]
        for name, values in told.items():
            row[name] = " ".join(f"{x:.4g}" for x in values)
        rows.append(row)
    return rows


def _changes(arguments: Arguments) -> dict[str, Any]:
    """Return what the command line changes in the preset's options and policy."""
    preset = dict(walk(load_config(arguments.preset)))
    relevant = ("options.", "train.ppo.")
    return {k: v for k, v in walk(arguments.config) if k.startswith(relevant) and preset[k] != v}


def main(args: Sequence[str] | None = None) -> None:
    """Search, append the rows to the table and print them."""
    args = list(sys.argv[1:] if args is None else args)
    default = Arguments(args[0], Path(), config=load_config(args[0]))
    arguments = tyro.cli(Arguments, args=args, default=default)
    validate(arguments.config)
    rows = search(arguments, arguments.config)
    new = not arguments.out.exists()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    with arguments.out.open("a", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        if new:
            writer.writeheader()
        writer.writerows(rows)
    for row in rows:
        numbers = {name: np.mean(np.array(row[name].split(), float)) for name in FIELDS[4:12]}
        print(row["point"], "|", ", ".join(f"{name} {value:.4g}" for name, value in numbers.items()))


if __name__ == "__main__":
    sys.exit(tell(main))
