"""The main job: collect experience, learn options, train a policy over them, evaluate."""

import json
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from taic_jax.artifacts.experience import EXPERIENCE, ExperienceStore, gather_experience, num_blocks
from taic_jax.artifacts.models import OPTIONS, POLICY, describe, load_options, load_policy, save_options, save_policy
from taic_jax.config import (
    COLLECT,
    Config,
    ConfigError,
    OptionsConfig,
    Shard,
    collector_is_baseline,
    kept_ticks,
    needs_collect,
)
from taic_jax.envs.base import Env
from taic_jax.envs.errors import RenderingError
from taic_jax.networks import PolicyParams
from taic_jax.nonfinite import FINITE
from taic_jax.options import learning
from taic_jax.options.dataset import Dataset, Experience, holds_out, make_dataset
from taic_jax.options.execution import IdentityExecutor, make_executor
from taic_jax.options.model import Networks, OptionModel, make_networks
from taic_jax.rl.normalize import Statistics
from taic_jax.runtime.devices import make_devices
from taic_jax.runtime.driver import Run, drive
from taic_jax.runtime.files import save_text
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.summary import as_summary, write_video
from taic_jax.tasks import make_envs
from taic_jax.trainer import FineTuneTrainer, Trained, Trainer

STEPS_PER_LOG = 100


def run_pipeline(
    config: Config,
    run_dir: Path,
    *,
    points: Sequence[Config] = (),
    shard: Shard = "none",
    resume: bool = False,
    overwrite: bool = False,
    quiet: bool = False,
    **settings: Any,
) -> dict:
    """Run every stage that is not done yet and return the summary, also written to `summary.json`.

    Args:
      config: what to run, for `config.seeds` seeds.
      run_dir: its folder.
      points: variants [G] of `config` that differ from it in floats alone, to be run in its place, in one program;
        what is per seed is then of G K rows, one point after another.
      shard: what to split over all devices: these rows, or environments.
      resume: go on with the run in the folder.
      overwrite: replace it.
      quiet: show no progress on standard error.
      **settings: the `signals`, `checkpoint_seconds` and `population` of `Run`.

    Raises:
      Interrupted: a signal was received; resume goes on from where it came.
      RunFolderError: the folder holds another run, or none to resume, or another process is at it.
      ConfigError: the config does not fit the environment, or the devices.
      ArtifactError: another run does not hold what the config takes from it.
    """
    devices = make_devices(shard, config)
    env, source = make_envs(config)
    model, policy = take_over(config, env, source)  # what is refused is refused before anything is written
    model, policy = _for_points((model, policy), len(points or (config,)))
    with Run.open(
        config, run_dir, points=points, resume=resume, overwrite=overwrite, quiet=quiet, devices=devices, **settings
    ) as run:
        collector = collect(run, source) if needs_collect(config) else None
        model = learn(run, source) if model is None else model
        methods = {"taic": train_over_options(run, env, model)}
        for name in config.train.baselines:
            # Where experience comes from the task itself, the collector is the flat baseline.
            done = collector if name == "flat" and collector_is_baseline(config) else None
            methods[name] = done or train_baseline(run, env, name, policy)
    summary = as_summary(run, {name: {"first": x.first, "last": x.last} for name, x in methods.items()})
    save_text(run_dir / "summary.json", json.dumps(summary, indent=2) + "\n")
    try:
        write_video(run, env, methods["taic"].agent)
    except RenderingError as error:  # nothing else depends on it, and all results are saved
        print(f"taic_jax: no video: {error}", file=sys.stderr)
    return summary


def check_run(
    config: Config, run_dir: Path | None, *, resume: bool = False, overwrite: bool = False
) -> tuple[Env, Env]:
    """Check all that `run_pipeline` would refuse before it begins; return the task and the environment of `collect`.

    Raises:
      RunFolderError, ConfigError, ArtifactError: as `run_pipeline`.
    """
    env, source = make_envs(config)
    take_over(config, env, source)
    if run_dir:
        RunFolder(run_dir).check(config, resume=resume, overwrite=overwrite)
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


def _for_points(tree: Any, count: int) -> Any:
    """Repeat what is per seed for every point."""
    return tree if count == 1 else jax.tree.map(lambda x: jnp.concatenate([x] * count), tree)


def _train(
    run: Run,
    env: Env,
    stage: str,
    *model: OptionModel,
    after: Callable[[int, Experience], None] | None = None,
    begin: tuple[PolicyParams, Statistics] | None = None,
) -> Trained:
    """Train one policy per seed and evaluate it before and after.

    Where it begins from another's policy, that explores afresh: the standard deviation is the config's.
    """
    config, trainer = run.config, make_trainer(run.config, env, stage)
    init, agent = (over_rows(env, stage, name) for name in ("init", "agent"))
    state = jax.jit(init)(config, run.stage_keys(stage), *model)
    if begin:
        params = begin[0].replace(log_std=state.params.log_std)
        state = state.replace(params=params, obs_statistics=begin[1])
    place, given = run.devices.place, (config, run.stage_keys("evaluate"))
    compiled = run.compile(stage, over_rows(env, stage, "assess"), *place((*given, state, *model)))

    def assess(state: Any) -> dict:
        with run.logger.doing(f"{stage}: evaluating"):
            return jax.device_get(run.rows(compiled(*place((*given, state, *model)))))

    first = assess(state)
    step, population = step_over_rows(env, stage), run.population if stage == "train" else None
    if population:
        state, step = population.begin(state, config, run.stage_keys(stage)), population.evolving(step)
    state = drive(
        run, stage, step, state, config, *model,
        num_steps=trainer.num_steps, unit=trainer.unit, ticks=trainer.unit * len(run.keys), after=after,
    )  # fmt: skip
    state = state.state if population else state
    last = assess(state)
    stopped = run.stopped[stage].code != FINITE
    last = jax.tree.map(lambda x: np.where(stopped.reshape((-1,) + (1,) * (x.ndim - 1)), np.nan, x), last)
    run.logger.log("evaluate", trainer.ticks, {f"{stage}/{name}": x["return"] for name, x in last.items()})
    return Trained(agent(config, state, *model), first, last)


