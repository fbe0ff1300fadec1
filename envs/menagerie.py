"""Legged robots of MuJoCo Menagerie, from the package that downloads and keeps them, as data."""

import importlib
from pathlib import Path
from typing import Any

import mujoco

from taic_jax.envs.adapters.admission import extra
from taic_jax.envs.errors import ModelError, UnknownNameError
from taic_jax.envs.robots import Robot

MENAGERIE_PREFIX = "menagerie:"
LEGGED = ("quadruped", "humanoid", "biped")  # Categories of Menagerie.
POSES = ("home", "standing", "stand")  # Keyframes to start in; of several, the first.
TICK, TIMESTEP = 0.02, 0.004  # s


def menagerie_robot(name: str) -> Robot:
    """Return a robot by its folder in Menagerie, `unitree_go2`, or the folder's ending, `go2`.

    It is downloaded at its first use, unless the environment variable `MENAGERIE_ROOT` names a checkout. If it has a
    scene for MJX, which has fewer contacts, that is taken.

    Raises:
      MissingExtraError: the package is not installed.
      UnknownNameError: there is no such robot with legs.
      ModelError: it cannot be downloaded, or `legged_robot` refuses it.
    """
    with extra("menagerie"):
        package: Any = importlib.import_module("mujoco_menagerie")
    legged = [robot.name for category in LEGGED for robot in package.robots(category)]
    folders = [folder for folder in legged if folder == name or folder.endswith(f"_{name}")]
    if len(folders) != 1:
        raise UnknownNameError("robot", MENAGERIE_PREFIX + name, [MENAGERIE_PREFIX + folder for folder in legged])
    name, robot = MENAGERIE_PREFIX + folders[0], package.get(folders[0])
    try:
        path = robot.xml("scene_mjx" if "scene_mjx" in robot.entry_names else None)
    except package.MenagerieError as error:
        raise ModelError(name, f"{error}; expected a network, or a checkout in MENAGERIE_ROOT") from error
    return legged_robot(path, name)


def legged_robot(path: Path, name: str) -> Robot:
    """Return the robot of an MJCF with a free root first, position servos, a geom `floor` and a keyframe to start in.

    Limits of health are fractions of its height there, and what it pushes has a tenth of its mass.

    Raises:
      ModelError: there is no such keyframe, or MuJoCo cannot read the file.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ModelError(name, " ".join(str(error).split())) from error
    poses = {key.name: key.qpos for key in spec.keys}
    keyframe = next((pose for pose in POSES if pose in poses), None)
    if keyframe is None:
        raise ModelError(name, f"got keyframes {', '.join(poses) or 'none'}, expected one of {', '.join(POSES)}")
    height, mass = poses[keyframe][2], sum(body.mass for body in spec.bodies)
    return Robot(
        ("mujoco", str(path.resolve())), num_unobserved=2, control_cost=0.05, reset_noise=0.02,
        substeps=round(TICK / TIMESTEP), timestep=TIMESTEP, healthy_reward=1.0, final_healthy_reward=False,
        height_index=2, healthy_height=(0.6 * height, 2.0 * height), healthy_angle=0.8, contacts="own",
        pushes=0.1 * mass, proprioception=name, ls_iterations=None, keyframe=keyframe, reach=0.5,
    )  # fmt: skip
