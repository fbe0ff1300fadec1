"""Trees of arrays on disk: artifacts of a stage and checkpoints of a run, through Orbax.

A tree is stored flat, one array under each leaf's dotted name, and Orbax's `load(path)` returns it as a dict.
Checkpoints, which are many, hold the bytes of all leaves as one array, as Orbax spends its time per array. The metadata
hold the checksums of the arrays, the version of this package, and of checkpoints the layout: names, dtypes and shapes.
"""

import contextlib
import logging
import math
import os
import re
import shutil
import zlib
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from taic_jax.runtime.files import PARTIAL, TEMPORARY, SaveError, make_room, writes_here, writing
from taic_jax.runtime.hosts import agree

Tree = TypeVar("Tree")
Spec = tuple[tuple[int, ...], np.dtype]

VERSION, CHECKSUMS, LAYOUT = "taic_jax", "crc32", "layout"  # keys of the metadata
PACKED = "bytes"  # the one array of a checkpoint

# Orbax's threads also log its errors, in hundreds of lines. A logger that is made before absl is imported, as here,
# names absl's file in place of the caller's.
logging.getLogger("absl").addFilter(lambda record: not {"orbax", "absl"} & {*Path(record.pathname).parts})


class ArtifactError(ValueError):
    """Files other than the expected tree of arrays, or none."""


def save_tree(path: Path, tree: Any) -> None:
    """Replace the folder `path` by a tree of arrays, atomically; raise SaveError, and leave it, if that fails."""
    path = path.absolute()
    partial = path.with_name(path.name + PARTIAL)  # Orbax would remove the old folder before it writes
    with _saving(path, partial):
        _begin(partial, plain_arrays(tree), {})()
        if writes_here():
            if path.exists():
                shutil.rmtree(path)
            partial.rename(path)
    agree([0])  # every host waits for the folder


def load_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read a folder of `save_tree` or `Checkpoints` by dotted name, without empty arrays, or raise ArtifactError."""
    return _read(path)[0]


def load_tree(path: Path, like: Tree) -> Tree:
    """Read a tree with the names, shapes, dtypes and devices of `like` (arrays or shapes), or raise ArtifactError."""
    return fit_tree(path, *_read(path), like)


def fit_tree(path: Path, arrays: dict[str, np.ndarray], writer: str, like: Tree) -> Tree:
    """Return arrays by name as a tree like `like`, or raise ArtifactError at their first difference.

    The error names the `path` they are from, and the version of this package that wrote them, if it is another one.
    """
    named = _by_name(like)
    expected = {name: _spec(leaf) for name, leaf in named.items() if leaf.size}
    stored: dict[str, Spec] = {name: (array.shape, array.dtype) for name, array in arrays.items()}
    for name in {**expected, **stored}:
        if expected.get(name) != stored.get(name):
            difference = f"expected {_show(expected.get(name))} at {name or 'the root'}, got {_show(stored.get(name))}"
            by = "" if writer == _version() else f"; taic_jax {writer} wrote it, this is {_version()}"
            raise ArtifactError(f"{path}: {difference}{by}")
    leaves = [_restore(arrays.get(name), leaf) for name, leaf in named.items()]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


class Checkpoints:
    """The latest `keep` checkpoints of a run, each a folder named by its step, written while the run goes on.

    Older ones, which a killed run may have left, are removed at once, or SaveError is raised.
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
        """Begin to save a tree of arrays as this step, atomically, once the step before is saved.

        The arrays are read at once and may be donated afterwards. Raise SaveError if this step or the one before
        cannot be written; earlier steps stay.
        """
        self.wait()
        path, arrays = self.directory / str(step), plain_arrays(tree)
        layout = [[name, array.dtype.name, list(array.shape)] for name, array in arrays.items()]
        packed = np.concatenate([_bytes(array) for array in arrays.values()])
        from orbax.checkpoint import v1 as ocp

        options = ocp.options.ArrayOptions(saving=ocp.options.ArrayOptions.Saving(use_ocdbt=False))  # for many arrays
        with _saving(path, path), ocp.Context(array_options=options):
            self._pending = path, _begin(path, {PACKED: packed}, {LAYOUT: layout})

    def wait(self) -> None:
        """Wait for the end of a save, if one goes on, and drop the oldest steps, or raise SaveError and leave them."""
        if self._pending is None:
            return
        (path, finish), self._pending = self._pending, None
        with _saving(path, path):
            finish()
        self._drop()

    @contextlib.contextmanager
    def waited_for(self) -> Iterator[None]:
        """Wait for the last save at the end of the context; its SaveError gives way to one of the context."""
        try:
            yield
        except SaveError:
            with contextlib.suppress(SaveError):
                self.wait()
            raise
        finally:
            self.wait()

    def _drop(self) -> None:
        if writes_here():
            with writing(self.directory):
                for old in self.steps()[: -self.keep]:
                    shutil.rmtree(self.directory / str(old))

    def load(self, step: int, like: Tree) -> Tree:
        """Load the tree of this step, or raise ArtifactError with the step that --resume would go on from."""
        path = self.directory / str(step)
        try:
            return load_tree(path, like)
        except ArtifactError as error:
            before = [earlier for earlier in self.steps() if earlier < step]
            left = f"from {self.directory / str(before[-1])}" if before else "from the start of the stage"
            raise ArtifactError(f"{error}; without {path} --resume goes on {left}") from None


