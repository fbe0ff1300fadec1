"""Tasks to learn: navigation, running robots and any Brax environment, behind the one interface `Env`."""

if __name__ == "envs":  # would be a second copy of every class
    raise ImportError("this folder is the package `taic_jax.envs`; import it by that name")

import ctypes.util
import dataclasses
import os
import sys
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

# MuJoCo chooses its way to draw at its first import. Its own choice needs a display. EGL does not, but without that
# library the import would fail.
if sys.platform == "linux" and "DISPLAY" not in os.environ and ctypes.util.find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")

from taic_jax.envs.adapters import BRAX_PREFIX, GYMNAX_PREFIX, PLAYGROUND_PREFIX, BraxEnv, GymnaxEnv, PlaygroundEnv
from taic_jax.envs.adapters.gymnasium import GYMNASIUM_PREFIX, GymnasiumEnv
from taic_jax.envs.ant_tasks import AntTurn, ArenaTask
from taic_jax.envs.arenas import FALL, MAZE, PUSH, Arena
from taic_jax.envs.base import Env, PhysicsState, State
from taic_jax.envs.contract import check_contract
from taic_jax.envs.custom import load_custom
from taic_jax.envs.errors import (
    ContractError,
    EnvOptionError,
    MissingExtraError,
    ModelError,
    RenderingError,
    UnknownNameError,
)
from taic_jax.envs.grid import FourRooms
from taic_jax.envs.headings import CheetahHeadings, FreeHeadings
from taic_jax.envs.locomotion import Locomotion
from taic_jax.envs.menagerie import MENAGERIE_PREFIX, TICK, legged_robot, menagerie_robot
from taic_jax.envs.navigation import Navigation
from taic_jax.envs.physics import BACKENDS
from taic_jax.envs.robots import ROBOTS, Robot, with_body, with_contacts
from taic_jax.envs.wrappers import AutoReset, TimeLimit, Wrapper

__all__ = [
    "AntTurn", "ArenaTask", "AutoReset", "BraxEnv", "CheetahHeadings", "ContractError", "Env", "EnvOptionError",
    "FourRooms", "FreeHeadings", "GymnaxEnv", "Locomotion", "MissingExtraError", "ModelError", "Navigation",
    "PhysicsState", "PlaygroundEnv", "RenderingError", "State", "TimeLimit", "UnknownNameError", "Wrapper",
    "check_contract", "environment_names", "environment_options", "legged_robot", "make_env", "menagerie_robot",
]  # fmt: skip


class _Task(NamedTuple):
    """A task's constructor, and its arguments: these options, and `backend` and `num_threads` for an engine."""

    make: Callable[..., Env]
    options: tuple[str, ...] = ()
    has_engine: bool = True


def _make_robot(
    name: str, model: str, backend: str, num_threads: int, body: str = "gym", contacts: str = "feet"
) -> Env:  # fmt: skip
    if model not in ROBOTS:
        raise UnknownNameError("model", model, ROBOTS)
    return Locomotion(name, with_contacts(with_body(ROBOTS[model][name], body), contacts), backend, num_threads)


def _ant(body: str, **changes: float) -> Robot:
    """Return the ant with contacts of its whole body."""
    return with_contacts(with_body(dataclasses.replace(ROBOTS["brax"]["ant"], **changes), body), "body")


def _make_ant_headings(body: str, backend: str, num_threads: int) -> Env:
    return FreeHeadings("ant_headings", _ant(body, control_cost=0.1), backend, num_threads)  # at 0.5 it hardly walks


def _make_ant_arena(name: str, arena: Arena, body: str, goal: str, backend: str, num_threads: int) -> Env:
    return ArenaTask(name, arena, _ant(body), goal, backend, num_threads)


def _make_walk(name: str, backend: str, num_threads: int) -> Env:
    return Locomotion(MENAGERIE_PREFIX + name, menagerie_robot(name), backend, num_threads)


def _make_headings(name: str, backend: str, num_threads: int) -> Env:
    robot, hold = menagerie_robot(name), round(3.0 / TICK)
    return FreeHeadings(f"{MENAGERIE_PREFIX}{name}_headings", robot, backend, num_threads, hold)


def _make_maze(name: str, goal: str, backend: str, num_threads: int) -> Env:
    robot = dataclasses.replace(menagerie_robot(name), episode_length=round(50.0 / TICK))  # s, as long as the ant's
    return ArenaTask(f"{MENAGERIE_PREFIX}{name}_maze", MAZE, robot, goal, backend, num_threads)


