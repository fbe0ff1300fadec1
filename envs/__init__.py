"""Tasks to learn: navigation, running robots and any Brax environment, behind the one interface `Env`."""

if __name__ == "envs":  # would be a second copy of every class
    raise ImportError("this folder is the package `taic_jax.envs`; import it by that name")

import ctypes.util
import functools
import os
import sys

# MuJoCo chooses how to draw when it is first imported. Its own choice needs a display. EGL does not, but
# where that library is missing, to ask for it would make the import fail.
if sys.platform == "linux" and "DISPLAY" not in os.environ and ctypes.util.find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")

from taic_jax.envs.adapters import BRAX_PREFIX, BraxEnv
from taic_jax.envs.base import Env, PhysicsState, State
from taic_jax.envs.errors import RenderingError, UnknownNameError
from taic_jax.envs.locomotion import ANT, HALF_CHEETAH, Locomotion
from taic_jax.envs.navigation import Navigation
from taic_jax.envs.wrappers import AutoReset, TimeLimit, Wrapper

__all__ = [
    "AutoReset",
    "BraxEnv",
    "Env",
    "Locomotion",
    "Navigation",
    "PhysicsState",
    "RenderingError",
    "State",
    "TimeLimit",
    "UnknownNameError",
    "Wrapper",
    "environment_names",
    "make_env",
]

_NAVIGATION = {
    "nav2d": Navigation,
    "nav2d_random": functools.partial(Navigation, random_ends=True),
}
_ROBOTS = {"ant": ANT, "half_cheetah": HALF_CHEETAH}


def environment_names() -> tuple[str, ...]:
    """List the tasks `make_env` knows, besides `brax:NAME` for every environment registered with Brax."""
    return (*_NAVIGATION, *_ROBOTS)


def make_env(name: str, backend: str = "auto", *, num_threads: int | None = None, pipeline: str = "spring") -> Env:
    """Make a task by name, with its time limit.

    Args:
      name: one of `environment_names()`, or `brax:NAME`.
      backend: physics of the MuJoCo tasks, `auto`, `mujoco` or `mjx` (see `physics.make_physics`).
      num_threads: threads of the `mujoco` backend; None or 0 takes one per physical core.
      pipeline: physics of `brax:NAME`: `spring`, `positional`, `generalized` or `mjx`.

    Raises:
      UnknownNameError: if there is no such task, backend or pipeline; the message names the nearest.
    """
    if name.startswith(BRAX_PREFIX):
        env = BraxEnv(name.removeprefix(BRAX_PREFIX), pipeline)
    elif name in _NAVIGATION:
        env = _NAVIGATION[name]()
    elif name in _ROBOTS:
        env = Locomotion(_ROBOTS[name], backend, num_threads or 0)
    else:
        raise UnknownNameError("environment", name, (*environment_names(), f"{BRAX_PREFIX}NAME"))
    return TimeLimit(env, env.episode_length)
