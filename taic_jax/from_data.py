"""Options from recorded data alone, without a simulator: `taic learn DATA...`; see docs/skills_from_your_logs.md."""

import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from taic_jax import command_line
from taic_jax.command_line import attempt, tell, typed
from taic_jax.config import Config, ConfigError, EnvConfig, OptionsConfig, TrainConfig, impossible
from taic_jax.config.checks import validate
from taic_jax.runtime.signals import Signals

if TYPE_CHECKING:  # they import JAX, without which the command lines answer
    from taic_jax.data.read import Recording
    from taic_jax.runtime.run_folder import Summary

PROGRAM = "taic learn"


@dataclass(frozen=True)
class Command:
    """Learn options from recorded data alone: no task, no simulator. Writes a run with one option model per seed."""

    data: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="DATA")] = ()
    """Files or folders of recorded episodes, all of one body; see docs/skills_from_your_logs.md."""
    run_dir: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of the run; by default runs/DATA-DATE-TIME."""
    seeds: int = 1
    """Independent repeats, learnt side by side in one program."""
    seed: int = 0
    """Seed of the PRNG key, the source of all randomness."""
    observations: tuple[str, ...] = ()
    """Arrays that are joined to observations; empty takes those usual in the format."""
    actions: str = ""
    """Array of the actions; empty takes the usual one."""
    action_bounds: tuple[float, ...] = ()
    """Bounds of the actions, which become -1 and 1: low and high, or one low an entry and then one high."""
    action_scale: Literal["bounds", "quantiles"] = "bounds"
    """Scale of the actions: the stated bounds, or the quantiles 0.01 and 0.99 of each entry."""
    resume: tyro.conf.FlagCreatePairsOff[bool] = False
    """Continue the run in --run-dir from its last checkpoint; repeat the other arguments."""
    overwrite: tyro.conf.FlagCreatePairsOff[bool] = False
    """Replace the run in --run-dir."""
    quiet: tyro.conf.FlagCreatePairsOff[bool] = False
    """Show neither progress nor the table at the end, only the path of the results."""
    checkpoint_seconds: float = 30.0
    """Least seconds between two checkpoints, more if they are large; 0 writes one at each log line."""
    options: Annotated[OptionsConfig, tyro.conf.FlagConversionOff] = OptionsConfig(select="random")


def main(args: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code, as `taic run` does: 2 for a mistake or data that do not fit."""
    return tell(lambda: execute(typed(sys.argv[1:] if args is None else args, PROGRAM, Command)))


def execute(command: Command) -> int:
    """Learn, print the measures, and return the exit code."""
    from rich.console import Console

    from taic_jax.runtime.devices import open_devices
    from taic_jax.runtime.program_cache import keep_programs
    from taic_jax.runtime.run_folder import RunFolder

    config = config_of(command)
    run_dir = command_line.Command(command.data[0], command.run_dir).folder
    keep_programs()
    shard = open_devices("auto", config.seeds)

    def work(signals: Signals) -> None:
        summary = learn_from_data(
            config, run_dir, quantiles=command.action_scale == "quantiles", shard=shard, resume=command.resume,
            overwrite=command.overwrite, quiet=command.quiet, signals=signals,
            checkpoint_seconds=command.checkpoint_seconds,
        )  # fmt: skip
        if not command.quiet:
            Console().print(as_table(summary))
        print(RunFolder(run_dir).summary_path)

    return attempt(work, run_dir)


def config_of(command: Command) -> Config:
    """Return the config of the run, or raise ConfigError."""
    if not command.data:
        raise ConfigError("DATA: expected at least one file or folder of recorded episodes, got none")
    if command.resume and (command.overwrite or command.run_dir is None):
        raise ConfigError("--resume: expected the folder of the run to continue, as in --run-dir DIR, not --overwrite")
    if command.options.experience:
        raise impossible("--options.experience", command.options.experience, "none, since DATA is the experience")
    if command.action_bounds and command.action_scale == "quantiles":
        raise impossible("--action-bounds", command.action_bounds, "none with --action-scale quantiles")
    short = {"observations": command.observations, "actions": command.actions, "action_bounds": command.action_bounds}
    given: dict[str, Any] = {name: value for name, value in short.items() if value}
    options = dataclasses.replace(command.options, experience=command.data, **given)
    train = TrainConfig(baselines=())
    config = Config(EnvConfig("data"), options=options, train=train, seed=command.seed, seeds=command.seeds)
    validate(config)
    return config


