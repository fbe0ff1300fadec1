"""Measure ticks per second side by side: engine, rollout in jit, training flat and over options, other libraries.

python -m taic_jax.experiments.benchmark.throughput --task half_cheetah --peers --json throughput.json
python -m taic_jax.experiments.benchmark.throughput --task nav2d --scaling --sweep
python -m taic_jax.experiments.benchmark.throughput --task ant --num-envs 2048 --training.num-envs 2048   # on a GPU
"""

import dataclasses
import itertools
import sys
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import jax

from taic_jax import envs
from taic_jax.config import ConfigError, OptionsConfig, PPOConfig
from taic_jax.config.files import load_config, preset_names
from taic_jax.experiments.benchmark import loops, peers
from taic_jax.experiments.benchmark.command import Command, answer, show
from taic_jax.experiments.benchmark.loops import Training
from taic_jax.experiments.benchmark.peers.brax_ppo import PIPELINES, Pipeline
from taic_jax.experiments.benchmark.processes import SeedsApart, Sweep, starts, sweep_costs
from taic_jax.experiments.benchmark.scaling import saving, scaling, shares
from taic_jax.experiments.benchmark.timing import Speeds, Ticking, interleave
from taic_jax.options.execution import Executor

HEADLINE = "option_training"
PAPER = ("fixed", "open")  # The options of the row that stands for option training: the paper's.


@dataclasses.dataclass(frozen=True)
class Arguments(Command):
    """Measure ticks per second on one task, in loops that take turns."""

    task: str = "half_cheetah"  # The task.
    peers: bool = False  # Measure other libraries at the same work too (extra peers), on Gymnasium's models.
    model: Literal["", "brax", "gym"] = ""
    """MJCF and rules of the task, as env.model; empty takes gym beside peers, and brax alone."""
    backend: Literal["auto", "mujoco", "mjx", "warp"] = "auto"  # Physics, as env.backend.
    pipelines: tuple[Pipeline, ...] = PIPELINES  # Brax's engines, beside peers.
    num_envs: int = 256  # Environments of the engine and of the rollout.
    rollout_length: int = 128  # Their ticks per environment.
    training: PPOConfig = loops.WORK  # Work of an iteration of training, ours and the peers'.
    seeds: int = 5  # Seeds of the rows with several.
    rules: tuple[Literal["fixed", "output", "predict"], ...] = ("fixed", "output", "predict")  # Termination rules.
    decoders: tuple[Literal["open", "closed"], ...] = ("open", "closed")  # Decoders.
    steps: int = 200  # Gradient steps in which the options are learnt; their number changes the options' duration.
    rounds: int = 5  # Rounds in which each loop runs once; the table has medians.
    starts: bool = False  # Measure too a run's time to its first logged iteration: empty cache, filled one, resumed.
    checkpoints: bool = False  # Measure too the cost of a checkpoint after each iteration, at one seed and at several.
    scaling: bool = False
    """Measure too the cost of a tick as environments, seeds, option length and observation size grow by 16."""
    sweep: bool = False  # Measure too 64 points x 4 seeds in one program, in a loop, and in separate processes.
    sweep_ticks: int = 65536  # Ticks of each run of the sweep.


def make_env(arguments: Arguments) -> envs.Env:
    """Make the task with the model of the arguments; raise the errors of `envs.make_env`."""
    takes_model = "model" in envs.environment_options(arguments.task)
    model = arguments.model or ("gym" if arguments.peers and takes_model else "brax")
    return envs.make_env(arguments.task, arguments.backend, model=model)


def our_loops(arguments: Arguments, env: envs.Env) -> dict[str, Ticking]:
    """Return the loops of the engine, the rollout, and training: flat, over options, and of several seeds."""
    rollout = loops.untrained_rollout(env, arguments.num_envs, arguments.rollout_length)
    engine = {"engine": loops.bare_engine(env, rollout.run()[1].action)} if loops.has_engine(env) else {}
    ours: dict[str, Ticking] = {**engine, "rollout": rollout}
    options: dict[str, OptionsConfig | None] = {"flat_training": None}
    for decoder, rule in itertools.product(arguments.decoders, arguments.rules):
        name = HEADLINE if (rule, decoder) == PAPER else f"{HEADLINE}/{rule}/{decoder}"
        options[name] = loops.options_config(rule, decoder, arguments.steps)
    ticks = loops.untrained_ticks(env)
    executors = {name: loops.executor_of(env, config, ticks) for name, config in options.items()}
    ours |= {name: Training(env, executor, arguments.training) for name, executor in executors.items()}
    for name in ("flat_training", HEADLINE):
        if name in executors and arguments.seeds > 1:
            ours[f"{name}/{arguments.seeds} seeds"] = several_seeds(arguments, env, executors[name], options[name])
    return ours


