"""The main job: collect experience, learn options, train a policy over them, evaluate."""

import dataclasses
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from taic_jax.checkpoint import save_tree
from taic_jax.config import Config, ConfigError, PPOConfig
from taic_jax.config_io import to_yaml
from taic_jax.envs import environment_options, make_env
from taic_jax.envs.base import Env
from taic_jax.envs.errors import RenderingError
from taic_jax.evaluate import evaluate
from taic_jax.experience import ExperienceStore, as_experience, num_blocks, read_experience
from taic_jax.logging import RunLogger
from taic_jax.options import learning
from taic_jax.options.dataset import Experience, make_dataset
from taic_jax.options.execution import Executor, IdentityExecutor, make_executor
from taic_jax.options.model import OptionModel, make_networks
from taic_jax.rl import ppo
from taic_jax.stage import CLOCK, Clock, Run, drive
from taic_jax.summary import as_summary, write_video
from taic_jax.types import as_arrays

STEPS_PER_LOG = 100


class RunFolderError(ValueError):
    """The run folder cannot be used as asked."""


@dataclass(frozen=True)
class Level:
    """Control of one task at one level, for one seed: the methods are vmapped over keys, states and models.

    `executor_of` takes the option model, or nothing where options are actions.
    """

    env: Env
    config: PPOConfig
    ticks: int
    episodes: int
    executor_of: Callable[..., Executor]

    @property
    def iterations(self) -> int:
        """How many iterations the budget buys."""
        return ppo.num_iterations(self.config, self.ticks)

    def init(self, key: Array, *model: OptionModel) -> ppo.TrainState:
        """Return the state of an untrained policy."""
        return ppo.init(self.config, self.env, self.executor_of(*model), key)

    def step(self, state: ppo.TrainState, *model: OptionModel) -> tuple[ppo.TrainState, dict, Experience]:
        """Run one iteration; return its metrics and its experience."""
        executor = self.executor_of(*model)
        state, metrics, rollout = ppo.iterate(self.config, self.env, executor, self.iterations, state)
        return state, metrics, as_experience(rollout, self.env.proprioceptive_size)

    def assess(self, key: Array, state: ppo.TrainState, *model: OptionModel) -> dict[str, dict[str, Array]]:
        """Evaluate the policy as it explores, and taking its mean options."""
        both = partial(evaluate, self.env, self.agent(state, *model), key, self.episodes)
        results = jax.vmap(both)(jnp.array([1.0, 0.0]))
        modes = ("return", "return_mean_option")
        return {mode: jax.tree.map(lambda x, i=i: x[i], results) for i, mode in enumerate(modes)}

    def agent(self, state: ppo.TrainState, *model: OptionModel) -> ppo.Agent:
        """Return what acts."""
        return ppo.as_agent(self.config, self.executor_of(*model), state)


class Trained(NamedTuple):
    """What training one policy per seed gives, leading axis K."""

    agent: ppo.Agent
    first: dict[str, dict[str, Array]]  # evaluation of the untrained policy
    last: dict[str, dict[str, Array]]