def _begin(path: Path, arrays: dict[str, np.ndarray], extra: dict[str, Any]) -> Callable[[], None]:
    """Begin to write arrays and `extra` metadata to the folder `path`; return a function that waits for the end."""
    from orbax.checkpoint import v1 as ocp  # it takes half a second, and loading an agent needs none

    path.parent.mkdir(parents=True, exist_ok=True)
    if writes_here():
        make_room(path.parent, sum(array.nbytes for array in arrays.values()) + len(arrays) * 2**10 + 2**14)
    beside = {VERSION: _version(), CHECKSUMS: checksums(arrays), **extra}
    return ocp.save_async(str(path), arrays, overwrite=True, custom_metadata=beside).result


@contextlib.contextmanager
def _saving(path: Path, written: Path) -> Iterator[None]:
    """Say in one line why `path` cannot be saved, and remove Orbax's incomplete copy of the folder `written`."""
    try:
        with writing(path):
            yield
    except (ValueError, SaveError) as error:
        shutil.rmtree(f"{written}{TEMPORARY}", ignore_errors=True)
        code = re.search(r"os_error_code='(\d+)'", str(error))  # TensorStore's
        if code is None:
            raise
        raise SaveError(f"{path}: cannot be written: {os.strerror(int(code[1]))}") from error


def _read(path: Path) -> tuple[dict[str, np.ndarray], str]:
    """Return the arrays in a folder by dotted name, and the version of this package that wrote them."""
    if not path.exists():
        raise ArtifactError(f"{path}: expected an artifact, got nothing")
    from orbax.checkpoint import v1 as ocp

    try:
        stored = ocp.metadata(str(path.absolute()))
        beside: Any = stored.custom_metadata or {}
        empty = {name: np.empty(meta.shape, meta.dtype) for name, meta in stored.metadata.items()}
        arrays = ocp.load(str(path.absolute()), empty)
        sums = checksums(arrays)
        if beside.get(CHECKSUMS, sums) != sums:  # earlier versions wrote none
            raise ValueError
        arrays = _unpack(arrays[PACKED], beside[LAYOUT]) if LAYOUT in beside else arrays
    except (ValueError, OSError, AttributeError, KeyError, TypeError):
        raise ArtifactError(f"{path}: expected an artifact, got files of another kind or damaged ones") from None
    return arrays, beside.get(VERSION, _version())


def _unpack(packed: np.ndarray, layout: list) -> dict[str, np.ndarray]:
    arrays, begin = {}, 0
    for name, dtype, shape in layout:
        end = begin + math.prod(shape) * np.dtype(dtype).itemsize
        arrays[name] = packed[begin:end].copy().view(dtype).reshape(shape)  # copied, to begin at an even address
        begin = end
    return arrays


def _by_name(tree: Any) -> dict[str, Any]:
    """Return the leaves by dotted name, in the tree's order."""
    return {jax.tree_util.keystr(p, simple=True, separator="."): leaf for p, leaf in jax.tree.leaves_with_path(tree)}


def plain_arrays(tree: Any) -> dict[str, np.ndarray]:
    """Return the leaves by dotted name as NumPy's arrays, without empty ones, which Orbax refuses."""
    named = {name: leaf for name, leaf in _by_name(tree).items() if leaf.size}
    return jax.device_get({name: jax.random.key_data(x) if _is_key(x) else x for name, x in named.items()})


def _spec(leaf: Any) -> Spec:
    """Return the shape and dtype of a leaf of `plain_arrays`."""
    plain = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
    return plain.shape, plain.dtype


def _restore(array: np.ndarray | None, leaf: Any) -> jax.Array:
    """Undo `plain_arrays` for one leaf, in the form and on the devices of another."""
    if array is None:  # an empty leaf
        return jnp.zeros(leaf.shape, leaf.dtype)
    if _is_key(leaf):
        kind = jax.random.key_impl(jnp.zeros((), leaf.dtype))  # an abstract leaf has no implementation to ask
        array = jax.random.wrap_key_data(jnp.asarray(array), impl=kind)
    return jax.device_put(array, leaf.sharding if getattr(leaf, "committed", False) else None)


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _bytes(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)


def checksums(arrays: dict[str, np.ndarray]) -> dict[str, int]:
    """Return the CRC-32 of each array's bytes."""
    return {name: zlib.crc32(_bytes(array).data) for name, array in arrays.items()}


def version_of(package: str) -> str | None:
    """Return the installed version, or None: a bare checkout of this package has none."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _version() -> str:
    return version_of("taic_jax") or "not installed"


def _show(spec: Spec | None) -> str:
    return "nothing" if spec is None else f"{spec[1]}{list(spec[0])}"