def over_rows(env: Env, stage: str, method: str) -> Callable[..., Any]:
    """Return a method of a stage's trainer as a function of rows: (configs, *its arguments)."""
    return jax.vmap(partial(_call, env, stage, method))


def step_over_rows(env: Env, stage: str) -> Callable[..., Any]:
    """Return a step of a stage's trainer as `drive` takes it: (states, configs, *models)."""
    step = over_rows(env, stage, "step")
    return lambda state, config, *model: step(config, state, *model)


def _call(env: Env, stage: str, method: str, config: Config, *args: Any) -> Any:
    return getattr(make_trainer(config, env, stage), method)(*args)


def make_trainer(config: Config, env: Env, stage: str) -> Trainer:
    """Return what a stage trains: a policy over options, or a flat one (see `TrainConfig.baselines`)."""
    episodes, tune = config.evaluate.episodes, config.train.fine_tune
    if stage == "train":
        executor_of = partial(make_executor, config.options, env.action_size)
        trainer = Trainer(env, config.train.ppo, config.train.ticks, episodes, executor_of)
        return FineTuneTrainer(**vars(trainer), fine_tune=tune) if tune.epochs else trainer
    ticks = {"collect": config.collect.ticks, "total": config.collect.ticks + config.train.ticks}
    executor = IdentityExecutor(env.action_size, config.options.length if stage == "repeat" else 1)
    return Trainer(env, config.collect.ppo, ticks.get(stage, config.train.ticks), episodes, lambda: executor)


def collect(run: Run, env: Env) -> Trained:
    """Train flat PPO, keep its trajectories as experience, and save the policy as the artifact `policy`."""
    config = run.config.collect
    if kept_ticks(config) < config.ticks:
        run.logger.say(f"collect: of {config.ticks:,} ticks the newest {kept_ticks(config):,} are kept")
    store = ExperienceStore(run.dir / EXPERIENCE, num_blocks(config), describe(env) | {"seeds": len(run.keys)})
    trained = _train(run, env, "collect", after=store.write)
    save_policy(run.dir / POLICY, trained.agent, env)
    return trained


def learn(run: Run, env: Env) -> OptionModel:
    """Learn one option model per seed from the experience and save it as the artifact `options`."""
    config, dataset = run.config.options, select_windows(run, env)
    init, steps = learn_over_rows(config, make_networks(config, env.proprioceptive_size, env.action_size))
    state = jax.jit(init)(config, run.stage_keys("learn"))
    if config.steps:  # with none, D stays as random as it was drawn
        unit = steps_per_log(config)
        state = drive(run, "learn", steps, state, config, dataset, num_steps=config.steps // unit, unit=unit)
    model = learning.as_model(state, dataset)
    save_options(run.dir / OPTIONS, model, env, config)
    return model


def learn_over_rows(config: OptionsConfig, networks: Networks) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Return stage learn's (configs, keys) -> states and (states, configs, datasets) -> (states, metrics, None)."""
    unit = steps_per_log(config) if config.steps else 0
    init = jax.vmap(lambda config, key: learning.init(config, networks, key))
    return init, jax.vmap(lambda state, config, dataset: learning.steps(config, networks, unit, state, dataset))


def steps_per_log(config: OptionsConfig) -> int:
    """Return how many gradient steps make one step of stage learn, so that whole ones make them all."""
    return max(n for n in range(1, STEPS_PER_LOG + 1) if config.steps % n == 0)


def select_windows(run: Run, env: Env) -> Dataset:
    """Return what each seed learns options from.

    Raises:
      ArtifactError: there is no experience, or it is of another body.
      ConfigError: it holds no window of the kind that the config asks for.
    """
    config, rows, seeds = run.config.options, len(run.keys), run.config.seeds
    names = config.experience or (COLLECT,)
    sources = [
        gather_experience(run.dir, env, rows)
        if name == COLLECT
        else _for_points(gather_experience(Path(name), env, seeds), rows // seeds)
        for name in names
    ]
    given = run.devices.place((sources, config))
    dataset = run.rows(run.compile("learn", jax.vmap(partial(make_dataset, views=env.views)), *given)(*given))
    span = f"in {', '.join(names)} between its shares {jnp.min(config.since):g} and {jnp.max(config.until):g}"
    if not dataset.count.all():
        raise ConfigError(
            "options.length: expected the experience to hold windows of so many ticks, "
            f"got none of {config.length} {span}"
        )
    if holds_out(config) and not dataset.held_out.all():
        raise ConfigError(
            "options.delta_unit: quantile holds every tenth stretch of windows out, got none in those selected "
            f"{span}; error needs none"
        )
    return dataset


def train_over_options(run: Run, env: Env, model: OptionModel) -> Trained:
    """Train the policy that acts by choosing options; a fine-tuned D is saved as the artifact `options_fine_tuned`."""
    config = run.config
    trained = _train(run, env, "train", model)
    if config.train.fine_tune.epochs:
        executor: Any = trained.agent.executor
        save_options(run.dir / "options_fine_tuned", executor.model, env, config.options)
    return trained


def train_baseline(run: Run, env: Env, name: str, policy: tuple[PolicyParams, Statistics] | None = None) -> Trained:
    """Train flat PPO on the task, `transfer` from another run's policy: see `TrainConfig.baselines`."""
    return _train(run, env, name, begin=policy if name == "transfer" else None)