def run_pipeline(config: Config, run_dir: Path, *, resume: bool = False, overwrite: bool = False) -> dict:
    """Run every stage that is not done yet and return the summary, also written to `summary.json`.

    Raises:
      RunFolderError: the folder holds another run, or none where one is to be resumed.
      ConfigError: the config does not fit the environment.
    """
    env, source = make_envs(config)
    prepare_folder(config, run_dir, resume=resume, overwrite=overwrite)
    # Seed k of a run is seed 0 of a run whose seed is k more.
    keys = jnp.stack([jax.random.key(config.seed + k) for k in range(config.seeds)])
    with RunLogger(run_dir) as logger:
        run = Run(as_arrays(config), keys, run_dir, logger, Clock.load(run_dir / CLOCK))
        logger.truncate("evaluate", -1)
        collector = collect(run, source)
        model = learn(run, source)
        taic = train_over_options(run, env, model)
        # Where experience comes from the task itself, the collector is the flat baseline.
        flat = collector if source is env else train_flat(run, env) if config.train.flat else None
    methods = {"taic": taic, **({"flat": flat} if flat else {})}
    summary = as_summary(run, {name: {"first": x.first, "last": x.last} for name, x in methods.items()})
    (run_dir / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    try:
        write_video(run, env, taic.agent)
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
    bodies = [(e.proprioceptive_size, e.action_size) for e in (source, env)]
    if bodies[0] != bodies[1]:
        raise ConfigError(
            f"collect.env: expected the body of {config.env.name} (proprioceptive slice and action sizes "
            f"{bodies[1]}), got {config.collect.env} with {bodies[0]}"
        )
    if config.options.length > env.episode_length:
        raise ConfigError(
            f"options.length: expected at most the {env.episode_length} ticks of an episode of {env.name}, "
            f"got {config.options.length}; the nearest valid value is {env.episode_length}"
        )
    return env, source


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
        shutil.rmtree(run_dir)
    run_dir.mkdir(parents=True, exist_ok=True)
    saved.write_text(text)


def _train(
    run: Run, stage: str, level: Level, *model: OptionModel, after: Callable[[int, Experience], None] | None = None
) -> Trained:
    """Train one policy per seed and evaluate it before and after."""
    state = jax.jit(jax.vmap(level.init))(run.stage_keys(stage), *model)
    keys = run.stage_keys("evaluate")
    assess = run.compile(jax.vmap(level.assess), keys, state, *model)
    first = jax.device_get(assess(keys, state, *model))
    unit = level.config.num_envs * level.config.rollout_length
    state = drive(
        run, stage, jax.vmap(level.step), state, *model,
        num_steps=level.iterations, unit=unit, ticks=unit * len(keys), after=after,
    )  # fmt: skip
    last = jax.device_get(assess(keys, state, *model))
    run.logger.log("evaluate", level.ticks, {f"{stage}/{name}": x["return"] for name, x in last.items()})
    return Trained(jax.vmap(level.agent)(state, *model), first, last)


def _flat(run: Run, env: Env, ticks: int) -> Level:
    executor = IdentityExecutor(env.action_size)
    return Level(env, run.config.collect.ppo, ticks, run.config.evaluate.episodes, lambda: executor)


def collect(run: Run, env: Env) -> Trained:
    """Train flat PPO and keep its trajectories as experience."""
    level = _flat(run, env, run.config.collect.ticks)
    capacity = num_blocks(run.config.collect)
    sizes = {"proprioceptive_size": env.proprioceptive_size, "action_size": env.action_size}
    store = ExperienceStore(run.dir / "experience", capacity, {"env": env.name, **sizes, "seeds": len(run.keys)})
    return _train(run, "collect", level, after=store.write)


def learn(run: Run, env: Env) -> OptionModel:
    """Learn one option model per seed from the experience and save it as the artifact `options`."""
    config = run.config.options
    experience = [read_experience(run.dir / "experience", seed) for seed in range(len(run.keys))]
    experience = jax.tree.map(lambda *seeds: jnp.stack(seeds), *experience)
    dataset = jax.jit(jax.vmap(partial(make_dataset, config=config)))(experience)
    networks = make_networks(config, env.proprioceptive_size, env.action_size)
    num_envs = experience.obs.shape[2]
    del experience
    state = jax.jit(jax.vmap(partial(learning.init, config, networks)))(run.stage_keys("learn"))
    unit = max(n for n in range(1, STEPS_PER_LOG + 1) if config.steps % n == 0)
    steps = jax.vmap(partial(learning.steps, config, networks, num_envs, unit))
    state = drive(run, "learn", steps, state, dataset, num_steps=config.steps // unit, unit=unit)
    model = learning.as_model(state, dataset)
    save_tree(run.dir / "options", model)
    return model


def train_over_options(run: Run, env: Env, model: OptionModel) -> Trained:
    """Train the policy that acts by choosing options."""
    config = run.config
    executor_of = partial(make_executor, config.options, env.action_size)
    return _train(
        run, "train", Level(env, config.train.ppo, config.train.ticks, config.evaluate.episodes, executor_of), model
    )


def train_flat(run: Run, env: Env) -> Trained:
    """Train the flat baseline on the task itself."""
    return _train(run, "flat", _flat(run, env, run.config.train.ticks))
