"""Atomic writes: a file has its name only once it is complete, and a failure is one line of error."""

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

PARTIAL = ".partial"  # ending of an incomplete file
DESCRIPTION = "description.json"  # describes the arrays beside it
TEMPORARY = ".orbax-checkpoint-tmp"  # Orbax writes a folder under this suffix, and renames it at the end


class SaveError(OSError):
    """A failure to write a file: the disk is full, or may not be written to."""


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an OSError in the context into a SaveError, one line that says why `path` cannot be written."""
    try:
        yield
    except SaveError:
        raise
    except OSError as error:
        raise SaveError(f"{path}: cannot be written: {error.strerror or error}") from error


def writes_here() -> bool:
    """Return whether this host writes the files of a run: of several hosts, the first does."""
    import jax  # the command lines answer without it

    return not jax.distributed.is_initialized() or jax.process_index() == 0


@contextlib.contextmanager
def atomic_file(path: Path) -> Iterator[BinaryIO]:
    """Yield a file that replaces `path` at the end of the context, or is removed and raises SaveError if that fails."""
    if not writes_here():
        yield io.BytesIO()  # goes nowhere
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
    """Write a text file atomically, or raise SaveError."""
    with atomic_file(path) as file:
        file.write(text.encode())


def save_json(path: Path, tree: Any) -> None:
    """Write a tree as indented JSON, atomically; raise SaveError, or ValueError for a number that is not finite."""
    save_text(path, json.dumps(tree, indent=2, allow_nan=False) + "\n")


def read_description(folder: Path) -> dict[str, Any] | None:
    """Read a folder's description: None without a JSON file, and {} if the file holds anything but an object."""
    try:
        description = json.loads((folder / DESCRIPTION).read_text())
    except (OSError, ValueError):
        return None
    return description if isinstance(description, dict) else {}


def save_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows with the same columns as CSV, atomically, or raise SaveError."""
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    save_text(path, text.getvalue())


def json_safe(tree: Any, digits: int | None = None) -> Any:
    """Return a tree of arrays and numbers in JSON's types, rounded to `digits`, if any, with None for NaN and inf."""
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
    """Check that `size` bytes can be written in a folder, or raise OSError."""
    partial = folder / f"room{PARTIAL}"
    try:
        partial.write_bytes(bytes(size))
    finally:
        partial.unlink(missing_ok=True)


def remove_partial(folder: Path) -> None:
    """Remove the incomplete files of killed processes anywhere in a folder, or raise SaveError."""
    with writing(folder):
        for path in [*folder.rglob(f"*{PARTIAL}"), *folder.rglob(f"*{TEMPORARY}")]:
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
