"""Tasks in three dimensions, for viewers: a MuJoCo model, and the pose in a state of the physics."""

from collections.abc import Callable
from operator import attrgetter
from typing import Any

import mujoco
import numpy as np

from taic_jax.envs.adapters.brax import BraxEnv
from taic_jax.envs.adapters.playground import PlaygroundEnv
from taic_jax.envs.base import Env
from taic_jax.envs.locomotion import Locomotion
from taic_jax.envs.navigation import GOAL, GOAL_RADIUS, ROOM, Navigation
from taic_jax.envs.wrappers import Wrapper

Scene = tuple[mujoco.MjModel, Callable[[Any], Any]]
"""A model, and the function from `State.physics` to its poses [..., nq]."""

PLANE = mujoco.mjtGeom.mjGEOM_PLANE


def make_scene(env: Env) -> Scene | None:
    """Return the scene of a task of ours, of Brax or of Playground; None for others, whose model is not known."""
    while isinstance(env, Wrapper):
        env = env.env
    match env:
        case Locomotion():
            return env.model, attrgetter("qpos")
        case Navigation():
            return _room(env), attrgetter("position")
        case BraxEnv():
            return env.inner.sys.mj_model, attrgetter("simulation.q")
        case PlaygroundEnv():
            return env.inner.mj_model, attrgetter("simulation.qpos")


def place_bodies(model: mujoco.MjModel, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return positions [T, N, bodies, 3] and quaternions [T, N, bodies, 4] of all bodies in poses [T, N, nq]."""
    data, shape = mujoco.MjData(model), (*poses.shape[:2], model.nbody)
    places, turns = np.zeros((*shape, 3), np.float32), np.zeros((*shape, 4), np.float32)
    for row in np.ndindex(shape[:2]):
        data.qpos[:] = poses[row]
        mujoco.mj_kinematics(model, data)
        places[row], turns[row] = data.xpos, data.xquat
    return places, turns


def _room(env: Navigation) -> mujoco.MjModel:
    """Return the room with the walls of its first episode, the goal if it is fixed, and the point as a ball."""
    spec, kind, middle = mujoco.MjSpec(), mujoco.mjtGeom, [ROOM / 2, ROOM / 2, 0.0]
    spec.stat.extent, spec.stat.center, add = 2.2 * ROOM, middle, spec.worldbody.add_geom
    add(type=kind.mjGEOM_PLANE, size=[*middle[:2], 1.0], pos=middle)
    for x, y, right, top in np.asarray(env.walls, float)[env._standing(np.zeros(1, np.int32))]:
        add(type=kind.mjGEOM_BOX, size=[(right - x) / 2, (top - y) / 2, 0.3], pos=[(x + right) / 2, (y + top) / 2, 0.3])
    if not env.random_ends:
        green = [0.23, 0.62, 0.36, 1.0]
        add(type=kind.mjGEOM_CYLINDER, size=[GOAL_RADIUS, 0.01, 0.0], pos=[*GOAL, 0.01], rgba=green)
    point = spec.worldbody.add_body(name="point", pos=[0.0, 0.0, 0.2])
    point.add_geom(type=kind.mjGEOM_SPHERE, size=[0.2, 0.0, 0.0])
    for name, axis in (("x", [1, 0, 0]), ("y", [0, 1, 0])):
        point.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    return spec.compile()
