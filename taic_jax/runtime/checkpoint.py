"""Trees of arrays on disk: artifacts of a stage and checkpoints of a run, through Orbax.

A tree is stored flat, one array under each leaf's dotted name. So what is on disk can be compared with what
is asked for before anything is read, and anyone can read it: Orbax's `load(path)` gives a dict. Checkpoints, which
are many, hold the bytes of all leaves as one array instead, as Orbax's time is spent per array; their names, dtypes
and shapes are told in its metadata, and so are checksums, and the version of this package.
"""

import contextlib
import logging
import os
import re
import shutil
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import jax
import numpy as np
from orbax.checkpoint import v1 as ocp

from taic_jax.runtime.files import PARTIAL, TEMPORARY, SaveError, make_room, writes_here, writing
from taic_jax.runtime.flat_tree import Spec, by_name, checksum, from_plain, pack, plain, plain_spec, unpack
from taic_jax.runtime.hosts import agree

Tree = TypeVar("Tree")

VERSION, CHECKSUMS, LAYOUT = "taic_jax", "crc32", "layout"  # keys of what is told beside the arrays
PACKED = "bytes"  # the one array of a checkpoint

# Orbax's threads also log what it raises, in hundreds of lines.
logging.getLogger("absl").addFilter(lambda record: "orbax" not in Path(record.pathname).parts)


class ArtifactError(ValueError):
    """Something on disk is not the tree of arrays that was asked for."""


def save_tree(path: Path, tree: Any) -> None:
    """Write a tree of arrays to the folder `path`, whole or not at all, in place of what was there.

    Raises:
        SaveError: it cannot be written; what was there still is.
    """
    path = path.absolute()
    partial = path.with_name(path.name + PARTIAL)  # Orbax would remove what is there before it writes
    with _saving(path, partial):
        _begin(partial, plain(tree), {})()
        if writes_here():
            if path.exists():
                shutil.rmtree(path)
            partial.rename(path)
    agree([0])  # no host goes on before it is there


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read what `save_tree` or `Checkpoints` wrote, by dotted name, without arrays that have no entries.

    Raises:
        ArtifactError: nothing is there, or something else, or it is damaged.
    """
    return _read(path, _describe(path)[1])


def load_tree(path: Path, like: Tree) -> Tree:
    """Read a tree of arrays with the structure, shapes and dtypes of `like`, and onto its devices.

    Args:
        path: the folder that `save_tree` or `Checkpoints` wrote.
        like: arrays or `jax.ShapeDtypeStruct`s.

    Raises:
        ArtifactError: nothing is there, or it is not a tree like this one, or it is damaged.
    """
    named = by_name(like)
    stored, told = _describe(path)
    expected = {name: plain_spec(leaf) for name, leaf in named.items() if leaf.size}
    for name in {**expected, **stored}:
        want, got = expected.get(name), stored.get(name)
        if want != got:
            writer = told.get(VERSION, _version())
            by = "" if writer == _version() else f"; taic_jax {writer} wrote it, this is {_version()}"
            raise ArtifactError(f"{path}: expected {_show(want)} at {name or 'the root'}, got {_show(got)}{by}")
    arrays = _read(path, told)
    leaves = [from_plain(arrays.get(name), leaf) for name, leaf in named.items()]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


class Checkpoints:
    """The last few checkpoints of a run, each a folder named by its step, written while the run goes on.

    Args:
        directory: the folder that holds them.
        keep: how many of the latest to keep; older ones, which a killed run may have left, are removed.

    Raises:
        SaveError: they cannot be removed.
    """

    def __init__(self, directory: Path, keep: int = 2):
        self.directory, self.keep = directory.absolute(), keep
        self._pending: tuple[Path, Callable[[], None]] | None = None
        self._drop()

    def steps(self) -> list[int]:
        """List the steps that can be loaded, earliest first."""
        return sorted(int(path.name) for path in self.directory.glob("*") if path.name.isdigit())

    def latest_step(self) -> int | None:
        """Return the last step saved, or None."""
        return max(self.steps(), default=None)

    def save(self, step: int, tree: Any) -> None:
        """Begin to save a tree of arrays as this step, whole or not at all, once the step before is saved.

        The arrays are read here, so they may be donated afterwards.

        Raises:
            SaveError: this step or the one before cannot be written; those that were saved are still there.
        """
        self.wait()
        path = self.directory / str(step)
        packed, layout = pack(plain(tree))
        options = ocp.options.ArrayOptions(saving=ocp.options.ArrayOptions.Saving(use_ocdbt=False))  # for many arrays
        with _saving(path, path), ocp.Context(array_options=options):
            self._pending = path, _begin(path, {PACKED: packed}, {LAYOUT: layout})

    def wait(self) -> None:
        """Wait until the step is saved that is being saved, if one is, and drop the oldest steps.

        Raises:
            SaveError: it cannot be written; those before it are still there.
        """
        if self._pending is None:
            return
        (path, finish), self._pending = self._pending, None
        with _saving(path, path):
            finish()
        self._drop()

    @contextlib.contextmanager
    def waited_for(self) -> Iterator[None]:
        """End the context, however it ends, with nothing being saved any more.

        Raises:
            SaveError: the last step cannot be written; what ends the context is told first.
        """
        try:
            yield
        except SaveError:
            with contextlib.suppress(SaveError):
                self.wait()
            raise
        except BaseException:
            self.wait()
            raise
        self.wait()

    def _drop(self) -> None:
        if not writes_here():
            return
        with writing(self.directory):
            for old in self.steps()[: -self.keep]:
                shutil.rmtree(self.directory / str(old))

    def load(self, step: int, like: Tree) -> Tree:
        """Load the tree of this step.

        Raises:
            ArtifactError: see `load_tree`; the message tells what is left without this step.
        """
        path = self.directory / str(step)
        try:
            return load_tree(path, like)
        except ArtifactError as error:
            before = [earlier for earlier in self.steps() if earlier < step]
            left = f"from {self.directory / str(before[-1])}" if before else "from the start of the stage"
            raise ArtifactError(f"{error}; without {path} --resume goes on {left}") from None


def _begin(path: Path, arrays: dict[str, np.ndarray], told: dict[str, Any]) -> Callable[[], None]:
    """Begin to write arrays to the folder `path`, with what else is told of them; return what waits for the end."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if writes_here():
        make_room(path.parent, sum(array.nbytes for array in arrays.values()) + len(arrays) * 2**10 + 2**14)
    sums = {name: checksum(array) for name, array in arrays.items()}
    told = {VERSION: _version(), CHECKSUMS: sums, **told}
    return ocp.save_async(str(path), arrays, overwrite=True, custom_metadata=told).result


