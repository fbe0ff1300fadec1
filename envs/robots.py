"""Running robots as data: MJCF, and the constants of Gym's reward, start and end."""

import dataclasses
import importlib.util
import math
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from taic_jax.envs.base import model_name
from taic_jax.envs.errors import MissingExtraError, ModelError, UnknownNameError
from taic_jax.envs.views import Signed

LIGHT = 0.1  # kg of whatever an ant pushes; HIRO's 0.2 and 1 g go through walls at a steady push


@dataclasses.dataclass(frozen=True)
class Robot:
    """A body and the constants of its tasks."""

    mjcf: tuple[str, str]  # package that ships it, path in it or of any file
    num_unobserved: int  # leading entries of qpos left out of obs: the place on the ground
    control_cost: float  # weight of |action|^2
    reset_noise: float  # half-width on qpos; see also velocity_noise
    velocity_noise: str = "uniform"  # of half-width reset_noise, or normal of that standard deviation
    substeps: int = 5  # engine steps a tick
    healthy_reward: float = 0.0  # a tick
    final_healthy_reward: bool = True  # also at the tick that ends unhealthy, as in Gym up to version 4
    height_index: int = 1  # entry of qpos that holds the torso's height ...
    root_height: float = 0.0  # m, ... above this
    healthy_height: tuple[float, float] = (-math.inf, math.inf)  # m; outside it the episode ends
    healthy_angle: float = math.inf  # rad, of a planar robot's pitch, qpos[2], or of a free one's axis to the vertical
    healthy_state: float = math.inf  # for every entry of qpos and qvel behind the first two
    velocity_limit: float = math.inf  # at which velocities are clipped in obs
    start_in_default_pose: bool = False  # and not in the model's numeric `init_qpos`
    keyframe: str = ""  # to start in, if not empty
    reach: float = 0.0  # rad from the start's angles, of position servos at an action of 1; 0 for motors
    episode_length: int = 1000  # ticks
    contacts: str = "feet"  # with the ground: of the ant's feet alone, or of the whole `body`; or the model's `own`
    pushes: float = LIGHT  # kg, of a block or a fence in its way
    proprioception: str = ""  # name of the slice of obs that its tasks share; empty for the task's
    # Settings of the engine; None for the model's own.
    timestep: float | None = None  # s
    integrator: mujoco.mjtIntegrator | None = None
    gear: float | None = None  # N m, of every motor at an action of 1
    iterations: int | None = None  # of MJX's solver; `experiments.benchmark.worlds --solver` measures both
    ls_iterations: int | None = 4  # of its line search
    # Obs and action from the next of `sides` equal sides of the body (see `views`).
    sides: int = 1
    turned_obs: Signed = ()
    turned_action: Signed = ()


def _brax(name: str) -> tuple[str, str]:
    return "brax", f"envs/assets/{name}.xml"


# A quarter turn to the left: each leg moves as the one to its right did. The ankles' axes point outwards on two
# opposite legs and inwards on the others, so that their angles change sign from leg to leg.
_TURNED_VECTOR: Signed = ((1, -1), (0, 1), (2, 1))  # x' = -y, y' = x, z' = z
_TURNED_LEGS: Signed = ((6, 1), (7, 1), (0, 1), (1, -1), (2, 1), (3, 1), (4, 1), (5, -1))  # hip and ankle, 1 to 4
_TURNED_MOTORS: Signed = ((6, 1), (7, -1), (0, 1), (1, 1), (2, 1), (3, -1), (4, 1), (5, 1))  # of legs 4, 1, 2, 3


def _behind(first: int, turned: Signed) -> Signed:
    return tuple((first + index, sign) for index, sign in turned)


_TURNED_OBS: Signed = (
    *((0, 1), (1, 1), *_behind(2, _TURNED_VECTOR), *_behind(5, _TURNED_LEGS)),  # height, quaternion, joints
    *(*_behind(13, _TURNED_VECTOR), *_behind(16, _TURNED_VECTOR), *_behind(19, _TURNED_LEGS)),  # their speeds
)
_HALF_CHEETAH = Robot(
    _brax("half_cheetah"), num_unobserved=1, control_cost=0.1, reset_noise=0.1, velocity_noise="normal"
)
_ANT = Robot(
    _brax("ant"), num_unobserved=2, control_cost=0.5, reset_noise=0.1, velocity_noise="normal", healthy_reward=1.0,
    height_index=2, healthy_height=(0.2, 1.0), proprioception="ant",
    sides=4, turned_obs=_TURNED_OBS, turned_action=_TURNED_MOTORS,
)  # fmt: skip
# Brax moved the root joints of hopper and walker2d into the torso, where its height of 1.25 m reads 0.
_HOPPER = Robot(
    _brax("hopper"), num_unobserved=1, control_cost=1e-3, reset_noise=5e-3, substeps=4, healthy_reward=1.0,
    root_height=1.25, healthy_height=(0.7, math.inf), healthy_angle=0.2, healthy_state=100.0, velocity_limit=10.0,
)  # fmt: skip
_WALKER2D = dataclasses.replace(
    _HOPPER, mjcf=_brax("walker2d"), healthy_height=(0.8, 2.0), healthy_angle=1.0, healthy_state=math.inf
)
_BRAX = {"half_cheetah": _HALF_CHEETAH, "ant": _ANT, "hopper": _HOPPER, "walker2d": _WALKER2D}


