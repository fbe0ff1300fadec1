"""Files that appear under their name when they are whole, and not before, and one line of error where that fails."""

import contextlib
import csv
import io
import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

PARTIAL = ".partial"
"""Ending of a file that is not whole yet."""
DESCRIPTION = "description.json"
"""File beside arrays that says what they are."""
TEMPORARY = ".orbax-checkpoint-tmp"  # Orbax writes a folder under this suffix, and renames when all is written


class SaveError(OSError):
    """A file could not be written: the disk is full, or may not be written to."""


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Say in one line what keeps `path` from being written.

    Raises:
        SaveError: something does.
    """
    try:
        yield
    except SaveError:
        raise
    except OSError as error:
        raise SaveError(f"{path}: cannot be written: {error.strerror or error}") from error


def writes_here() -> bool:
    """Return whether this host writes what a run keeps: of several hosts of one run, the first does."""
    import jax  # the command lines answer without it

    return not jax.distributed.is_initialized() or jax.process_index() == 0


@contextlib.contextmanager
def whole_file(path: Path) -> Iterator[BinaryIO]:
    """Give a file to write, that takes the place of `path` once it is whole, and is removed if it does not get there.

    On a host that does not write, it goes nowhere.

    Raises:
        SaveError: it cannot be written.
    """
    if not writes_here():
        yield io.BytesIO()
        return
    partial = path.with_name(path.name + PARTIAL)
    with writing(path):
        try:
            with partial.open("wb") as file:
                yield file
            os.replace(partial, path)
        except BaseException:
            with contextlib.suppress(OSError):  # the first error is the one to report
                partial.unlink(missing_ok=True)
            raise


def save_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all, in place of what was there.

    Raises:
        SaveError: it cannot be written.
    """
    with whole_file(path) as file:
        file.write(text.encode())


def save_json(path: Path, tree: Any) -> None:
    """Write a tree as indented JSON, whole or not at all.

    Raises:
        SaveError: it cannot be written.
        ValueError: a number is not finite (see `json_safe`).
    """
    save_text(path, json.dumps(tree, indent=2, allow_nan=False) + "\n")


def save_description(folder: Path, description: Mapping[str, Any]) -> None:
    """Write what the arrays in a folder are.

    Raises:
        SaveError: it cannot be written.
    """
    save_json(folder / DESCRIPTION, description)


def read_description(folder: Path) -> dict[str, Any] | None:
    """Read what `save_description` wrote: None without a JSON file there, and {} where it holds something else."""
    try:
        description = json.loads((folder / DESCRIPTION).read_text())
    except (OSError, ValueError):
        return None
    return description if isinstance(description, dict) else {}


def save_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows with the same columns as CSV, whole or not at all.

    Raises:
        SaveError: it cannot be written.
    """
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    save_text(path, text.getvalue())


def json_safe(tree: Any, digits: int | None = None) -> Any:
    """Return a tree of mappings, sequences, arrays and numbers as JSON has them.

    Args:
        tree: of any depth; what is not finite becomes None.
        digits: significant digits that floats are rounded to; None keeps them all.
    """
    if isinstance(tree, Mapping):
        return {name: json_safe(item, digits) for name, item in tree.items()}
    if hasattr(tree, "tolist"):  # an array, or one of its numbers
        tree = tree.tolist()
    if isinstance(tree, list | tuple):
        return [json_safe(item, digits) for item in tree]
    if isinstance(tree, float):
        return None if not math.isfinite(tree) else tree if digits is None else float(f"{tree:.{digits}g}")
    return tree


def make_room(folder: Path, size: int) -> None:
    """Check that so many bytes can be written in a folder.

    Raises:
        OSError: they cannot.
    """
    partial = folder / f"room{PARTIAL}"
    try:
        partial.write_bytes(bytes(size))
    finally:
        partial.unlink(missing_ok=True)


def remove_partial(folder: Path) -> None:
    """Remove what processes that were killed while they wrote have left anywhere in a folder.

    Raises:
        SaveError: something cannot be removed.
    """
    with writing(folder):
        for path in [*folder.rglob(f"*{PARTIAL}"), *folder.rglob(f"*{TEMPORARY}")]:
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