@contextlib.contextmanager
def _saving(path: Path, written: Path) -> Iterator[None]:
    """Tell in one line why `path` cannot be saved, and remove what there is by then of the folder that is written."""
    try:
        with writing(path):
            yield
    except (ValueError, SaveError) as error:
        shutil.rmtree(f"{written}{TEMPORARY}", ignore_errors=True)
        code = re.search(r"os_error_code='(\d+)'", str(error))  # TensorStore's
        if code is None:
            raise
        raise SaveError(f"{path}: cannot be written: {os.strerror(int(code[1]))}") from error


def _describe(path: Path) -> tuple[dict[str, Spec], dict[str, Any]]:
    """Return the shapes and dtypes of the arrays in a folder by dotted name, and what else is told of them."""
    if not path.exists():
        raise ArtifactError(f"{path}: expected an artifact, got nothing")
    with _errors_in_one_line(path):
        found = ocp.metadata(str(path.absolute()))
        told: Any = found.custom_metadata or {}
        if LAYOUT in told:
            return {name: (tuple(shape), np.dtype(dtype)) for name, dtype, shape in told[LAYOUT]}, told
        return {name: (meta.shape, meta.dtype) for name, meta in found.metadata.items()}, told


def _read(path: Path, told: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the arrays in a folder by dotted name, given what is told of them."""
    with _errors_in_one_line(path):
        specs = ocp.metadata(str(path.absolute())).metadata
        empty = {name: np.empty(meta.shape, meta.dtype) for name, meta in specs.items()}
        arrays = ocp.load(str(path.absolute()), empty)
        sums = {name: checksum(array) for name, array in arrays.items()}
        if sums != told.get(CHECKSUMS, sums):  # earlier versions told none
            raise ValueError
        return unpack(arrays[PACKED], told[LAYOUT]) if LAYOUT in told else arrays


@contextlib.contextmanager
def _errors_in_one_line(path: Path) -> Iterator[None]:
    try:
        yield
    except (ValueError, OSError, AttributeError, KeyError, TypeError):
        raise ArtifactError(f"{path}: expected an artifact, got files of another kind or damaged ones") from None


def _version() -> str:
    try:
        return metadata.version("taic_jax")
    except metadata.PackageNotFoundError:  # a bare checkout
        return "not installed"


def _show(spec: Spec | None) -> str:
    return "nothing" if spec is None else f"{spec[1]}{list(spec[0])}"
