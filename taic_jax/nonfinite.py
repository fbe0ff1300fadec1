"""Numbers that are not finite: name the quantity that had them first, and stop the seed that met them alone."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Int

from taic_jax.types import select

QUANTITIES = ("window", "action", "physics", "observation", "reward", "value", "loss", "gradient")
"""The quantities that are watched; a code is an index into this, or `FINITE`."""
FINITE = -1


def first_nonfinite(**quantities: Any) -> Int[Array, ""]:
    """Return the code of the first of these trees of arrays with a number that is not finite.

    Args:
      **quantities: by name, one of `QUANTITIES`, in the order in which they are computed.
    """
    bad = jnp.stack([~_is_finite(tree) for tree in quantities.values()])
    codes = jnp.array([QUANTITIES.index(name) for name in quantities], jnp.int32)
    return jnp.where(jnp.any(bad), codes[jnp.argmax(bad)], FINITE)


def earliest(codes: Int[Array, " N"]) -> Int[Array, ""]:
    """Return the first code of a row in time that is not `FINITE`, if any."""
    return codes[jnp.argmax(codes != FINITE)]


def _is_finite(tree: Any) -> Array:
    leaves = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves] or [jnp.ones((), bool)]).all()


class Guarded(struct.PyTreeNode):
    """The states [K] of a stage, each the last good one of its seed; why seeds stopped, and after how many steps."""

    state: Any
    code: Array
    step: Array


def begin(state: Any, code: Int[Array, " K"]) -> Guarded:
    """Guard states before the first step; seeds whose code is not `FINITE` stopped in an earlier stage."""
    return Guarded(state, code, jnp.zeros_like(code))


def guarded(step: Callable[..., tuple[Any, dict, Any]]) -> Callable[..., tuple[Guarded, dict, Any]]:
    """Return a step over all seeds that leaves a seed where it was once its numbers are not finite.

    Args:
      step: (states [K], ...) -> (states [K], metrics [K] with the codes `nonfinite`, anything).
    """

    def call(guard: Guarded, *args: Any) -> tuple[Guarded, dict, Any]:
        after, metrics, extra = step(guard.state, *args)
        metrics = dict(metrics)
        code = jnp.where(guard.code == FINITE, metrics.pop("nonfinite"), guard.code)
        going = code == FINITE
        state = select(going, after, guard.state)
        metrics = jax.tree.map(lambda x: select(going, x, jnp.full_like(x, jnp.nan)), metrics)
        return Guarded(state, code, guard.step + going.astype(jnp.int32)), metrics, extra

    return call
