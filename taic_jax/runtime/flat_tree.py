"""A tree of arrays as a dict: one NumPy array under each leaf's dotted name, or the bytes of all as one array."""

import math
import zlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

Spec = tuple[tuple[int, ...], np.dtype]


def by_name(tree: Any) -> dict[str, Any]:
    """Return the leaves by dotted name, in the tree's order."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def plain(tree: Any) -> dict[str, np.ndarray]:
    """Return the leaves by dotted name as NumPy's arrays, without those that have no entries: Orbax has none."""
    named = {name: leaf for name, leaf in by_name(tree).items() if leaf.size}
    return jax.device_get({name: jax.random.key_data(x) if _is_key(x) else x for name, x in named.items()})


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _key_impl(leaf: Any) -> Any:
    return jax.random.key_impl(jnp.zeros((), leaf.dtype))  # an abstract leaf has no implementation to ask


def plain_spec(leaf: Any) -> Spec:
    """Return the shape and dtype of a leaf as a NumPy array."""
    plain = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
    return plain.shape, plain.dtype


def from_plain(array: np.ndarray | None, leaf: Any) -> jax.Array:
    """Undo `plain` for one leaf, given one like it; onto its devices."""
    if array is None:  # it has no entries
        return jnp.zeros(leaf.shape, leaf.dtype)
    if _is_key(leaf):
        array = jax.random.wrap_key_data(jnp.asarray(array), impl=_key_impl(leaf))
    return jax.device_put(array, leaf.sharding if getattr(leaf, "committed", False) else None)


def pack(arrays: dict[str, np.ndarray]) -> tuple[np.ndarray, list]:
    """Return the bytes [n] of all arrays, and of what they are, in order: name, dtype and shape."""
    layout = [[name, array.dtype.name, list(array.shape)] for name, array in arrays.items()]
    return np.concatenate([_bytes(array) for array in arrays.values()]), layout


def unpack(packed: np.ndarray, layout: list) -> dict[str, np.ndarray]:
    """Undo `pack`."""
    arrays, begin = {}, 0
    for name, dtype, shape in layout:
        end = begin + math.prod(shape) * np.dtype(dtype).itemsize
        arrays[name] = packed[begin:end].copy().view(dtype).reshape(shape)  # copied, to begin at an even address
        begin = end
    return arrays


def _bytes(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)


def checksum(array: np.ndarray) -> int:
    """Return the CRC-32 of an array's bytes."""
    return zlib.crc32(_bytes(array).data)
