"""Measure ticks per second side by side: engine, rollout in jit, training flat and over options, other libraries.

python -m taic_jax.experiments.throughput --task half_cheetah --peers --json throughput.json
python -m taic_jax.experiments.throughput --task nav2d --scaling --sweep
python -m taic_jax.experiments.throughput --task ant --num-envs 2048 --training.num-envs 2048   # on a GPU
"""

import dataclasses
import json
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np
import tyro

from taic_jax import envs
from taic_jax.command_line import tell
from taic_jax.config import ConfigError, OptionsConfig, PPOConfig
from taic_jax.config_io import load_config, preset_names
from taic_jax.envs.errors import MissingExtraError
from taic_jax.experiments import peers
from taic_jax.experiments.costs import saving, scaling, shares
from taic_jax.experiments.loops import (
    WORK,
    Training,
    bare_engine,
    has_engine,
    learnt_executor,
    options_config,
    untrained_rollout,
    untrained_ticks,
)
from taic_jax.experiments.peers.brax_ppo import PIPELINES, DoesNotRunError, ticks_per_second
from taic_jax.experiments.processes import SeedsApart, Sweep, starts, sweep_costs
from taic_jax.experiments.turns import Loop, Speeds, take_turns
from taic_jax.options.execution import Executor, IdentityExecutor
from taic_jax.runtime.program_cache import keep_programs

HEADLINE = "option_training"
PAPER = ("fixed", "open")
"""The options of the row that stands for option training: the paper's."""


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Measure ticks per second on one task, in loops that take turns."""

    task: str = "half_cheetah"
    """The task."""
    peers: bool = False
    """Measure other libraries at the same work too (extra peers), on Gymnasium's models."""
    model: Literal["", "brax", "gym"] = ""
    """MJCF and rules of the task, as env.model; empty takes gym beside peers, and brax alone."""
    backend: Literal["auto", "mujoco", "mjx", "warp"] = "auto"
    """Physics, as env.backend."""
    pipelines: tuple[Literal["spring", "positional", "generalized", "mjx"], ...] = PIPELINES
    """Brax's engines, beside peers."""
    num_envs: int = 256
    """Environments of the engine and of the rollout."""
    rollout_length: int = 128
    """Their ticks per environment."""
    training: PPOConfig = WORK
    """Work of an iteration of training, ours and the peers'."""
    seeds: int = 5
    """Seeds of the rows with several."""
    rules: tuple[Literal["fixed", "output", "predict"], ...] = ("fixed", "output", "predict")
    """Termination rules."""
    decoders: tuple[Literal["open", "closed"], ...] = ("open", "closed")
    """Decoders."""
    steps: int = 200
    """Gradient steps in which the options are learnt; it changes how long they last, and so the speed."""
    rounds: int = 5
    """Rounds in which each loop runs once; the table tells medians."""
    starts: bool = False
    """Measure too how long a run takes to its first logged iteration, with an empty and a filled cache of programs, and
    resumed."""
    checkpoints: bool = False
    """Measure too what a checkpoint after each iteration costs, at one seed and at several."""
    scaling: bool = False
    """Measure too what a tick costs as environments, seeds, option length and observation size grow by 16."""
    sweep: bool = False
    """Measure too 64 points x 4 seeds in one program, in a loop, and in separate processes."""
    sweep_ticks: int = 65536
    """Ticks of each run of the sweep."""
    json: Path | None = None
    """Also write the figures to this file."""


def make_env(arguments: Arguments) -> envs.Env:
    """Make the task with the model asked for.

    Raises:
      UnknownNameError: there is no such task.
      MissingExtraError: its model needs a package that is not installed.
    """
    takes_model = "model" in envs.environment_options(arguments.task)
    model = arguments.model or ("gym" if arguments.peers and takes_model else "brax")
    return envs.make_env(arguments.task, arguments.backend, model=model)


def our_loops(arguments: Arguments, env: envs.Env) -> list[Loop]:
    """Return the loops of the engine, the rollout, and training: flat, over options, and of several seeds."""
    ticks = arguments.num_envs * arguments.rollout_length
    compiled, begin = untrained_rollout(env, arguments.num_envs, arguments.rollout_length)
    loops = [Loop("engine", bare_engine(env, compiled(begin)[1].action), ticks)] if has_engine(env) else []
    loops.append(Loop("rollout", lambda: jax.block_until_ready(compiled(begin)), ticks))
    seen, executors = untrained_ticks(env), {"flat_training": IdentityExecutor(env.action_size)}
    kinds = [(rule, decoder) for decoder in arguments.decoders for rule in arguments.rules]
    for kind in kinds:
        name = HEADLINE if kind == PAPER else f"{HEADLINE}/{'/'.join(kind)}"
        executors[name] = learnt_executor(env, seen, options_config(*kind, arguments.steps))
    for name, executor in executors.items():
        training = Training(env, executor, arguments.training)
        loops.append(Loop(name, training, training.ticks))
    several = {"flat_training": None, HEADLINE: options_config(*PAPER, arguments.steps)}
    for name, options in several.items():
        if name in executors and arguments.seeds > 1:
            training = several_seeds(arguments, env, executors[name], options)
            loops.append(Loop(f"{name}/{arguments.seeds} seeds", training, training.ticks))
    return loops


