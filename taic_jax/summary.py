"""The plan before a run, and its summary, table and video after it."""

import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.box import SIMPLE
from rich.table import Table

from taic_jax.analysis.evaluate import record
from taic_jax.analysis.statistics import iqm, summarize
from taic_jax.artifacts.experience import experience_bytes
from taic_jax.config import (
    COLLECT,
    PRACTISE,
    Config,
    ReplayConfig,
    collector_is_baseline,
    experience_ticks,
    method_label,
    needs_collect,
    settings_of,
)
from taic_jax.envs.base import Env
from taic_jax.envs.rendering import write_webp
from taic_jax.nonfinite import FINITE, QUANTITIES
from taic_jax.rl.agent import Agent
from taic_jax.rl.learner import num_iterations
from taic_jax.rl.off_policy import goals_of
from taic_jax.rl.replay import row_size
from taic_jax.runtime.checkpoint import version_of
from taic_jax.runtime.driver import Run, Stopped
from taic_jax.runtime.files import atomic_file, json_safe, writes_here
from taic_jax.runtime.run_folder import Method, Summary
from taic_jax.trainer import Trained

PACKAGES = ("taic_jax", "jax", "jaxlib", "flax", "optax", "brax", "mujoco", "mujoco-mjx", "orbax-checkpoint")
MIB = 2**20


def plan(config: Config, env: Env, source: Env) -> str:
    """Return the cost of a run: interactions and memory, one line per stage."""
    collect, options, train, collects = config.collect, config.options, config.train, needs_collect(config)
    flat = settings_of(collect)
    rows = [("collect", source, flat, collect.ticks)] if collects else []
    if config.practise.ticks:
        rows.append((PRACTISE, source, config.practise.sac, config.practise.ticks))
    rows.append(("train", env, settings_of(train), train.ticks))
    for name in train.baselines:
        if not (name == "flat" and collector_is_baseline(config)):
            rows.append((name, env, flat, train.ticks + (collect.ticks if name == "total" else 0)))
    lines = []
    for stage, task, learner, ticks in rows:
        iterations = num_iterations(learner, ticks)
        if stage == "train" and options.refresh_every:
            iterations -= iterations % options.refresh_every
        real = iterations * learner.num_envs * learner.rollout_length
        lines.append(f"{stage:8} {task.name}: {real:,} ticks x {config.seeds} seeds in {iterations} iterations")
    names = ", ".join(options.experience or (COLLECT,))
    learn = f"{'learn':8} {options.steps:,} gradient steps on windows of {options.length} ticks from {names}"
    lines.insert(int(collects), f"{'options':8} as learnt in {options.source}" if options.source else learn)
    if collects:
        size = experience_bytes(source, experience_ticks(collect)) * config.seeds / MIB
        if experience_ticks(collect) < collect.ticks:
            lines.append(f"{'keep':8} the newest {experience_ticks(collect):,} ticks of collect")
        memory = "" if options.source else f", {2 * size:,.0f} MiB while options are learnt"
        lines.append(f"{'memory':8} experience {size:,.0f} MiB on disk{memory}")
    replays = replay_sizes(config, env, source).items()
    return "\n".join([*lines, *(f"{'memory':8} replay of {name} {size / MIB:,.0f} MiB" for name, size in replays)])


def replay_sizes(config: Config, env: Env, source: Env) -> dict[str, int]:
    """Return the bytes of the replay buffers of all seeds, by the stage that has one."""
    options = config.options
    flat, chosen = (env.action_size, 1), (options.codes or options.size, options.length)
    state_and_code = source.proprioceptive_size + options.size + 1
    stages = (
        ("collect", settings_of(config.collect), config.collect.ticks, source, source.observation_size, *flat),
        (PRACTISE, settings_of(config.practise), config.practise.ticks, source, state_and_code, *flat),
        ("train", settings_of(config.train), config.train.ticks, env, env.observation_size, *chosen),
    )
    sizes = {}
    for name, learner, ticks, task, observation_size, option_size, length in stages:
        if ticks and isinstance(learner, ReplayConfig):
            goals = goals_of(learner, task)
            row = row_size(observation_size, option_size, length, goals.size if goals else 0)
            sizes[name] = 4 * row * min(learner.capacity, ticks) * config.seeds
    return sizes