def _as_in_gym(robot: Robot, file: str) -> Robot:
    mjcf = "gymnasium", f"envs/mujoco/assets/{file}.xml"
    return dataclasses.replace(
        robot, mjcf=mjcf, root_height=0.0, final_healthy_reward=False, start_in_default_pose=True
    )


BODIES = ("gym", "hiro")  # Bodies of the ant, by the config's `env.body`.
BODY_BIT = 1  # of contype and conaffinity
CONTACTS = ("feet", "body")  # Geoms of the ant that touch the ground, by `env.contacts`.

# Robots by the config's `env.model`. `gym` is Gymnasium's own MJCF, integrator and rules of version 5, without the
# ant's contact forces, which MJX does not compute and which cost at most 42 an episode.
ROBOTS: dict[str, dict[str, Robot]] = {
    "brax": _BRAX,
    "gym": {name: _as_in_gym(robot, "walker2d_v5" if name == "walker2d" else name) for name, robot in _BRAX.items()},
}


def with_body(ant: Robot, body: str) -> Robot:
    """Return the ant with the body of `gym`, unchanged, or of `hiro`, with a fifth of its strength and longer ticks."""
    if body not in BODIES:
        raise UnknownNameError("body", body, BODIES)
    if body == "gym":
        return ant
    return dataclasses.replace(
        ant, start_in_default_pose=True, episode_length=500, proprioception="hiro_ant",
        timestep=0.02, integrator=mujoco.mjtIntegrator.mjINT_RK4, gear=30.0,
    )  # fmt: skip


def with_contacts(ant: Robot, contacts: str) -> Robot:
    """Return the ant whose `feet` alone touch the ground, unchanged, or all 13 geoms of its `body`, as in the arenas.

    Whoever lies on its back needs the body's: on feet alone it would sink into the floor.
    """
    if contacts not in CONTACTS:
        raise UnknownNameError("contacts", contacts, CONTACTS)
    if contacts == ant.contacts:
        return ant
    return dataclasses.replace(ant, contacts=contacts, iterations=4, ls_iterations=8)


def load_spec(robot: Robot) -> mujoco.MjSpec:
    """Read the MJCF from the package that ships it, without its slow import, or raise `MissingExtraError`."""
    package, path = robot.mjcf
    module = importlib.util.find_spec(package)
    if module is None or module.origin is None:
        raise MissingExtraError(package, "gym" if package == "gymnasium" else None)
    spec = mujoco.MjSpec.from_file(str(Path(module.origin).parent / path))
    if robot.timestep is not None:
        spec.option.timestep = robot.timestep
    if robot.integrator is not None:
        spec.option.integrator = robot.integrator
    for actuator in spec.actuators if robot.gear is not None else ():
        actuator.gear[0] = robot.gear
    if robot.contacts == "body":
        _touch_with_body(spec)
    if robot.keyframe:
        _start_in(spec, np.array(spec.key(robot.keyframe).qpos))
    return spec


def _start_in(spec: mujoco.MjSpec, pose: Float[np.ndarray, " nq"]) -> None:
    """Keep a pose as the numeric `init_qpos`, and its height as the default one; add a camera that follows.

    Keyframes go: they would not fit the model any more once something else moves in it.
    """
    spec.add_numeric(name="init_qpos", data=pose, size=len(pose))
    root, height = spec.worldbody.first_body(), pose[2]
    root.pos[2] = height
    for key in list(spec.keys):
        spec.delete(key)
    if spec.camera("track") is None:
        mode = mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM
        camera = root.add_camera(name="track", pos=(0, -7 * height, height), mode=mode)
        camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
        camera.alt.xyaxes = (1, 0, 0, 0, 0.15, 1)


def _touch_with_body(spec: mujoco.MjSpec) -> None:
    """Let the whole ant collide with whatever has `BODY_BIT` in its conaffinity, and with nothing of itself.

    The floor collides with the same shapes as with feet alone: the foot spheres are the ends of the ankles' capsules.
    """
    for geom in spec.geoms:
        if geom.name == "floor":
            geom.conaffinity = BODY_BIT
        else:
            is_foot = geom.type == mujoco.mjtGeom.mjGEOM_SPHERE and geom.name != "torso_geom"
            geom.contype, geom.conaffinity = (0, 0) if is_foot else (BODY_BIT, 0)


def compile_spec(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a model; replace the deprecated attribute `settotalmass` as MuJoCo recommends."""
    total_mass, spec.compiler.settotalmass = spec.compiler.settotalmass, -1
    model = spec.compile()
    if total_mass > 0:
        mujoco.mj_setTotalmass(model, total_mass)
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def initial_qpos(robot: Robot, model: mujoco.MjModel) -> Float[np.ndarray, " nq"]:
    """Return the pose in the model's custom numeric `init_qpos`, else its default pose."""
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_NUMERIC, "init_qpos")
    if index < 0 or robot.start_in_default_pose:
        return model.qpos0
    return model.numeric("init_qpos").data


def servo_angles(model: mujoco.MjModel, qpos: Float[np.ndarray, " n"]) -> Float[np.ndarray, " nu"]:
    """Return the angles that the servos hold in a pose; raise `ModelError` if an actuator is no servo of a joint."""
    of_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    is_servo = of_joint & (model.actuator_gainprm[:, 0] > 0) & (model.actuator_biasprm[:, 1] < 0)
    if not is_servo.all():
        index = int(np.argmin(is_servo))
        name = model.actuator(index).name or index
        raise ModelError(model_name(model), f"got actuator {name}, expected position servos of joints alone")
    return qpos[model.jnt_qposadr[model.actuator_trnid[:, 0]]]
