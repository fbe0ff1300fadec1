"""Do the runs of the figures, and add a row of each to the table: see README.md of the experiments.

python -m taic_jax.experiments.evidence --list
python -m taic_jax.experiments.evidence --only nav2d

A run in the table is not done again, a finished one only adds its rows, and an interrupted one goes on from its last
checkpoint.
"""

import dataclasses
import sys
from collections.abc import Sequence, Set
from pathlib import Path
from typing import Any

import tyro

from taic_jax.command_line import tell
from taic_jax.config import Shard
from taic_jax.experiments.evidence.measures import example_space, measure_run_paths, measure_spaces
from taic_jax.experiments.evidence.plan import PATHS, SPACES, Cell, Key, all_cells
from taic_jax.experiments.evidence.steering import navigation_of
from taic_jax.experiments.evidence.table import TABLE, TableError, append_row, config_hash, read_table, row_of
from taic_jax.pipeline import collect, make_envs, run_pipeline, take_over, train_baseline
from taic_jax.runtime.devices import Devices, make_devices, open_devices
from taic_jax.runtime.driver import Run
from taic_jax.runtime.files import save_json
from taic_jax.runtime.program_cache import keep_programs
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.summary import as_summary


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Do the runs that are missing from the table."""

    only: tuple[str, ...] = ()
    """Do only the runs whose names start so, as in half_cheetah or half_cheetah/strong; empty does all."""
    list: bool = False  # List every run and its progress, and stop.
    table: Path = TABLE  # The table.
    run_dir: Path = Path("runs/evidence")  # Folder of the runs.


def sources(cell: Cell, run_dir: Path) -> set[str]:
    """Return the names of the runs that a run takes experience, options or policies from."""
    options = cell.config.options
    return {str(Path(name).relative_to(run_dir)) for name in (*options.experience, options.source) if name}


def plan(cells: Sequence[Cell], only: tuple[str, ...], present: Set[Key], run_dir: Path) -> list[Cell]:
    """Return the runs to do, after their unfinished sources and those of the sources; raise `TableError` if no run has
    such a name. A run without rows is done only as a source."""
    unknown = [text for text in only if not any(cell.name.startswith(text) for cell in cells)]
    if unknown:
        raise TableError(f"--only: expected the start of a run's name, got {unknown[0]}; --list shows them")
    names = {cell.name for cell in cells if cell.keys - present and (not only or cell.name.startswith(only))}
    for cell in reversed(cells):  # sources stand before the runs that use them
        if cell.name in names:
            names |= {name for name in sources(cell, run_dir) if not RunFolder(run_dir / name).finished}
    return [cell for cell in cells if cell.name in names]


def do(cell: Cell, run_dir: Path, shard: Shard = "none") -> None:
    """Begin, resume or check a run, with its seeds split over devices by `shard`."""
    folder = run_dir / cell.name
    run = RunFolder(folder)
    if run.finished:
        run.prepare(cell.config, resume=True)  # only checks that it is this run
    elif len(cell.stages) == 1 and not set(cell.stages.values()) & {"train", "options"}:
        run_flat(cell, folder, make_devices(shard, cell.config), run.begun)
    else:
        run_pipeline(cell.config, folder, resume=run.begun, shard=shard)


def make_row(cell: Cell, run_dir: Path, method: str, stage: str) -> dict[str, Any]:
    """Return the row of one method of a finished run, with the measures of option spaces on a robot."""
    folder = run_dir / cell.name
    if method == PATHS:
        row = row_of(folder, run_dir, PATHS, "train") | {"curves": {}, "grid": [], "ticks": 0}
        return row | measure_run_paths(folder)
    if cell.figure == "gate":
        row = row_of(folder, run_dir, method, "train") | {"curves": {}, "grid": [], "ticks": 0}
        return row | {"numbers": {name: list(values) for name, values in navigation_of(folder).items()}}
    row = row_of(folder, run_dir, method, stage)
    if cell.figure in ("6", "7") and stage == "train":
        row["numbers"] |= measure_spaces(folder)
        row |= {"example": example_space(folder)} if method in SPACES else {}
    return row


def run_flat(cell: Cell, folder: Path, devices: Devices, resume: bool) -> None:
    """Train flat PPO alone: `collect`, which saves its experience, or a baseline."""
    config, (stage,) = cell.config, cell.stages.values()
    env, source = make_envs(config)
    policy = take_over(config, env, source).flat
    with Run.open(config, folder, resume=resume, devices=devices) as run:
        trained = collect(run, source) if stage == "collect" else train_baseline(run, env, stage, policy)
    save_json(run.folder.summary_path, as_summary(run, {stage: trained}))


def show(cells: Sequence[Cell], rows: dict[Key, dict[str, Any]], arguments: Arguments) -> None:
    """Print every run: its figure, its interactions, and its progress."""
    for cell in cells:
        if arguments.only and not cell.name.startswith(arguments.only):
            continue
        folder, own = arguments.run_dir / cell.name, [rows[key] for key in cell.keys & rows.keys()]
        if cell.stages and len(own) == len(cell.keys):
            state = f"in the table, took {max(row['seconds'] for row in own) / 60:.0f} minutes"
            if {row["config"] for row in own} != {config_hash(cell.config, arguments.run_dir)}:
                state += ", is of another config: cut its rows to do it again"
        elif RunFolder(folder).finished:
            state = "finished, to be taken in" if cell.stages else "finished"
        elif folder.exists():
            state = "begun"
        else:
            state = "missing" if cell.stages else "made when another run needs it"
        ticks = cell.config.train.ticks if "collect" not in cell.stages.values() else cell.config.collect.ticks
        print(f"figure {cell.figure}  {cell.name:36} {cell.config.seeds:3} seeds x {ticks:9,} ticks  {state}")


def execute(arguments: Arguments) -> None:
    """List the runs, or do the missing ones."""
    cells = all_cells(arguments.run_dir)
    rows = {(row["task"], row["method"], row["seed"]): row for row in read_table(arguments.table)}
    planned = plan(cells, arguments.only, rows.keys(), arguments.run_dir)
    if arguments.list:
        show(cells, rows, arguments)
        print(f"{len(planned)} runs to do")
        return
    if not planned:
        print("nothing to do: the table has every row that these runs give")
        return
    keep_programs()
    shard = open_devices("auto", max(cell.config.seeds for cell in planned))
    for cell in planned:
        print(f"{cell.name}: {cell.config.seeds} seeds from {cell.config.seed}", flush=True)
        do(cell, arguments.run_dir, shard)
        for method, stage in cell.stages.items():
            if (cell.config.env.name, method, cell.config.seed) not in rows:
                append_row(arguments.table, make_row(cell, arguments.run_dir, method, stage))


def main(args: Sequence[str] | None = None) -> int:
    """List or do the runs, and return the exit code."""
    return tell(lambda: execute(tyro.cli(Arguments, args=args)))


if __name__ == "__main__":
    sys.exit(main())