def learn_from_data(
    config: Config, run_dir: Path, *, quantiles: bool = False, shard: Any = "none", quiet: bool = False, **settings: Any
) -> "Summary":
    """Learn options of `config.seeds` seeds from `config.options.experience`; return and write the summary.

    `quantiles` takes the bounds of the actions from the data. Other arguments are those of `run_pipeline`, whose errors
    it raises; it writes nothing before the data are checked.
    """
    import jax

    from taic_jax.artifacts.experience import of_every_seed
    from taic_jax.artifacts.models import DATA, Body
    from taic_jax.pipeline import checked, learn, windows_of
    from taic_jax.runtime.devices import make_devices
    from taic_jax.runtime.driver import Run
    from taic_jax.runtime.files import save_json
    from taic_jax.sources import check_sides
    from taic_jax.types import as_rows

    config, recordings = read_all(config, quantiles)
    options, sizes = config.options, recordings[0].sizes
    body = Body(DATA, DATA, *sizes, action_bounds=options.action_bounds)
    check_sides(config, body)
    columns, rows = [of_every_seed(x, options, config.seeds) for x in recordings], as_rows([config], config.seeds)
    dataset = checked(jax.jit(windows_of(body, options))(columns, rows.options), rows.options)
    with Run.open(config, run_dir, quiet=quiet, devices=make_devices(shard, config), **settings) as run:
        for recording in recordings:
            run.logger.say(recording.summary)
        selected, steps = int(dataset.count[0]), len(dataset.starts[0])
        run.logger.say(f"learn: {selected:,} windows of {options.length} ticks begin in {selected / steps:.1%} of them")
        models = learn(run, body, dataset)
        summary = summarize_models(run, models, dataset)
        save_json(run.folder.summary_path, summary)
    return summary


def read_all(config: Config, quantiles: bool) -> tuple[Config, list["Recording"]]:
    """Return the config with the bounds of actions, and the data in their scale, or raise ArtifactError."""
    from taic_jax.data.read import quantile_bounds, read_recording
    from taic_jax.runtime.checkpoint import ArtifactError

    options = config.options
    recordings = [read_recording(Path(name), options.observations, options.actions) for name in options.experience]
    for recording in recordings:
        if recording.sizes != recordings[0].sizes:
            expected, got = ("{} observations and {} actions".format(*x.sizes) for x in (recordings[0], recording))
            raise ArtifactError(f"{recording.path}: expected {expected}, as {recordings[0].path} has; got {got}")
    bounds = quantile_bounds(recordings) if quantiles else options.action_bounds
    config = dataclasses.replace(config, options=dataclasses.replace(options, action_bounds=bounds))
    return config, [recording.scaled(bounds) for recording in recordings]


def summarize_models(run: Any, models: Any, dataset: Any) -> "Summary":
    """Return the contents of summary.json: measures of the options over seeds, and what each run's has."""
    import jax

    from taic_jax.analysis.option_space import measure_windows
    from taic_jax.analysis.statistics import summarize
    from taic_jax.summary import as_summary

    measured, keys = [], run.stage_keys("evaluate")
    with run.logger.doing("learn: measuring"):
        for seed, key in enumerate(keys):
            options, model, data = jax.tree.map(lambda x, k=seed: x[k], (run.config.options, models, dataset))
            measured.append(measure_windows(options, model, data, key))
    return {
        **as_summary(run, {}),
        "options": {name: summarize([values[name] for values in measured]) for name in measured[0]},
    }


def as_table(summary: "Summary") -> Any:
    """Return a table of the measures of the options: interquartile means over seeds, and their 95 % intervals."""
    from rich.box import SIMPLE
    from rich.table import Table

    table = Table("measure", "interquartile mean", "95 % interval", box=SIMPLE, title="options", title_justify="left")
    for name, statistics in summary.get("options", {}).items():
        numbers = statistics["iqm"], *(statistics["ci95"] or ())
        iqm, *interval = [f"{x:.3g}" for x in numbers if x is not None] or ["not finite"]
        table.add_row(name, iqm, " … ".join(interval))
    return table


if __name__ == "__main__":
    sys.exit(main())
