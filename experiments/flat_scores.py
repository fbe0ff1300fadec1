"""Score flat PPO on Gymnasium's own robots beside what others published.

python -m taic_jax.experiments.flat_scores

Each finished task is a row of the table; what is in the table is not run again, and a run that was interrupted
goes on from its last checkpoint.
"""

import csv
import dataclasses
import sys
from pathlib import Path

import numpy as np
import tyro

from taic_jax.analysis.statistics import bootstrap_interval, iqm
from taic_jax.command_line import tell
from taic_jax.config import CollectConfig, Config, EnvConfig, EvaluateConfig, PPOConfig, TrainConfig
from taic_jax.pipeline import train_baseline
from taic_jax.runtime.driver import Run
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.summary import commit
from taic_jax.tasks import make_envs

# Mean return at one million interactions: CleanRL's benchmark (version 4; the ant's is the PPO of the TD3 paper,
# version 1), and Tianshou's (version 3, the best evaluation of each run).
PUBLISHED = {
    "half_cheetah": (1442.6, 5783.9),
    "hopper": (2382.9, 2609.3),
    "walker2d": (2288.0, 3588.5),
    "ant": (1083.2, 3258.4),
}

# Chosen by trying on other seeds than those reported. The walkers' ticks are a sixth as long, and their episodes
# short at first: fewer environments, and updates more often; for Walker2d on more noise.
_WALKING = PPOConfig(num_envs=8, rollout_length=256, minibatch_size=64, log_std_init=0.0)
PPO = {
    "half_cheetah": PPOConfig(learning_rate=6e-4),
    "hopper": dataclasses.replace(_WALKING, log_std_init=-0.7),
    "walker2d": _WALKING,
    "ant": PPOConfig(rollout_length=256, learning_rate=6e-4),
}

FIELDS = (
    "task", "ticks", "seeds", "mean", "iqm", "low", "high", "mean_action", "cleanrl", "tianshou", "seconds",
    "commit", "per_seed",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Train flat PPO with Gymnasium's models and rules, and print the table."""

    tasks: tuple[str, ...] = tuple(PUBLISHED)
    """Tasks to score."""
    seeds: int = 5
    """Independent repeats."""
    seed: int = 100
    """The first of them."""
    ticks: int = 1_000_000
    """Interactions per seed."""
    episodes: int = 20
    """Evaluation episodes per seed."""
    out: Path = Path("experiments/results/flat_scores.csv")
    """The table."""
    run_dir: Path = Path("runs/flat_scores")
    """Folder of the runs."""


def score(arguments: Arguments, task: str) -> dict[str, str]:
    """Train and evaluate one task and return its row."""
    config = Config(
        env=EnvConfig(name=task, model="gym"),
        collect=CollectConfig(ticks=arguments.ticks, ppo=PPO[task]),
        train=TrainConfig(ticks=arguments.ticks),
        evaluate=EvaluateConfig(episodes=arguments.episodes),
        seed=arguments.seed,
        seeds=arguments.seeds,
    )
    folder = arguments.run_dir / task
    with Run.open(config, folder, resume=RunFolder(folder).begun) as run:
        last = train_baseline(run, make_envs(config)[0], "flat").last
    returns = np.asarray(last["return"]["return"], float)
    low, high = bootstrap_interval(returns)
    cleanrl, tianshou = PUBLISHED[task]
    values = (
        task, arguments.ticks, arguments.seeds, returns.mean(), iqm(returns), low, high,
        float(np.mean(last["return_mean_option"]["return"])), cleanrl, tianshou, run.clock.run,
    )  # fmt: skip
    numbers = [f"{value:.0f}" if isinstance(value, float) else str(value) for value in values]
    return dict(zip(FIELDS, [*numbers, str(commit()), " ".join(f"{x:.0f}" for x in returns)], strict=True))


def read_table(path: Path) -> list[dict[str, str]]:
    """Return the rows finished so far."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def main() -> None:
    """Score what is missing, a row at a time, and print the table."""
    arguments = tyro.cli(Arguments)
    for task in arguments.tasks:
        rows = read_table(arguments.out)
        wanted = (task, str(arguments.ticks), str(arguments.seeds))
        if wanted in [(row["task"], row["ticks"], row["seeds"]) for row in rows]:
            continue
        rows.append(score(arguments, task))
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        with arguments.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, FIELDS)
            writer.writeheader()
            writer.writerows(rows)
    for row in read_table(arguments.out):
        print("{task:13} mean {mean:>5}  IQM {iqm:>5} ({low}…{high})  mean actions {mean_action:>5}  "
              "CleanRL {cleanrl}  Tianshou {tianshou}".format(**row))  # fmt: skip


if __name__ == "__main__":
    sys.exit(tell(main))