def several_seeds(
    arguments: Arguments, env: envs.Env, executor: Executor, options: OptionsConfig | None
) -> Training | SeedsApart:
    """Return training of several seeds: side by side on an accelerator, on a CPU split over its cores."""
    if jax.default_backend() == "cpu":
        return SeedsApart(partial(make_env, arguments), arguments.training, arguments.seeds, options)
    return Training(env, executor, arguments.training, arguments.seeds)


def peer_loops(arguments: Arguments) -> tuple[list[Loop], dict[str, str]]:
    """Return the loops of the peers that run here, and a remark on each: its setting, or why it does not run."""
    loops, remarks = [], {}
    for name, make, tasks in (
        ("stable_baselines3", peers.make_stable_baselines, peers.GYMNASIUM),
        ("envpool_pytorch", peers.make_envpool, peers.ENVPOOL),
    ):
        if arguments.task not in tasks:
            remarks[name] = "has no such task"
            continue
        try:
            peer, remarks[name] = make(arguments.task, arguments.training)
        except MissingExtraError as error:
            remarks[name] = str(error)
            continue
        loops.append(Loop(name, peer, peer.ticks))
    return loops, remarks


def measure_brax(arguments: Arguments) -> tuple[dict[str, Speeds], dict[str, str]]:
    """Return the speed of Brax's PPO on each pipeline, if it runs, and the remarks on them."""
    if arguments.task not in peers.BRAX:
        return {}, {"brax": "has no such task"}
    speeds = {}
    for pipeline in arguments.pipelines:
        try:
            rounds = ticks_per_second(peers.BRAX[arguments.task], pipeline, arguments.training)
        except DoesNotRunError as error:
            return {}, {"brax": str(error)}
        speeds[f"brax/{pipeline}"] = Speeds(rounds, float("nan"))
    return speeds, dict.fromkeys(speeds, "takes no turns with the others")


def measure(arguments: Arguments, env: envs.Env) -> dict[str, dict[str, Any]]:
    """Return a row per loop: median ticks per second, medians of its ratios round by round, and a remark.

    Ratios are to the engine and to flat training; what does not run has a remark alone.
    """
    loops, remarks = our_loops(arguments, env), {}
    if arguments.peers:
        others, remarks = peer_loops(arguments)
        loops += others
    speeds = take_turns(loops, arguments.rounds)
    for loop in loops:
        if isinstance(loop.run, Training | SeedsApart) and HEADLINE in loop.name:
            remarks[loop.name] = f"{loop.run.duration:.1f} ticks a decision"
    if arguments.peers:
        brax, told = measure_brax(arguments)
        speeds, remarks = speeds | brax, remarks | told
    return {name: row(speeds, name, remarks.get(name, "")) for name in dict.fromkeys([*speeds, *remarks])}


def row(speeds: dict[str, Speeds], name: str, remark: str) -> dict[str, Any]:
    """Return one row of the table; what was not measured is None."""
    told: dict[str, Any] = {"ticks_per_second": speeds[name].median if name in speeds else None}
    for other, field in (("engine", "ratio_to_engine"), ("flat_training", "ratio_to_flat_training")):
        told[field] = None
        if name in speeds and other in speeds:
            same = len(speeds[name].rounds) == len(speeds[other].rounds)
            medians = speeds[name].median / speeds[other].median
            told[field] = speeds[name].ratio(speeds[other]) if same else medians
    return told | {"first_call_seconds": speeds[name].first_call if name in speeds else None, "remark": remark}


