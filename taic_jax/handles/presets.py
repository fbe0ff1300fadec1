"""List the presets: `taic presets`."""

import csv
from collections.abc import Sequence
from importlib import resources

from taic_jax.command_line import tell
from taic_jax.config import ConfigError
from taic_jax.config.files import load_config, preset_names, preset_text


def main(args: Sequence[str]) -> int:
    """Print the table and return the exit code: 0, or 2 for any argument."""
    return tell(lambda: execute(args))


def execute(args: Sequence[str]) -> None:
    """Print each preset's name, task, purpose and time, as the benchmark's command `presets` measured it."""
    if args:
        raise ConfigError(f"taic presets: expected no arguments, got {' '.join(args)}")
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    text = (resources.files("taic_jax.experiments") / "results/presets.csv").read_text()
    minutes = {row["preset"]: f"about {row['minutes']}" for row in csv.DictReader(text.splitlines())}
    table = Table("preset", "task", "purpose", "minutes a seed on two cores, by --dry-run", box=SIMPLE)
    for name in preset_names():
        purpose = preset_text(name).splitlines()[0].removeprefix("# ").rstrip(".")
        table.add_row(name, load_config(name).env.name, purpose, minutes.get(name, ""))
    Console().print(table)
