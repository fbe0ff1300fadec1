"""The main job: collect experience, learn options, train a policy over them, evaluate."""

import dataclasses
import json
import shutil
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from taic_jax.artifacts import OPTIONS, POLICY, describe, load_options, load_policy, save_options, save_policy
from taic_jax.config import COLLECT, Config, ConfigError, collector_is_baseline, needs_collect
from taic_jax.config_io import to_yaml
from taic_jax.envs import environment_options, make_env
from taic_jax.envs.base import Env
from taic_jax.envs.errors import RenderingError
from taic_jax.experience import EXPERIENCE, ExperienceStore, gather_experience, num_blocks
from taic_jax.level import FineTunedLevel, Level, Trained
from taic_jax.logging import RunLogger
from taic_jax.networks import PolicyParams
from taic_jax.normalize import Statistics
from taic_jax.options import learning
from taic_jax.options.dataset import Experience, holds_out, make_dataset
from taic_jax.options.execution import IdentityExecutor, make_executor
from taic_jax.options.model import OptionModel, make_networks
from taic_jax.stage import CLOCK, Clock, Run, drive
from taic_jax.summary import as_summary, write_video
from taic_jax.types import as_arrays

STEPS_PER_LOG = 100


class RunFolderError(ValueError):
    """The run folder cannot be used as asked."""


