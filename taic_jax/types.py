"""Axes, the pytree view of the configuration, and small array helpers.

Axes, used in every docstring of the package:
`T` ticks, `B` environments, `N` windows, `L` longest option, `D` option size, `A` action size,
`S` observation size, `P` size of the proprioceptive slice, `G` sweep points, `K` seeds; `R` rows [T B] of ticks or
[G K] of programs, `M` rows of a minibatch, `F` features of a row; `X` random numbers that an executor takes in a tick,
`Z` of policy and executor, D + X.
"""

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, get_type_hints

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from taic_jax import config

Tree = TypeVar("Tree")
Scalar = Float[Array, ""] | float
"""A leaf of the config: a float from a file, an array after `as_arrays` or in a sweep."""


@dataclass(frozen=True)
class Seeds(Generic[Tree]):
    """The same thing of every seed: `seeds[k]` is that of seed k, `seeds.rows` all of them, leading axis K."""

    rows: Tree

    def __len__(self) -> int:
        return len(jax.tree.leaves(self.rows)[0])

    def __getitem__(self, seed: int) -> Tree:
        if not -len(self) <= seed < len(self):
            raise IndexError(f"seed {seed}: expected one of the {len(self)} seeds of this run")
        row = jax.tree.map(lambda x: x[seed], jax.device_get(self.rows))  # on a device each shape would be compiled
        return jax.device_put(row)

    def __iter__(self) -> Iterator[Tree]:
        return (self[k] for k in range(len(self)))


def _register(cls: type) -> None:
    """Make a config class a pytree: floats and nested configs are children, all else is static."""
    kinds = get_type_hints(cls)  # without their bounds
    leaves = [name for name, kind in kinds.items() if kind is float or dataclasses.is_dataclass(kind)]
    static = [name for name in kinds if name not in leaves]
    jax.tree_util.register_dataclass(cls, data_fields=leaves, meta_fields=static)


for _cls in config.CONFIG_CLASSES:
    _register(_cls)


def as_arrays(tree: Tree) -> Tree:
    """Turn every float of a config into a strongly typed float32 array, so that it can be vmapped.

    Python floats would be weakly typed leaves, and a second call with arrays would compile again.
    """
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), tree)


def as_rows(configs: Sequence[Tree], seeds: int) -> Tree:
    """Stack configs that differ in their floats alone, each `seeds` times: rows [G K], one point after another."""
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(as_arrays(config) for config in configs))
    return jax.tree.map(lambda x: jnp.repeat(x, seeds, axis=0), stacked)


def select(condition: Bool[Array, " B"], if_true: Tree, if_false: Tree) -> Tree:
    """Choose between two trees along their leading axis B."""

    def choose(a: Any, b: Any) -> Any:
        return jnp.where(condition.reshape((-1,) + (1,) * (a.ndim - 1)), a, b)

    with jax.numpy_rank_promotion("allow"):
        return jax.tree.map(choose, if_true, if_false)
