"""The frame of the benchmark's commands: arguments, tables on the terminal, and figures in a JSON file."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import tyro

from taic_jax.command_line import tell
from taic_jax.config import ConfigError
from taic_jax.runtime.files import json_safe, save_json
from taic_jax.runtime.program_cache import keep_programs

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Command:
    """The arguments of every command."""

    json: Path | None = None  # Also write the figures to this file.


C = TypeVar("C", bound=Command)


def answer(kind: type[C], measure: Callable[[C], Any], args: Sequence[str] | None = None) -> int:
    """Parse the arguments, measure, write the figures, and return the exit code, 2 for a mistake of the user."""
    arguments = tyro.cli(kind, args=args)

    def execute() -> None:
        if arguments.json and not arguments.json.parent.is_dir():
            raise ConfigError(f"--json: there is no folder {arguments.json.parent}")
        keep_programs()
        figures = measure(arguments)
        if arguments.json:
            save_json(arguments.json, json_safe(figures))

    return tell(execute)


def show(rows: Iterable[Row]) -> list[Row]:
    """Print each row as it comes, under its names if they differ from those of the row before, and return all."""
    shown: list[Row] = []
    for row in rows:
        if not shown or list(row) != list(shown[-1]):
            _print(row, row)
        _print(row, row.values())
        shown.append(row)
    return shown


def _print(names: Iterable[str], cells: Iterable[Any]) -> None:
    """Print cells right-aligned in columns as wide as their names, the first one left-aligned."""
    texts = [_text(cell).rjust(max(len(name), 9)) for name, cell in zip(names, cells, strict=True)]
    print("  ".join([f"{texts[0].strip():32}", *texts[1:]]).rstrip(), flush=True)


def _text(cell: Any) -> str:
    if not isinstance(cell, float):
        return "" if cell is None else str(cell)
    return f"{cell:,.0f}" if abs(cell) >= 1000 else f"{cell:.3g}"