def run_pipeline(config: Config, run_dir: Path, *, resume: bool = False, overwrite: bool = False) -> dict:
    """Run every stage that is not done yet and return the summary, also written to `summary.json`.

    Raises:
      RunFolderError: the folder holds another run, or none where one is to be resumed.
      ConfigError: the config does not fit the environment.
      ArtifactError: another run does not hold what the config takes from it.
    """
    env, source = make_envs(config)
    model, policy = take_over(config, env, source)  # what is refused is refused before anything is written
    prepare_folder(config, run_dir, resume=resume, overwrite=overwrite)
    # Seed k of a run is seed 0 of a run whose seed is k more.
    keys = jnp.stack([jax.random.key(config.seed + k) for k in range(config.seeds)])
    with RunLogger(run_dir) as logger:
        run = Run(as_arrays(config), keys, run_dir, logger, Clock.load(run_dir / CLOCK))
        logger.truncate("evaluate", -1)
        collector = collect(run, source) if needs_collect(config) else None
        model = learn(run, source) if model is None else model
        methods = {"taic": train_over_options(run, env, model)}
        for name in config.train.baselines:
            # Where experience comes from the task itself, the collector is the flat baseline.
            done = collector if name == "flat" and collector_is_baseline(config) else None
            methods[name] = done or train_baseline(run, env, name, policy)
    summary = as_summary(run, {name: {"first": x.first, "last": x.last} for name, x in methods.items()})
    (run_dir / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    try:
        write_video(run, env, methods["taic"].agent)
    except RenderingError as error:  # nothing else depends on it, and all results are saved
        print(f"taic_jax: no video: {error}", file=sys.stderr)
    return summary


def make_envs(config: Config) -> tuple[Env, Env]:
    """Return the task and the environment that experience is collected in.

    Raises:
      ConfigError: options learnt in one do not fit the other.
    """
    options = dataclasses.asdict(config.env)
    name = options.pop("name")
    env = source = make_env(name, **options)
    if config.collect.env:
        kept = ("backend", "num_threads", *environment_options(config.collect.env))
        source = make_env(config.collect.env, **{option: options[option] for option in kept})
    bodies = [(*describe(e).values(),)[1:] for e in (source, env)]
    if bodies[0] != bodies[1]:
        raise ConfigError(
            f"collect.env: expected the body of {config.env.name} (proprioceptive slice, its size, and action size "
            f"{bodies[1]}), got {config.collect.env} with {bodies[0]}"
        )
    if config.options.length > env.episode_length:
        raise ConfigError(
            f"options.length: expected at most the {env.episode_length} ticks of an episode of {env.name}, "
            f"got {config.options.length}; the nearest valid value is {env.episode_length}"
        )
    return env, source


def take_over(
    config: Config, env: Env, source: Env
) -> tuple[OptionModel | None, tuple[PolicyParams, Statistics] | None]:
    """Return the option models and flat policies [K] that the config takes from another run, where it does.

    Seed k takes the k-th, modulo their number. Experience is only checked, by reading one seed's.

    Raises:
      ArtifactError: nothing is there, or it was made for another body or with another structure.
    """
    model = policy = None
    if config.options.source:
        folder = Path(config.options.source)
        model = load_options(folder, env, config.options, config.seeds)
        if "transfer" in config.train.baselines:
            policy = load_policy(folder, env, config.collect.ppo, config.seeds)
    else:
        for name in config.options.experience:
            if name != COLLECT:
                gather_experience(Path(name), source, 1)
    return model, policy


def prepare_folder(config: Config, run_dir: Path, *, resume: bool = False, overwrite: bool = False) -> None:
    """Make the run folder, or check that it is the one to resume.

    Raises:
      RunFolderError: the folder holds another run, or none where one is to be resumed.
    """
    saved, text = run_dir / "config.yaml", to_yaml(config)
    if resume:
        if not saved.is_file():
            raise RunFolderError(f"{run_dir} holds no run to resume: no config.yaml in it")
        old = saved.read_text().splitlines()
        differing = [line.strip() for line in text.splitlines() if line not in old]
        if differing or len(old) != len(text.splitlines()):
            raise RunFolderError(f"{run_dir} was run with another config, differing in {differing[:1]}")
        return
    if run_dir.exists() and (not run_dir.is_dir() or any(run_dir.iterdir())):
        if not overwrite:
            raise RunFolderError(f"{run_dir} already holds files; add --resume, --overwrite or another --run-dir")
        if not saved.is_file():
            raise RunFolderError(f"{run_dir} is not a run's folder (no config.yaml in it), so it is not overwritten")
        for name in {config.options.source, *config.options.experience} - {"", COLLECT}:
            if Path(name).resolve().is_relative_to(run_dir.resolve()):
                raise RunFolderError(f"{run_dir} holds what this run starts from, {name}, so it is not overwritten")
        shutil.rmtree(run_dir)
    run_dir.mkdir(parents=True, exist_ok=True)
    saved.write_text(text)


def _train(
    run: Run,
    stage: str,
    level: Level,
    *model: OptionModel,
    after: Callable[[int, Experience], None] | None = None,
    begin: tuple[PolicyParams, Statistics] | None = None,
) -> Trained:
    """Train one policy per seed and evaluate it before and after.

    Where it begins from another's policy, that explores afresh: the standard deviation is the config's.
    """
    state = jax.jit(jax.vmap(level.init))(run.stage_keys(stage), *model)
    if begin:
        params = begin[0].replace(log_std=state.params.log_std)
        state = state.replace(params=params, obs_statistics=begin[1])
    keys = run.stage_keys("evaluate")
    assess = run.compile(jax.vmap(level.assess), keys, state, *model)
    first = jax.device_get(assess(keys, state, *model))
    state = drive(
        run, stage, jax.vmap(level.step), state, *model,
        num_steps=level.num_steps, unit=level.unit, ticks=level.unit * len(keys), after=after,
    )  # fmt: skip
    last = jax.device_get(assess(keys, state, *model))
    run.logger.log("evaluate", level.ticks, {f"{stage}/{name}": x["return"] for name, x in last.items()})
    return Trained(jax.vmap(level.agent)(state, *model), first, last)


def _flat(run: Run, env: Env, ticks: int, length: int = 1) -> Level:
    executor = IdentityExecutor(env.action_size, length)
    return Level(env, run.config.collect.ppo, ticks, run.config.evaluate.episodes, lambda: executor)


def collect(run: Run, env: Env) -> Trained:
    """Train flat PPO, keep its trajectories as experience, and save the policy as the artifact `policy`."""
    level = _flat(run, env, run.config.collect.ticks)
    store = ExperienceStore(
        run.dir / EXPERIENCE, num_blocks(run.config.collect), describe(env) | {"seeds": len(run.keys)}
    )
    trained = _train(run, "collect", level, after=store.write)
    save_policy(run.dir / POLICY, trained.agent, env)
    return trained


def learn(run: Run, env: Env) -> OptionModel:
    """Learn one option model per seed from the experience and save it as the artifact `options`."""
    config, seeds = run.config.options, len(run.keys)
    names = config.experience or (COLLECT,)
    sources = [gather_experience(run.dir if name == COLLECT else Path(name), env, seeds) for name in names]
    dataset = jax.jit(jax.vmap(partial(make_dataset, config=config)))(sources)
    del sources
    if not dataset.count.all():
        raise ConfigError(
            f"options.length: expected the experience to hold windows of so many ticks, got none of {config.length} "
            f"in {', '.join(names)} between its shares {float(config.since):g} and {float(config.until):g}"
        )
    if holds_out(config) and not dataset.held_out.all():
        raise ConfigError(
            "options.delta_unit: quantile holds every tenth stretch of windows out, got none in those selected "
            f"in {', '.join(names)} between its shares {float(config.since):g} and {float(config.until):g}; "
            "error needs none"
        )
    networks = make_networks(config, env.proprioceptive_size, env.action_size)
    state = jax.jit(jax.vmap(partial(learning.init, config, networks)))(run.stage_keys("learn"))
    if config.steps:  # with none, D stays as random as it was drawn
        unit = max(n for n in range(1, STEPS_PER_LOG + 1) if config.steps % n == 0)
        steps = jax.vmap(partial(learning.steps, config, networks, unit))
        state = drive(run, "learn", steps, state, dataset, num_steps=config.steps // unit, unit=unit)
    model = learning.as_model(state, dataset)
    save_options(run.dir / OPTIONS, model, env, config)
    return model


def train_over_options(run: Run, env: Env, model: OptionModel) -> Trained:
    """Train the policy that acts by choosing options; a fine-tuned D is saved as the artifact `options_fine_tuned`."""
    config = run.config
    executor_of = partial(make_executor, config.options, env.action_size)
    level = Level(env, config.train.ppo, config.train.ticks, config.evaluate.episodes, executor_of)
    if not config.train.fine_tune.every:
        return _train(run, "train", level, model)
    level = FineTunedLevel(**vars(level), fine_tune=config.train.fine_tune)
    trained = _train(run, "train", level, model)
    executor: Any = trained.agent.executor
    save_options(run.dir / "options_fine_tuned", executor.model, env, config.options)
    return trained


def train_baseline(run: Run, env: Env, name: str, policy: tuple[PolicyParams, Statistics] | None = None) -> Trained:
    """Train flat PPO on the task, `transfer` from another run's policy: see `TrainConfig.baselines`."""
    config = run.config
    ticks = config.train.ticks + (config.collect.ticks if name == "total" else 0)
    level = _flat(run, env, ticks, config.options.length if name == "repeat" else 1)
    return _train(run, name, level, begin=policy if name == "transfer" else None)
