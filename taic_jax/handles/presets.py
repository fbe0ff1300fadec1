"""List the presets: `taic presets`."""

import sys
from collections.abc import Sequence

from taic_jax.command_line import tell
from taic_jax.config import ConfigError
from taic_jax.config_io import load_config, preset_names, preset_text


def main(args: Sequence[str] | None = None) -> int:
    """Print the table and return the exit code: 0, or 2 for any argument."""
    return tell(lambda: execute(sys.argv[1:] if args is None else args))


def execute(args: Sequence[str]) -> None:
    """Print each preset's name, task and purpose."""
    if args:
        raise ConfigError(f"taic presets: expected no arguments, got {' '.join(args)}")
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    table = Table("preset", "task", "purpose", box=SIMPLE)
    for name in preset_names():
        purpose = preset_text(name).splitlines()[0].removeprefix("# ").rstrip(".")
        table.add_row(name, load_config(name).env.name, purpose)
    Console().print(table)
