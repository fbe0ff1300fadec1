"""A check of the contract of `Env` that neither compiles nor runs the environment."""

import math
import sys
import traceback
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from taic_jax.envs.base import Env, State
from taic_jax.envs.errors import ContractError
from taic_jax.envs.wrappers import AutoReset, TimeLimit


def _is_size(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, (int, np.integer)) and bool(value >= 1)


def _is_time(value: Any) -> bool:
    return not isinstance(value, bool) and isinstance(value, (int, float, np.number)) and bool(0 < value < math.inf)


_SIZES = ("observation_size", "action_size", "proprioceptive_size", "episode_length")
_RULES = {  # attribute -> what it must satisfy, and in words
    **dict.fromkeys(_SIZES, (_is_size, "an integer of at least 1")),
    "dt": (_is_time, "a positive number of seconds"),
    "discrete": (lambda value: isinstance(value, bool), "True or False"),
    **dict.fromkeys(("reset", "step", "render"), (callable, "a method")),
}


def check_contract(env: Env) -> None:
    """Check the contract of `Env` by abstract evaluation alone; of `TimeLimit` and `AutoReset` the attributes alone.

    Raises:
      ContractError: the first breach; the message starts with the environment's name and the field.
    """
    outermost = env
    while type(env) in (TimeLimit, AutoReset):
        env = env.env  # pyright: ignore[reportAttributeAccessIssue]
    _check_attributes(env)
    _check_attributes(outermost)
    key = jax.eval_shape(lambda: jax.random.key(0))
    start = _trace(env, "reset", key)
    after = _trace(env, "step", start, jax.ShapeDtypeStruct((env.action_size,), jnp.float32))
    _check_same(env, start, "step", after)
    if type(env).restart is not Env.restart:
        _check_same(env, start, "restart", _trace(env, "restart", key, start.physics))


def _check_attributes(env: Env) -> None:
    name = getattr(env, "name", None)
    if not isinstance(name, str) or not name:
        raise ContractError(type(env).__name__, "name", f"got {name!r}, expected a string")
    for field in _RULES:
        if not hasattr(env, field):
            raise ContractError(name, field, "is missing")
    for field, (is_valid, expected) in _RULES.items():
        if not is_valid(value := getattr(env, field)):
            raise ContractError(name, field, f"got {value!r}, expected {expected}")
    if env.proprioceptive_size > env.observation_size:
        problem = f"got {env.proprioceptive_size}, expected at most observation_size, {env.observation_size}"
        raise ContractError(name, "proprioceptive_size", problem)


def _trace(env: Env, method: str, *arguments: Any) -> State:
    """Call a method on abstract arrays; the error has the exception and the line of the environment's own file."""
    try:
        state = jax.eval_shape(getattr(env, method), *arguments)
    except Exception as error:
        file = getattr(sys.modules.get(type(env).__module__), "__file__", None)
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == file]
        place = f" (line {lines[-1]} of {file})" if lines else ""
        message = " ".join([f"{type(error).__name__}:", *str(error).partition("\n")[0].split()])
        raise ContractError(env.name, method, f"cannot be traced by JAX: {message}{place}") from error
    _check_state(env, method, state)
    return state


def _check_state(env: Env, method: str, state: Any) -> None:
    """Compare a method's result with the shapes and dtypes of `State`."""
    if not isinstance(state, State):
        raise ContractError(env.name, method, f"returns {type(state).__name__}, expected State")
    if not isinstance(state.metrics, dict):
        raise ContractError(env.name, "metrics", f"{method} returns {type(state.metrics).__name__}, expected dict")
    vector, number = (jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((env.observation_size,), ()))
    flag = jax.ShapeDtypeStruct((), jnp.bool_)
    expected = {
        "obs": (state.obs, vector), "reward": (state.reward, number),
        "terminated": (state.terminated, flag), "truncated": (state.truncated, flag),
        **{f"metrics[{name!r}]": (value, number) for name, value in state.metrics.items()},
    }  # fmt: skip
    for field, (value, right) in expected.items():
        if not isinstance(value, jax.ShapeDtypeStruct) or (value.shape, value.dtype) != (right.shape, right.dtype):
            raise ContractError(env.name, field, f"{method} returns {_show(value)}, expected {_show(right)}")


def _check_same(env: Env, start: State, method: str, after: State) -> None:
    """Refuse a method whose state differs from reset's in structure, shapes, dtypes or weak types."""
    if start.metrics.keys() != after.metrics.keys():
        new, old = ("{" + ", ".join(sorted(map(repr, state.metrics))) + "}" for state in (after, start))
        raise ContractError(env.name, "metrics", f"{method} returns {new}, reset returns {old}")
    for field in State.__dataclass_fields__:
        trees = getattr(after, field), getattr(start, field)
        leaves = [{jax.tree_util.keystr(path): x for path, x in jax.tree.leaves_with_path(tree)} for tree in trees]
        for path in leaves[1] | leaves[0]:
            new, old = (_show(each.get(path)) for each in leaves)
            if new != old:
                raise ContractError(env.name, field + path, f"{method} returns {new}, reset returns {old}")
        if jax.tree.structure(trees[0]) != jax.tree.structure(trees[1]):
            raise ContractError(env.name, field, f"{method} returns another kind of tree than reset")


def _show(value: Any) -> str:
    """Return an abstract array as float32[3], with its weak type if it has one."""
    if value is None:
        return "nothing"
    if not isinstance(value, jax.ShapeDtypeStruct):
        return type(value).__name__
    weak = " (weakly typed)" if value.weak_type else ""
    return f"{value.dtype}[{','.join(map(str, value.shape))}]{weak}"
