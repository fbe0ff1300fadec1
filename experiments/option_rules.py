"""Compare termination rules, decoders and constraints: one row per task and kind of options, beside flat PPO.

python -m taic_jax.experiments.option_rules --tasks half_cheetah

Each finished cell is a row of the table; what is in the table is not run again, and what was interrupted goes on from
its last checkpoint. All options of a task are learnt from the experience of the same collector.
"""

import csv
import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from taic_jax import option_space
from taic_jax.artifacts import load_options
from taic_jax.compilation import keep_programs
from taic_jax.config import CollectConfig, Config, EvaluateConfig, OptionsConfig
from taic_jax.config_io import load_config
from taic_jax.experience import read_experience
from taic_jax.logging import RunLogger
from taic_jax.pipeline import collect, make_envs, run_pipeline
from taic_jax.run_folder import prepare_folder
from taic_jax.stage import CLOCK, Clock, Run
from taic_jax.statistics import bootstrap_interval, iqm, probability_of_improvement
from taic_jax.summary import commit
from taic_jax.types import as_rows

RULES, DECODERS = ("fixed", "output", "predict"), ("open", "closed")
FLAT = ("strong", "weak")

# Found by `experiments.option_search`, whose log is results/option_search.csv.
VARIABLE = {"length": 10}
# In closed loop D follows whatever gait it saw, so the best windows of the whole run serve; in open loop they do not.
SETTINGS: dict[str, dict[str, float]] = {
    "open": {"since": 0.2, "until": 0.5, "lambda_kl": 0.01, "lambda_pred": 1.0, "lambda_adv": 0.1},
    "closed": {"since": 0.0, "until": 1.0, "lambda_kl": 0.001, "lambda_pred": 0.3, "lambda_adv": 0.03},
}
CONSTRAINTS: dict[str, dict[str, float]] = {
    "both": {},
    "none": {"lambda_pred": 0.0, "lambda_adv": 0.0},
    "pred": {"lambda_adv": 0.0},
    "adv": {"lambda_pred": 0.0},
}
MEASURES = (
    "kl", "active_dimensions", "prior/one/distance_correlation", "prior/many/distance_correlation",
    "prior/one/trustworthiness", "window/distance_correlation", "window/mlp_r2/change", "window/mlp_r2/start",
    "window/mlp_r2/end", "window/mutual_information/change", "window/mutual_information/permuted",
)  # fmt: skip
LISTS = ("first", "return", "mean_option", "duration", *MEASURES)
FIELDS = ("task", "kind", "decoder", "constraints", "seeds", "ticks", "pretraining", "seconds", "commit", *LISTS)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Train over options of every kind, and print the table."""

    tasks: tuple[str, ...] = ("half_cheetah",)
    """Tasks; each has a preset of its name."""
    rules: tuple[str, ...] = RULES
    """Termination rules."""
    decoders: tuple[str, ...] = DECODERS
    """Decoders."""
    constraints: tuple[str, ...] = ("both", "none")
    """Both constraints, none (RVAE only), or one of pred and adv."""
    seeds: int = 10
    """Independent repeats."""
    seed: int = 200
    """The first of them."""
    ticks: int = 1_000_000
    """Interactions per seed over options; as many were collected before."""
    options: int = 500
    """Options of each kind in the measures of the option space."""
    out: Path = Path("experiments/results/option_rules.csv")
    """The table."""
    run_dir: Path = Path("runs/option_rules")
    """Folder of the runs."""


def collector(arguments: Arguments, task: str, strength: str) -> Config:
    """Return the config of flat PPO: the task's preset, or weak, as the paper's silence on it suggests."""
    config = load_config(task)
    ppo = config.collect.ppo if strength == "strong" else load_config("paper").collect.ppo
    return dataclasses.replace(
        config,
        collect=CollectConfig(ticks=arguments.ticks, capacity=arguments.ticks, ppo=ppo),
        options=OptionsConfig(),  # what differs is told below; no preset may change it
        train=dataclasses.replace(config.train, ticks=arguments.ticks, baselines=()),
        evaluate=EvaluateConfig(episodes=20, video_ticks=0),
        seed=arguments.seed,
        seeds=arguments.seeds,
    )


def cell(arguments: Arguments, task: str, rule: str, decoder: str, constraints: str) -> Config:
    """Return the config of one kind of options, learnt from the strong collector."""
    config = collector(arguments, task, "strong")
    changes: dict[str, Any] = {"termination": rule, "decoder": decoder} | SETTINGS[decoder] | CONSTRAINTS[constraints]
    changes |= {} if rule == "fixed" else VARIABLE
    source = (str(arguments.run_dir / task / "strong"),)
    return dataclasses.replace(config, options=dataclasses.replace(config.options, experience=source, **changes))


def run_flat(arguments: Arguments, task: str, strength: str) -> dict[str, Any]:
    """Train flat PPO and return its row."""
    config, folder = collector(arguments, task, strength), arguments.run_dir / task / strength
    prepare_folder(config, folder, resume=(folder / "config.yaml").is_file())
    keys = jnp.stack([jax.random.key(config.seed + k) for k in range(config.seeds)])
    with RunLogger(folder) as logger:
        run = Run(as_rows([config], config.seeds), keys, folder, logger, Clock.load(folder / CLOCK))
        trained = collect(run, make_envs(config)[1])
    lists = {
        "first": trained.first["return"]["return"],
        "return": trained.last["return"]["return"],
        "mean_option": trained.last["return_mean_option"]["return"],
        "duration": np.ones(config.seeds),
    }
    return {"kind": strength, "pretraining": 0, "seconds": run.clock.run} | lists


def run_cell(arguments: Arguments, task: str, rule: str, decoder: str, constraints: str) -> dict[str, Any]:
    """Learn options, train over them, measure their space, and return the row."""
    config = cell(arguments, task, rule, decoder, constraints)
    folder = arguments.run_dir / task / f"{rule}-{decoder}-{constraints}"
    summary = folder / "summary.json"
    if not summary.is_file():
        run_pipeline(config, folder, resume=(folder / "config.yaml").is_file())
    told = json.loads(summary.read_text())
    taic = told["methods"]["taic"]
    env = make_envs(config)[0]
    models = load_options(folder, env, config.options, config.seeds)
    measured = []
    for seed in range(config.seeds):
        experience = jax.tree.map(jnp.asarray, read_experience(Path(config.options.experience[0]) / "experience", seed))
        model = jax.tree.map(lambda x, k=seed: x[k], models)
        key = jax.random.key(config.seed + seed)
        measured.append(option_space.measure(env, config.options, model, experience, key, arguments.options))
    lists = {
        "first": taic["return"]["first_per_seed"],
        "return": taic["return"]["per_seed"],
        "mean_option": taic["return_mean_option"]["per_seed"],
        "duration": taic["duration"]["per_seed"],
        **{name: [row[name] for row in measured] for name in MEASURES},
    }
    run = {"kind": rule, "decoder": decoder, "constraints": constraints, "pretraining": config.collect.ticks}
    return run | {"seconds": told["seconds"]["run"]} | lists


def read_table(path: Path) -> list[dict[str, str]]:
    """Return the rows finished so far."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def append(arguments: Arguments, task: str, row: dict[str, Any]) -> None:
    """Add one finished row to the table."""
    row = {"task": task, "decoder": "", "constraints": "", "seeds": arguments.seeds, "ticks": arguments.ticks} | row
    row |= {name: " ".join(f"{float(x):.4g}" for x in row.get(name, ())) for name in LISTS}
    row |= {"commit": commit(), "seconds": round(row["seconds"])}
    new = not arguments.out.exists()
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    with arguments.out.open("a", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        if new:
            writer.writeheader()
        writer.writerow(row)


def wanted(arguments: Arguments, task: str) -> list[tuple[str, ...]]:
    """Return every cell of one task, the flat ones first."""
    kinds = [(r, d, c) for d in arguments.decoders for c in arguments.constraints for r in arguments.rules]
    return [(strength, "", "") for strength in FLAT] + kinds


def show(rows: list[dict[str, str]]) -> None:
    """Print each row with intervals, and how probably its return beats flat PPO's on the same task."""
    numbers = {name: [np.array(row[name].split(), float) for row in rows] for name in LISTS}
    flat = {(row["task"], row["kind"]): x for row, x in zip(rows, numbers["return"], strict=True)}
    print("task kind decoder constraints | untrained | return IQM (95 %) | duration | P(beats strong, weak) | measures")
    for i, row in enumerate(rows):
        low, high = bootstrap_interval(numbers["return"][i])
        beats = [
            "{:.2f} ({:.2f}…{:.2f})".format(p, *interval)
            for p, interval in (
                probability_of_improvement(numbers["return"][i], flat[row["task"], strength]) for strength in FLAT
            )
        ]
        name = " ".join(row[field] or "-" for field in ("task", "kind", "decoder", "constraints"))
        scores = f"{iqm(numbers['first'][i]):6.0f} | {iqm(numbers['return'][i]):6.0f} ({low:.0f}…{high:.0f})"
        told = [f"{measure} {np.mean(numbers[measure][i]):.2f}" for measure in MEASURES if numbers[measure][i].size]
        print(f"{name} | {scores} | {np.mean(numbers['duration'][i]):.1f} | {', '.join(beats)} | {'; '.join(told)}")


def main() -> None:
    """Run what is missing, a row at a time, and print the table."""
    arguments = tyro.cli(Arguments)
    keep_programs()
    for task in arguments.tasks:
        for kind in wanted(arguments, task):
            size = (str(arguments.seeds), str(arguments.ticks))
            names = ("task", "kind", "decoder", "constraints", "seeds", "ticks")
            if (task, *kind, *size) in [tuple(row[name] for name in names) for row in read_table(arguments.out)]:
                continue
            run = run_flat(arguments, task, kind[0]) if kind[0] in FLAT else run_cell(arguments, task, *kind)
            append(arguments, task, run)
    show(read_table(arguments.out))


if __name__ == "__main__":
    main()