def check(arguments: Arguments) -> None:
    """Refuse what could only fail after minutes.

    Raises:
      ConfigError: a number is too small, the minibatches of peers would not be equal, or a file cannot be written.
    """
    for name in ("num_envs", "rollout_length", "seeds", "steps", "rounds", "sweep_ticks"):
        if getattr(arguments, name) < 1:
            raise ConfigError(f"--{name.replace('_', '-')}: expected at least 1, got {getattr(arguments, name)}")
    ticks, size = arguments.training.num_envs * arguments.training.rollout_length, arguments.training.minibatch_size
    if size < 1 or ticks % size:
        raise ConfigError(f"--training.minibatch-size: expected a divisor of the {ticks} ticks, got {size}")
    if arguments.json and not arguments.json.parent.is_dir():
        raise ConfigError(f"--json: there is no folder {arguments.json.parent}")
    if arguments.starts and arguments.task not in preset_names():
        raise ConfigError(f"--starts: expected a task with a preset of its name ({', '.join(preset_names())})")


def report(arguments: Arguments) -> dict[str, Any]:
    """Measure all that is asked for, print each table when it is there, and return the figures."""
    env = make_env(arguments)
    figures: dict[str, Any] = {}
    if arguments.starts:  # before this process holds memory and threads
        figures["starts"] = starts(arguments.task)
        for name, value in figures["starts"].items():
            print(f"{name} start to the next logged iteration: {value:.1f} s", flush=True)
    rows = measure(arguments, env)
    for name in ("engine", "rollout", "flat_training", HEADLINE):
        figures[name] = rows.get(name, {}).get("ticks_per_second")
    figures |= {"device": jax.devices()[0].device_kind, "task": arguments.task, "rows": rows}
    figures["shares"] = shares(env, arguments.training, arguments.rounds)
    show(figures)
    if arguments.checkpoints:
        counts = sorted({1, arguments.seeds})
        figures["checkpoints"] = saving(env, arguments.training, counts, arguments.rounds)
        for seeds, share in figures["checkpoints"].items():
            print(f"a checkpoint after each iteration, {seeds} seeds: {share:+.1%} time")
    if arguments.scaling:
        figures["scaling"] = []
        for cost in scaling(env, arguments.training, arguments.steps, arguments.rounds):
            print(f"{cost.axis:17} {cost.value:4}   {cost.microseconds:8.2f} us/tick   {cost.of_linear:5.2f} of linear")
            figures["scaling"].append(dataclasses.asdict(cost))
    if arguments.sweep:
        config = load_config("nav2d").train.ppo if arguments.task == "nav2d" else arguments.training
        figures["sweep"] = sweep_costs(Sweep(arguments.task, 64, 4, arguments.sweep_ticks, config), 8)
        show_sweep(figures["sweep"])
    return figures


def show(figures: dict[str, Any]) -> None:
    """Print the table of speeds, and where the time of an iteration goes."""
    print(f"on {figures['device']}")
    print(f"{figures['task']:32} {'ticks/s':>12} {'of engine':>10} {'of flat':>8} {'first call':>11}")
    for name, told in figures["rows"].items():
        numbers = [
            told[k] for k in ("ticks_per_second", "ratio_to_engine", "ratio_to_flat_training", "first_call_seconds")
        ]
        texts = [
            "" if x is None or np.isnan(x) else form.format(x)
            for x, form in zip(numbers, ("{:,.0f}", "{:.2f}", "{:.2f}", "{:.1f} s"), strict=True)
        ]
        print(f"{name:32} {texts[0]:>12} {texts[1]:>10} {texts[2]:>8} {texts[3]:>11}   {told['remark']}".rstrip())
    print("share of an iteration:", ", ".join(share_text(*share) for share in figures["shares"].items()))


def share_text(name: str, share: float) -> str:
    """Return the share of a part, a difference of two loops, which noise may make less than nothing."""
    return f"{name} {share:.0%}" if share >= 0 else f"{name} too little to be told from noise"


def show_sweep(told: dict[str, int | float]) -> None:
    """Print what a sweep costs in three ways."""
    begin = f"{told['runs']} runs in one program: {told['one_program']:.1f} s"
    print(f"{begin}; compilation {told['compile_one_program']:.1f} s")
    for name in ("loop", "processes"):
        ratio = told[name] / told["one_program"]
        print(f"{name}: {told[name]:.1f} s, {ratio:.2f} x that; counted up from {told['runs_measured']} runs")


def main(args: Sequence[str] | None = None) -> int:
    """Print the tables and return the exit code: 2 for a mistake of the user, told in one line."""
    arguments = tyro.cli(Arguments, args=args)
    try:
        check(arguments)
        keep_programs()
        figures = report(arguments)
        if arguments.json:
            arguments.json.write_text(json.dumps(figures, indent=2) + "\n")
    except ValueError as error:
        if not type(error).__module__.startswith("taic_jax."):
            raise
        print("taic_jax: error:", " ".join(str(error).split()), file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(tell(main))