def as_summary(run: Run, methods: Mapping[str, Trained]) -> Summary:
    """Return the contents of `summary.json`, from a run after its last stage, and from its policies by method."""
    clock = run.clock
    return {
        "ticks": clock.ticks,
        "ticks_per_second": clock.ticks / clock.run if clock.run else None,
        "seconds": {"compile": clock.compile, "run": clock.run},
        "stopped": {stage: _stopped(seeds) for stage, seeds in run.stopped.items() if (seeds.code != FINITE).any()},
        "methods": {name: _method(x.first, x.last) for name, x in methods.items()},
        "versions": {name: version_of(name) for name in PACKAGES},
        "commit": commit(),
    }


def as_table(summary: Summary, learner: str) -> Table:
    """Return a table of the returns of each method: interquartile means over seeds, and their 95 % intervals."""
    table = Table("method", box=SIMPLE, title="return of an episode", title_justify="left", title_style="")
    for column in ("untrained", "trained, as it explores", "its mean options or actions"):
        table.add_column(column, justify="right")
    for name, method in summary["methods"].items():
        first = iqm(np.array(method["return"]["first_per_seed"], float))
        trained = [_interval(method[mode]) for mode in ("return", "return_mean_option")]
        table.add_row(method_label(name, learner), f"{first:,.0f}", *trained)
    return table


def _interval(statistics: Mapping[str, Any]) -> str:
    """Return an interquartile mean with its interval, if several seeds have one."""
    if statistics["iqm"] is None:
        return "a seed diverged"
    low, high = statistics["ci95"]
    return f"{statistics['iqm']:,.0f}" + ("" if low is None else f" ({low:,.0f} … {high:,.0f})")


def _stopped(seeds: Stopped) -> dict[str, dict[str, Any]]:
    """Return the cause of each seed that stopped in a stage, and its ticks or gradient steps before."""
    return {
        str(seed): {"quantity": QUANTITIES[seeds.code[seed]], "after": int(seeds.after[seed])}
        for seed in np.flatnonzero(seeds.code != FINITE)
    }


def _method(first: Mapping[str, Mapping], last: Mapping[str, Mapping]) -> Method:
    """Summarise every evaluated quantity over seeds; `return` is with exploration."""
    result: Any = {}
    for mode in last:
        result[mode] = summarize(last[mode]["return"])
        result[mode]["first_per_seed"] = json_safe(np.asarray(first[mode]["return"], float))
    metrics = dict(last["return_mean_option"])
    del metrics["durations"]
    result["duration"] = _durations(np.asarray(last["return"]["durations"], float))
    result["metrics"] = {name: summarize(values) for name, values in metrics.items()}
    return result


def _durations(counts: np.ndarray) -> dict[str, Any]:
    """Summarise the counts [K, L] of options of 1..L ticks: the mean per seed, and the shares over all seeds."""
    ticks = np.arange(1, counts.shape[1] + 1)
    means = counts @ ticks / counts.sum(axis=1)
    return {**summarize(means), "histogram": json_safe(counts.sum(axis=0) / counts.sum())}


def commit() -> str | None:
    """Return the git commit of the checkout this package runs from, with `-dirty` if the package was changed, or None.

    Changes of other files of the checkout, such as tables of results, do not affect a run.
    """
    git = ["git", "-C", str(Path(__file__).parent)]
    commands = [*git, "rev-parse", "HEAD"], [*git, "status", "--porcelain", "--untracked-files=no", "."]
    try:
        head, changed = (subprocess.run(line, capture_output=True, text=True, check=True).stdout for line in commands)
    except (OSError, subprocess.CalledProcessError):
        return None
    return head.strip() + ("-dirty" if changed else "")


def write_video(run: Run, env: Env, agent: Agent) -> None:
    """Write `video.webp`: the first seed's policy taking its mean options."""
    ticks = run.config.evaluate.video_ticks
    if not ticks or not writes_here():
        return
    agent = jax.device_get(jax.tree.map(lambda x: x[0], agent))
    physics = jax.jit(lambda agent, key: record(env, agent, key, ticks))(agent, run.stage_keys("video")[0])
    frames = env.render(jax.device_get(physics))
    with atomic_file(run.folder.path / "video.webp") as file:
        write_webp(file, frames, env.dt)
    run.logger.show("video", run.config.train.ticks, frames, env.dt)
