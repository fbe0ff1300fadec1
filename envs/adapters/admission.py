"""Conditions on an environment for an adapter, each with its error in one line."""

import contextlib
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from taic_jax.envs.base import Env, State
from taic_jax.envs.errors import AdapterError, MissingExtraError


@contextlib.contextmanager
def extra(name: str) -> Iterator[None]:
    """Import packages of an extra of ours; `MissingExtraError` if one is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingExtraError((error.name or str(error)).partition(".")[0], name) from error


def require_vector_actions(name: str, env: Any, limits: Float[np.ndarray, "A 2"] | None = None) -> None:
    """Raise `AdapterError` at actions that are no vector in [-1, 1]^A: discrete, composite or unlimited.

    `limits` are low and high of every action; without them, those of the environment's `action_space`.
    """
    space: Any = getattr(env, "action_space", None)
    if any(hasattr(space, attribute) for attribute in ("n", "nvec", "spaces")):
        raise AdapterError(f"{name}: actions: got {space}, expected one vector of numbers with limits")
    if limits is None and hasattr(space, "low"):
        limits = np.stack([np.ravel(space.low), np.ravel(space.high)], axis=1)
    if limits is not None and not np.isfinite(limits).all():
        index = int(np.argmin(np.isfinite(limits).all(axis=1)))
        low, high = (float(limit) for limit in limits[index])
        raise AdapterError(f"{name}: actions: action {index} is in [{low}, {high}], expected finite limits")


def require_task(adapter: str, env: Any) -> State:
    """Return the abstract first state of an environment for another library.

    Raise `AdapterError` if it is none of ours, or resets itself, which the other library does.
    """
    require_vector_actions(adapter, env)
    if not isinstance(env, Env):
        kind = f"{type(env).__module__}.{type(env).__qualname__}"
        raise AdapterError(f"{adapter}: got {kind}, expected a taic_jax.envs.Env, as make_env returns")
    start = jax.eval_shape(env.reset, jax.random.key(0))
    if start.key is not None:
        raise AdapterError(f"{adapter}: {env.name} is in AutoReset, expected the environment inside it")
    return start
