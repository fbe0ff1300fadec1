"""The main job: collect experience, learn options, train a policy over them, evaluate."""

import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from taic_jax import trainer
from taic_jax.artifacts.agents import Weights, save_agents
from taic_jax.artifacts.experience import EXPERIENCE, ExperienceStore, gather_experience, num_blocks
from taic_jax.artifacts.models import AGENTS, OPTIONS, Body, describe, save_options
from taic_jax.config import (
    COLLECT,
    PRACTISE,
    TAIC,
    Config,
    ConfigError,
    OptionsConfig,
    Shard,
    collector_is_baseline,
    impossible,
    needs_collect,
)
from taic_jax.envs.base import Env
from taic_jax.envs.errors import RenderingError
from taic_jax.nonfinite import without_stopped
from taic_jax.options import learning
from taic_jax.options.dataset import Dataset, Experience, holds_out, make_dataset
from taic_jax.options.frame import make_frame
from taic_jax.options.model import OptionModel
from taic_jax.rl.agent import Agent
from taic_jax.rl.practise import decoder_of
from taic_jax.runtime.devices import make_devices
from taic_jax.runtime.driver import Run, drive
from taic_jax.runtime.files import save_json
from taic_jax.runtime.run_folder import RunFolder, Summary
from taic_jax.sources import check_memory, make_envs, take_over
from taic_jax.summary import as_summary, write_video
from taic_jax.trainer import Trained
from taic_jax.types import Seeds


class Result(NamedTuple):
    """The results of a run: its summary, and the agents of every method by seed (of each point)."""

    summary: Summary
    agents: dict[str, Seeds[Agent]]


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
) -> Result:
    """Run every stage that is not done yet; return and write the summary and the agents of every method.

    Args:
      config: the experiment, for `config.seeds` seeds.
      run_dir: the run's folder; `resume` continues the run in it, `overwrite` replaces it.
      points: variants [G] of `config` that differ from it in floats alone and replace it, in one program of G K rows,
        one point after another.
      shard: the axis to split over all devices: rows, or environments.
      quiet: show no progress on standard error.
      **settings: the `signals`, `checkpoint_seconds`, `population` and `most` of `Run`.

    Raises:
      Interrupted: a signal stopped the run; `resume` continues it.
      RunFolderError: the folder holds another run, or none to resume, or another process uses it.
      ConfigError: the config does not fit the environment, or the devices.
      ArtifactError: another run lacks a part that the config takes from it.
    """
    devices = make_devices(shard, config)
    env, source = make_envs(config)
    inherited = take_over(config, env, source)  # refuses before anything is written
    check_memory(config, env, source)
    model, flat, policy = _for_points(inherited, len(points or (config,)))
    with Run.open(
        config, run_dir, points=points, resume=resume, overwrite=overwrite, quiet=quiet, devices=devices, **settings
    ) as run:
        collector = collect(run, source) if needs_collect(config) else None
        model = learn(run, source) if model is None else model
        model = practise(run, source, model) if config.practise.ticks else model
        methods = {TAIC: train_over_options(run, env, model, policy)}
        for name in config.train.baselines:
            # If experience comes from the task itself, the collector is the flat baseline.
            done = collector if name == "flat" and collector_is_baseline(config) else None
            methods[name] = done or train_baseline(run, env, name, flat)
        for name, trained in methods.items():
            save_agents(run.folder.path / AGENTS / name, trained.agent, env, run.folder.config(), name)
        summary = as_summary(run, {} if run.most else methods)
        save_json(run.folder.summary_path, summary)
        try:
            write_video(run, env, methods[TAIC].agent)
        except RenderingError as error:  # nothing else depends on it, and all results are saved
            print(f"taic_jax: no video: {error}", file=sys.stderr)
    return Result(summary, {name: Seeds(trained.agent) for name, trained in methods.items()})


def check_run(
    config: Config, run_dir: Path | None, *, resume: bool = False, overwrite: bool = False
) -> tuple[Env, Env]:
    """Check all that `run_pipeline` would refuse before it begins; return the task and the environment of `collect`.

    Raises:
      RunFolderError, ConfigError, ArtifactError: as `run_pipeline`.
    """
    env, source = make_envs(config)
    take_over(config, env, source)
    check_memory(config, env, source)
    if run_dir:
        RunFolder(run_dir).check(config, resume=resume, overwrite=overwrite)
    return env, source


def _for_points(tree: Any, count: int) -> Any:
    """Repeat a tree over seeds for every point."""
    return tree if count == 1 else jax.tree.map(lambda x: jnp.concatenate([x] * count), tree)


def _train(
    run: Run,
    env: Env,
    stage: str,
    model: OptionModel | None = None,
    *,
    after: Callable[[int, Experience], None] | None = None,
    begin: Weights | None = None,
) -> Trained:
    """Train one policy per seed, from untrained weights or from these, and evaluate it before and after."""
    make, rows, keys = partial(trainer.make_trainer, stage, env), (run.config, model), run.stage_keys(stage)
    one = make(*rows)
    state = jax.jit(partial(trainer.init_rows, make))(rows, keys)
    state = one.begin(state, *begin) if begin else state
    args = rows, run.stage_keys("evaluate"), state
    compiled = None if run.most else _compile_rows(run, stage, partial(trainer.assess_rows, make), *args)

    def assess(state: Any) -> dict:
        if compiled is None:
            return {}
        with run.logger.doing(f"{stage}: evaluating"):
            return jax.device_get(compiled(rows, run.stage_keys("evaluate"), state))

    first = assess(state)
    step, population = partial(trainer.step_rows, make), run.population if stage == "train" else None
    if population:
        state, step = population.begin(state, run.config, keys), population.evolving(step)
    state = drive(
        run, stage, step, state, rows,
        num_steps=one.num_steps, unit=one.unit, ticks=one.unit * len(keys), after=after,
    )  # fmt: skip
    state = state.state if population else state
    last = without_stopped(assess(state), jnp.asarray(run.stopped[stage].code))
    run.logger.log("evaluate", one.ticks, {f"{stage}/{name}": x["return"] for name, x in last.items()})
    return Trained(trainer.agents_of_rows(make, rows, state), first, last)


