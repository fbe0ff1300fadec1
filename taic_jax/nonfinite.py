"""Numbers that are not finite: name the first quantity that has them, and stop only the seed that has them."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Int

from taic_jax.types import select

QUANTITIES = ("window", "action", "physics", "observation", "reward", "value", "loss", "gradient")
"""The quantities to check; a code is an index into this, or `FINITE`."""
FINITE = -1


def first_nonfinite(**quantities: Any) -> Int[Array, ""]:
    """Return the code of the first of these trees of arrays with a number that is not finite.

    Pass trees by their names in `QUANTITIES`, in the order of their computation.
    """
    bad = jnp.stack([~_is_finite(tree) for tree in quantities.values()])
    codes = jnp.array([QUANTITIES.index(name) for name in quantities], jnp.int32)
    return jnp.where(jnp.any(bad), codes[jnp.argmax(bad)], FINITE)


def earliest(codes: Int[Array, " N"]) -> Int[Array, ""]:
    """Return the first of N successive codes that is not `FINITE`, if any."""
    return codes[jnp.argmax(codes != FINITE)]


def _is_finite(tree: Any) -> Array:
    leaves = [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.inexact)]
    return jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves] or [jnp.ones((), bool)]).all()


class Guarded(struct.PyTreeNode):
    """The last good states [K] of a stage, with the code and the number of good steps of each seed."""

    state: Any
    code: Array
    step: Array


def begin(state: Any, code: Int[Array, " K"]) -> Guarded:
    """Guard states before the first step; seeds whose code is not `FINITE` stopped in an earlier stage."""
    return Guarded(state, code, jnp.zeros_like(code))


def guarded(step: Callable[..., tuple[Any, dict, Any]]) -> Callable[..., tuple[Guarded, dict, Any]]:
    """Return a step over all seeds that keeps a seed at its last state once its numbers are not finite.

    Args:
      step: (states [K], ...) -> (states [K], metrics [K] with the codes `nonfinite`, anything).
    """

    def call(guard: Guarded, *args: Any) -> tuple[Guarded, dict, Any]:
        after, metrics, extra = step(guard.state, *args)
        metrics = dict(metrics)
        code = jnp.where(guard.code == FINITE, metrics.pop("nonfinite"), guard.code)
        going = code == FINITE
        state = select(going, after, guard.state)
        return Guarded(state, code, guard.step + going.astype(jnp.int32)), without_stopped(metrics, code), extra

    return call


def without_stopped(results: Any, code: Int[Array, " K"]) -> Any:
    """Return results [K, ...] with NaN for the seeds that stopped."""
    return jax.tree.map(lambda x: select(code == FINITE, x, jnp.full_like(x, jnp.nan)), results)