def several_seeds(
    arguments: Arguments, env: envs.Env, executor: Executor, options: OptionsConfig | None
) -> Training | SeedsApart:
    """Return training of several seeds: in one program on an accelerator, split over the cores of a CPU."""
    if jax.default_backend() == "cpu":
        return SeedsApart(partial(make_env, arguments), arguments.training, arguments.seeds, options)
    return Training(env, executor, arguments.training, arguments.seeds)


def measure(arguments: Arguments, env: envs.Env) -> dict[str, dict[str, Any]]:
    """Return a row per loop: median ticks per second, ratios to the engine and to flat training, and a remark.

    A loop that does not run has a remark alone.
    """
    all_loops, remarks = our_loops(arguments, env), {}
    if arguments.peers:
        others, remarks = peers.loops(arguments.task, arguments.training)
        all_loops |= others
    speeds = interleave(all_loops, arguments.rounds)
    for name, loop in all_loops.items():
        if isinstance(loop, Training | SeedsApart) and HEADLINE in name:
            remarks[name] = f"{loop.duration:.1f} ticks a decision"
    if arguments.peers:
        rounds, more = peers.brax_rounds(arguments.task, arguments.training, arguments.pipelines)
        speeds |= {name: Speeds(speed, None) for name, speed in rounds.items()}
        remarks |= more
    return {name: row(speeds, name, remarks.get(name, "")) for name in dict.fromkeys([*speeds, *remarks])}


def row(speeds: dict[str, Speeds], name: str, remark: str) -> dict[str, Any]:
    """Return one row of the table, with None for each missing number."""
    own, engine, flat = (speeds.get(which) for which in (name, "engine", "flat_training"))
    return {
        "ticks_per_second": own and own.median,
        "ratio_to_engine": own and engine and own.ratio(engine),
        "ratio_to_flat_training": own and flat and own.ratio(flat),
        "first_call_seconds": own and own.first_call,
        "remark": remark,
    }


def check(arguments: Arguments) -> None:
    """Raise `ConfigError` at a number that is too small, minibatches of unequal size, or a missing preset."""
    for name in ("num_envs", "rollout_length", "seeds", "steps", "rounds", "sweep_ticks"):
        if getattr(arguments, name) < 1:
            raise ConfigError(f"--{name.replace('_', '-')}: expected at least 1, got {getattr(arguments, name)}")
    ticks, size = arguments.training.num_envs * arguments.training.rollout_length, arguments.training.minibatch_size
    if size < 1 or ticks % size:
        raise ConfigError(f"--training.minibatch-size: expected a divisor of the {ticks} ticks, got {size}")
    if arguments.starts and arguments.task not in preset_names():
        raise ConfigError(f"--starts: expected a task with a preset of its name ({', '.join(preset_names())})")


def report(arguments: Arguments) -> dict[str, Any]:
    """Measure, print each table as it comes, and return the figures."""
    check(arguments)
    env = make_env(arguments)
    figures: dict[str, Any] = {}
    if arguments.starts:  # before this process holds memory and threads
        figures["starts"] = starts(arguments.task)
        show({"start to the next iteration": name, "seconds": x} for name, x in figures["starts"].items())
    rows = measure(arguments, env)
    for name in ("engine", "rollout", "flat_training", HEADLINE):
        figures[name] = rows.get(name, {}).get("ticks_per_second")
    figures |= {"device": jax.devices()[0].device_kind, "task": arguments.task, "rows": rows}
    show({f"{arguments.task} on {figures['device']}": name} | cells for name, cells in rows.items())
    figures["shares"] = shares(env, arguments.training, arguments.rounds)
    print("share of an iteration:", ", ".join(share_text(*share) for share in figures["shares"].items()))
    if arguments.checkpoints:
        counts = sorted({1, arguments.seeds})
        figures["checkpoints"] = saving(env, arguments.training, counts, arguments.rounds)
        for seeds, share in figures["checkpoints"].items():
            print(f"a checkpoint after each iteration, {seeds} seeds: {share:+.1%} time")
    if arguments.scaling:
        figures["scaling"] = show(scaling(env, arguments.training, arguments.steps, arguments.rounds))
    if arguments.sweep:
        config = load_config("nav2d").train.ppo if arguments.task == "nav2d" else arguments.training
        figures["sweep"] = costs = sweep_costs(Sweep(arguments.task, 64, 4, arguments.sweep_ticks, config), 8)
        ways = ("one_program", "loop", "processes")
        show({"sweep": way, "seconds": costs[way], "ratio": costs[way] / costs["one_program"]} for way in ways)
        show([costs])
    return figures


def share_text(name: str, share: float) -> str:
    """Return the share of a part in words; it is a difference of two loops, and noise may make it negative."""
    return f"{name} {share:.0%}" if share >= 0 else f"{name} too little to be told from noise"


def main(args: Sequence[str] | None = None) -> int:
    """Print the tables and return the exit code: 2 after one line on a mistake of the user."""
    return answer(Arguments, report, args)


if __name__ == "__main__":
    sys.exit(main())