def _compile_rows(run: Run, stage: str, function: Callable[..., Any], *args: Any) -> Callable[..., Any]:
    """Return a compiled function of rows that places its arguments and returns the run's own rows."""
    compiled = run.compile(stage, function, *run.devices.place(args))
    return lambda *args: run.rows(compiled(*run.devices.place(args)))


def collect(run: Run, env: Env) -> Trained:
    """Train flat PPO, save its ticks as experience, and the policies as the artifact `agents/collect`."""
    config = run.config.collect
    if 0 < config.capacity < config.ticks:
        run.logger.say(f"collect: of {config.ticks:,} ticks the newest {config.capacity:,} are kept")
    store = ExperienceStore(run.folder.path / EXPERIENCE, num_blocks(config), describe(env) | {"seeds": len(run.keys)})
    trained = _train(run, env, "collect", after=store.write)
    save_agents(run.folder.path / AGENTS / COLLECT, trained.agent, env, run.folder.config(), COLLECT)
    return trained


def learn(run: Run, env: Env | Body, dataset: Dataset | None = None) -> OptionModel:
    """Learn one option model per seed, by default from the experience, and save it as the artifact `options`."""
    config, dataset = run.config.options, select_windows(run, env) if dataset is None else dataset
    state = jax.jit(partial(trainer.init_learning, env))(config, run.stage_keys("learn"))
    if config.steps:  # without steps D stays random
        step, unit = trainer.learn_rows, trainer.steps_per_log(config)
        state = drive(run, "learn", step, state, config, dataset, num_steps=config.steps // unit, unit=unit)
    model = learning.as_model(state, dataset)
    if config.codes:
        book = _compile_rows(run, "learn", trainer.books_of_rows, config, state, dataset)(config, state, dataset)
        model = model.replace(book=book)
    if config.choose == "way":
        model = model.replace(views=jax.tree.map(lambda x: jnp.broadcast_to(x, (len(run.keys), *x.shape)), env.views))
    save_options(run.folder.path / OPTIONS, model, env, config)
    return model


def practise(run: Run, env: Env, model: OptionModel) -> OptionModel:
    """Refine D of every seed's model, refit the other networks to it, and save the models in place of the learnt."""
    params: Any = _train(run, env, PRACTISE, model).agent.params
    model = model.with_decoder(jax.vmap(decoder_of)(params.actor, model.params["decoder"]))
    args = run.config, model, run.stage_keys(PRACTISE)
    model, _ = _compile_rows(run, PRACTISE, partial(trainer.refit_rows, env), *args)(*args)
    save_options(run.folder.path / OPTIONS, model, env, run.config.options)
    return model


def select_windows(run: Run, env: Env | Body) -> Dataset:
    """Return the windows that each seed learns options from.

    Raises:
      ArtifactError: there is no experience, or it is of another body.
      ConfigError: it holds no window that fits the config.
    """
    config, rows, seeds = run.config.options, len(run.keys), run.config.seeds
    names = config.experience or (COLLECT,)
    sources = [
        gather_experience(run.folder.path, env, rows)
        if name == COLLECT
        else _for_points(gather_experience(Path(name), env, seeds, config, run.logger.say), rows // seeds)
        for name in names
    ]
    select = windows_of(env, config)
    return checked(_compile_rows(run, "learn", select, sources, config)(sources, config), config)


def windows_of(env: Env | Body, config: OptionsConfig) -> Callable[..., Dataset]:
    """Return the function that selects the windows [K] of experiences [K] by configs [K]."""
    return jax.vmap(partial(make_dataset, views=env.views, frame=make_frame(config, env.heading)))


def checked(dataset: Dataset, config: OptionsConfig) -> Dataset:
    """Return a dataset [K] that has the windows that the configs [K] need, or raise ConfigError."""
    names = config.experience or (COLLECT,)
    span = f"in {', '.join(names)} between its shares {jnp.min(config.since):g} and {jnp.max(config.until):g}"
    if config.codes and (fewest := int(dataset.count.min())) < config.codes:
        raise impossible("options.codes", config.codes, f"at most the {fewest} windows {span}", fewest)
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


def train_over_options(run: Run, env: Env, model: OptionModel, policy: Weights | None = None) -> Trained:
    """Train the policy that acts by choosing options, from untrained weights or from these."""
    return _train(run, env, "train", model, begin=policy)


def train_baseline(run: Run, env: Env, name: str, policy: Weights | None = None) -> Trained:
    """Train flat PPO on the task, `transfer` from another run's policy: see `TrainConfig.baselines`."""
    return _train(run, env, name, begin=policy if name == "transfer" else None)
