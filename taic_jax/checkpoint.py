"""Trees of arrays on disk: artifacts of a stage and checkpoints of a run, through Orbax.

A tree is stored flat, one array under each leaf's dotted name. So what is on disk can be compared with what
is asked for before anything is read, and anyone can read it: Orbax's `load(path)` gives a dict.
"""

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from orbax.checkpoint import v1 as ocp

Tree = TypeVar("Tree")

PARTIAL = ".partial"
"""Ending of a file that is not whole yet."""
TEMPORARY = ".orbax-checkpoint-tmp"  # Orbax writes under this suffix, and renames when all is written


class ArtifactError(ValueError):
    """Something on disk is not the tree of arrays that was asked for."""


def save_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all, in place of what was there."""
    partial = path.with_name(path.name + PARTIAL)
    partial.write_text(text)
    os.replace(partial, path)


def save_tree(path: Path, tree: Any) -> None:
    """Write a tree of arrays to the folder `path`, whole or not at all, in place of what was there."""
    path = path.absolute()
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {name: _to_plain(leaf) for name, leaf in _named(tree).items() if leaf.size}
    ocp.save(str(path), arrays, overwrite=True)


def load_tree(path: Path, like: Tree) -> Tree:
    """Read a tree of arrays with the structure, shapes and dtypes of `like`, and onto its devices.

    Args:
        path: the folder that `save_tree` wrote.
        like: arrays or `jax.ShapeDtypeStruct`s.

    Raises:
        ArtifactError: nothing is there, or it is not a tree like this one.
    """
    path = path.absolute()
    if not path.exists():
        raise ArtifactError(f"{path}: expected an artifact, got nothing")
    named = _named(like)
    with _errors_in_one_line(path):
        stored = {name: (meta.shape, meta.dtype) for name, meta in ocp.metadata(str(path)).metadata.items()}
    _check(path, stored, {name: _plain_spec(leaf) for name, leaf in named.items() if leaf.size})
    with _errors_in_one_line(path):
        as_numpy = {name: np.empty(shape, dtype) for name, (shape, dtype) in stored.items()}
        arrays = ocp.load(str(path), as_numpy)
    leaves = [_from_plain(arrays.get(name), leaf) for name, leaf in named.items()]
    return jax.tree.unflatten(jax.tree.structure(like), leaves)


class Checkpoints:
    """The last few checkpoints of a run, each a folder named by its step.

    Args:
        directory: the folder that holds them.
        keep: how many of the latest to keep.
    """

    def __init__(self, directory: Path, keep: int = 2):
        self.directory, self.keep = directory.absolute(), keep
        # A run that was killed while it saved leaves a half-written folder, which Orbax never removes.
        for leftover in self.directory.glob(f"*{TEMPORARY}*"):
            shutil.rmtree(leftover)

    def steps(self) -> list[int]:
        """List the steps that can be loaded, earliest first."""
        return sorted(int(path.name) for path in self.directory.glob("*") if path.name.isdigit())

    def latest_step(self) -> int | None:
        """Return the last step saved, or None."""
        return max(self.steps(), default=None)

    def save(self, step: int, tree: Any) -> None:
        """Save a tree of arrays as this step, whole or not at all, and drop the oldest steps."""
        save_tree(self.directory / str(step), tree)
        for old in self.steps()[: -self.keep]:
            shutil.rmtree(self.directory / str(old))

    def load(self, step: int, like: Tree) -> Tree:
        """Load the tree of this step; see `load_tree`."""
        return load_tree(self.directory / str(step), like)


@contextlib.contextmanager
def _errors_in_one_line(path: Path) -> Iterator[None]:
    try:
        yield
    except (ValueError, OSError, AttributeError):
        raise ArtifactError(f"{path}: expected an artifact, got files of another kind or damaged ones") from None


def _named(tree: Any) -> dict[str, Any]:
    """Return the leaves by dotted name, in the tree's order."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _key_impl(leaf: Any) -> Any:
    return jax.random.key_impl(jnp.zeros((), leaf.dtype))  # an abstract leaf has no implementation to ask


def _to_plain(leaf: Any) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def _plain_spec(leaf: Any) -> tuple[tuple[int, ...], np.dtype]:
    plain = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
    return plain.shape, plain.dtype


def _from_plain(array: np.ndarray | None, leaf: Any) -> jax.Array:
    if array is None:  # Orbax cannot store an array without entries
        return jnp.zeros(leaf.shape, leaf.dtype)
    if _is_key(leaf):
        array = jax.random.wrap_key_data(jnp.asarray(array), impl=_key_impl(leaf))
    return jax.device_put(array, leaf.sharding if getattr(leaf, "committed", False) else None)


def _check(path: Path, stored: dict[str, Any], expected: dict[str, Any]) -> None:
    for name in {**expected, **stored}:
        want, got = expected.get(name), stored.get(name)
        if want != got:
            raise ArtifactError(f"{path}: expected {_show(want)} at {name or 'the root'}, got {_show(got)}")


def _show(spec: tuple[tuple[int, ...], np.dtype] | None) -> str:
    return "nothing" if spec is None else f"{spec[1]}{list(spec[0])}"