DEFAULTS: dict[str, str | int] = {
    "pipeline": "spring", "model": "brax", "body": "gym", "contacts": "feet", "goal": "fixed", "change_after": 0,
}  # fmt: skip
"""Options of tasks."""
_TASKS = {
    "nav2d": _Task(Navigation, ("change_after",), has_engine=False),
    "nav2d_random": _Task(partial(Navigation, random_ends=True), has_engine=False),
    "four_rooms": _Task(FourRooms, has_engine=False),
    "four_rooms_random": _Task(partial(FourRooms, random_ends=True), has_engine=False),
    **{name: _Task(partial(_make_robot, name), ("model",)) for name in ROBOTS["brax"]},
    "ant": _Task(partial(_make_robot, "ant"), ("model", "body", "contacts")),  # alone of the robots it has two bodies
    "half_cheetah_headings": _Task(CheetahHeadings),
    "ant_headings": _Task(_make_ant_headings, ("body",)),
    "ant_turn": _Task(partial(AntTurn, "ant_turn", ROBOTS["brax"]["ant"])),
    "ant_maze": _Task(partial(_make_ant_arena, "ant_maze", MAZE), ("body", "goal")),
    "ant_push": _Task(partial(_make_ant_arena, "ant_push", PUSH), ("body", "goal")),
    "ant_fall": _Task(partial(_make_ant_arena, "ant_fall", FALL), ("body", "goal")),
}
_LIBRARIES = {  # prefix and ending -> a task's constructor, which takes the name between them first
    (BRAX_PREFIX, ""): _Task(BraxEnv, ("pipeline",), has_engine=False),
    (PLAYGROUND_PREFIX, ""): _Task(PlaygroundEnv, has_engine=False),
    (GYMNASIUM_PREFIX, ""): _Task(GymnasiumEnv, has_engine=False),
    (GYMNAX_PREFIX, ""): _Task(GymnaxEnv, has_engine=False),
    (MENAGERIE_PREFIX, "_headings"): _Task(_make_headings),
    (MENAGERIE_PREFIX, "_maze"): _Task(_make_maze, ("goal",)),
    (MENAGERIE_PREFIX, ""): _Task(_make_walk),
}


def environment_names() -> tuple[str, ...]:
    """List the tasks of this package; `make_env` also makes others' by prefix and the user's own by file or module."""
    return tuple(_TASKS)


def environment_options(name: str) -> tuple[str, ...]:
    """List the options of `make_env` for a task, besides backend and number of threads; raise `UnknownNameError` if
    there is no such task."""
    return _find(name).options


def make_env(name: str, backend: str = "auto", *, num_threads: int = 0, **options: str | int) -> Env:
    """Make a task by name, with its time limit.

    Args:
      name: one of `environment_names()`; `brax:NAME`, `playground:NAME`, `gymnax:NAME`, `gymnasium:ID` or
        `gymnasium:MODULE:ID` for an environment of those packages; `menagerie:NAME` for a robot of MuJoCo Menagerie,
        and `menagerie:NAME_headings` or `menagerie:NAME_maze` for it in the tasks of the ant; `FILE.py:CLASS` or
        `MODULE:CLASS` for your own.
      backend: physics of the MuJoCo tasks, `auto`, `mujoco`, `mjx` or `warp` (see `physics.make_physics`).
      num_threads: threads of the `mujoco` backend; 0 takes one per physical core.
      **options: those of the task (`environment_options`); a default is accepted by every task.

    Options:
      pipeline: physics of `brax:NAME`: `spring`, `positional`, `generalized` or `mjx`.
      model: MJCF and rules of the running robots: `brax`, or `gym` for Gymnasium's own.
      body: of the ant, alone or in an arena: `gym`, or `hiro`, which is weaker and slower.
      contacts: of `ant` with the ground: `feet`, or `body`, as in the arenas.
      goal: of an arena: `fixed`, `near` in the maze, or `uniform` or `mixed` while training.
      change_after: episodes after which the room of `nav2d` changes; 0 for never.

    Raises:
      UnknownNameError: there is no such task or value; the message names the nearest.
      EnvOptionError: the task has no such option.
      MissingExtraError: it needs a package that is not installed.
      ModelError: a robot's model does not fit its task.
      ContractError: an environment from elsewhere breaks the contract of `Env`.
    """
    task = _find(name)
    if backend not in BACKENDS:
        raise UnknownNameError("backend", backend, BACKENDS)
    for option, value in options.items():
        if option not in task.options and value != DEFAULTS.get(option):
            raise EnvOptionError(name, option, value, task.options)
    engine = {"backend": backend, "num_threads": num_threads} if task.has_engine else {}
    env = task.make(**{option: options.get(option, DEFAULTS[option]) for option in task.options}, **engine)
    if name not in _TASKS:
        check_contract(env)
    return TimeLimit(env, env.episode_length)


def _find(name: str) -> _Task:
    if name in _TASKS:
        return _TASKS[name]
    for (prefix, ending), library in _LIBRARIES.items():
        if name.startswith(prefix) and name.endswith(ending):
            return library._replace(make=partial(library.make, name.removeprefix(prefix).removesuffix(ending)))
    if ":" in name:
        return _Task(partial(load_custom, name))
    others = (*(f"{prefix}NAME{ending}" for prefix, ending in _LIBRARIES), "FILE.py:CLASS")
    raise UnknownNameError("environment", name, (*_TASKS, *others))
