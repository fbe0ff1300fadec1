"""The three arenas of HIRO as data, and a robot's model in one of them.

Each is a rectangular room with at most three solids (a bar, pillars or platforms, all 4 m high) and at most one movable
block. The outer walls are four planes, the cheapest shape for collisions, and solids are boxes.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from taic_jax.envs.robots import BODY_BIT, LIGHT

SOLID_HEIGHT = 4.0  # m
TOLERANCE = 0.05  # m, by which a block may overrun its soft limits
FENCE = 2.0  # m from the robot at its start

# Bits of contype and conaffinity for pairs that may collide. The body collides with everything, a block with
# the solids that its arena names; elsewhere its joint limits stop it, and contacts would make it jam.
_BLOCK = 2
_GEOM = mujoco.mjtGeom

_GROUND, _BODY, _WALL = (0.5, 0.52, 0.5, 1), (0.95, 0.6, 0.1, 1), (0.55, 0.6, 0.68, 1)
_MOVABLE, _GOAL = (0.82, 0.45, 0.3, 1), (0.2, 0.7, 0.35, 1)


@dataclasses.dataclass(frozen=True)
class Slide:
    """One joint along which a block moves."""

    axis: tuple[float, float, float]
    limits: tuple[float, float]  # m
    damping: float  # N s/m, at the mass that an ant pushes


@dataclasses.dataclass(frozen=True)
class Block:
    """A box that the robot can push."""

    centre: tuple[float, float, float]  # m
    slides: tuple[Slide, ...]
    meets: tuple[int, ...]  # solids in its way
    half: tuple[float, float, float] = (3.96, 3.96, 2.0)  # m; a block as wide as its corridor would jam


Point = tuple[float, float, float]
Box = tuple[float, float, float, float]  # x_low, y_low, x_high, y_high


@dataclasses.dataclass(frozen=True)
class Arena:
    """A room, in m, with the robot's start at the origin of x and y."""

    room: Box
    solids: tuple[Box, ...]
    goal: tuple[float, ...]  # 2 coordinates, or 3 where height counts
    near_goal: tuple[float, ...] | None = None  # one without obstacles before it
    # A way to the goal: the place to go to next from anywhere in a rectangle, the first that one is in.
    ways: tuple[tuple[Box, tuple[float, float]], ...] = ()
    ground: float = 0.0  # height of the ground on which the robot starts
    block: Block | None = None


MAZE = Arena(  # the near goal is as far off, but at the end of the first corridor
    room=(-4.0, -4.0, 20.0, 20.0),
    solids=((-4.0, 4.0, 12.0, 12.0),),
    goal=(0.0, 16.0),
    near_goal=(16.0, 0.0),
    ways=(((-4, -4, 13, 4), (16, 0)), ((12, -4, 20, 13), (16, 16)), ((-4, 12, 20, 20), (0, 16))),
)
_ALONG_X, _ALONG_Y = Slide((1.0, 0.0, 0.0), (-8.0, 8.0), 1.0), Slide((0.0, 1.0, 0.0), (-8.0, 8.0), 1.0)
PUSH = Arena(
    room=(-12.0, -4.0, 12.0, 20.0),
    solids=((4.0, -4.0, 12.0, 4.0), (-12.0, 12.0, -4.0, 20.0), (4.0, 12.0, 12.0, 20.0)),
    goal=(0.0, 19.0),
    # Around the block to the left, push it to the right, and through the gap behind it.
    ways=(
        ((-5, -4, 4, 4), (-8, 0)),
        ((-12, -4, -5, 5), (-8, 8)),
        ((-12, 4, 1, 12), (4, 8)),
        ((-4, 4, 12, 20), (0, 19)),
    ),
    block=Block(centre=(0.0, 8.0, 2.0), slides=(_ALONG_X, _ALONG_Y), meets=(0, 1, 2)),
)
_FREE_X, _FREE_Y = (dataclasses.replace(slide, limits=(-2000.0, 2000.0)) for slide in (_ALONG_X, _ALONG_Y))
# The block of the fall may rise a little: a limit at 0 would press it against the platform. Its fall is not damped.
_DOWN = Slide((0.0, 0.0, 1.0), (-4.0, 0.1), 0.0)
FALL = Arena(
    room=(-4.0, -4.0, 12.0, 28.0),
    solids=((-4.0, -4.0, 12.0, 12.0), (-4.0, 20.0, 12.0, 28.0)),  # platforms before and behind a chasm 4 m deep
    goal=(0.0, 27.0, 4.5),
    # Push the block into the chasm, and go over it.
    ways=(((-4, -4, 5, 12), (8, 0)), ((4, -4, 12, 21), (8, 24)), ((-4, 12, 12, 28), (0, 27))),
    ground=4.0,
    block=Block(centre=(8.0, 8.0, 6.0), slides=(_ALONG_Y, _DOWN), meets=(0,)),
)


def furnish(spec: mujoco.MjSpec, arena: Arena, mass: float) -> None:
    """Put the robot of `spec`, with the contacts of its body, into the arena, with a block of that mass in kg."""
    for geom in spec.geoms:
        if geom.name == "floor":
            geom.material, geom.rgba = "", _GROUND
        elif not geom.meshname:  # meshes have their own colours
            geom.rgba = _BODY  # visible from above
    _add_walls(spec, arena)
    for i, (x_low, y_low, x_high, y_high) in enumerate(arena.solids):
        meets = BODY_BIT | (_BLOCK if arena.block and i in arena.block.meets else 0)
        pos = ((x_low + x_high) / 2, (y_low + y_high) / 2, SOLID_HEIGHT / 2)
        half = ((x_high - x_low) / 2, (y_high - y_low) / 2, SOLID_HEIGHT / 2)
        shape = {"type": _GEOM.mjGEOM_BOX, "pos": pos, "size": half, "rgba": _WALL}
        spec.worldbody.add_geom(name=f"solid_{i}", **shape, contype=0, conaffinity=meets)
    if arena.block:
        block = arena.block
        _add_movable(spec, "block", block.centre, block.slides, [((0.0, 0.0, 0.0), block.half)], mass)
    goal = (*arena.goal, arena.ground + 0.5)[:3]
    spec.worldbody.add_site(name="goal", pos=goal, size=[0.5] * 3, rgba=_GOAL)
    spec.worldbody.first_body().pos[2] += arena.ground
    _add_camera(spec, arena)


def is_open(arena: Arena, place: Float[Array, " 2"], width: float = 0.0) -> Bool[Array, ""]:
    """Return whether a robot can be at a place in the room: on a platform, or out of all solids.

    With a `width` in m it can start there: it has this distance from walls, edges and the block.
    """
    there = _is_within(arena.solids, place, -width) if arena.ground else ~_is_within(arena.solids, place, width)
    if not width:
        return there
    there &= _is_within((arena.room,), place, -width)
    if arena.block:
        (x, y, _), (half_x, half_y, _) = arena.block.centre, arena.block.half
        there &= ~_is_within(((x - half_x, y - half_y, x + half_x, y + half_y),), place, width)
    return there


def _is_within(boxes: Sequence[Box], place: Float[Array, " 2"], margin: float) -> Bool[Array, ""]:
    """Return whether a place is in one of some rectangles with this margin."""
    low, high = jnp.array(boxes).reshape(-1, 2, 2).swapaxes(0, 1)
    return jnp.any(jnp.all((low - margin < place[None]) & (place[None] < high + margin), axis=1))


def outside(arena: Arena, qpos: Float[np.ndarray, "*batch nq"]) -> int:
    """Count the states in which the torso is out of the room or in a solid, or the block beyond its limits."""
    x, y, z = np.moveaxis(qpos[..., :3], -1, 0)
    x_low, y_low, x_high, y_high = arena.room
    wrong = (x < x_low) | (x > x_high) | (y < y_low) | (y > y_high) | (z < 0)
    for a, b, c, d in arena.solids:
        wrong |= (x > a) & (x < c) & (y > b) & (y < d) & (z < SOLID_HEIGHT)
    slides = arena.block.slides if arena.block else ()
    for slide, along in zip(slides, np.moveaxis(qpos[..., qpos.shape[-1] - len(slides) :], -1, 0), strict=True):
        low, high = slide.limits
        wrong |= (along < low - TOLERANCE) | (along > high + TOLERANCE)
    return int(wrong.sum())


def _add_walls(spec: mujoco.MjSpec, arena: Arena) -> None:
    x_low, y_low, x_high, y_high = arena.room
    x, y, height = (x_low + x_high) / 2, (y_low + y_high) / 2, arena.ground + SOLID_HEIGHT
    sides = {
        "west": ((x_low, y), (1, 0)), "south": ((x, y_low), (0, 1)),
        "east": ((x_high, y), (-1, 0)), "north": ((x, y_high), (0, -1)),
    }  # fmt: skip
    for name, (place, inward) in sides.items():
        half_length = (y_high - y_low if inward[0] else x_high - x_low) / 2
        shape = {"type": _GEOM.mjGEOM_PLANE, "pos": (*place, height / 2), "size": (height / 2, half_length, 1)}
        wall = spec.worldbody.add_geom(name=name, **shape, rgba=_WALL, contype=0, conaffinity=BODY_BIT)
        # A plane's normal is its z axis; its x axis, the first of its sizes in a picture, points up.
        wall.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
        wall.alt.xyaxes = (0, 0, 1, inward[1], -inward[0], 0)


def enclose(spec: mujoco.MjSpec, mass: float) -> None:
    """Put a light fence of that mass in kg around the robot, which it pushes along wherever it goes."""
    away, thin, wide, high = FENCE + 0.25, 0.25, FENCE + 0.5, SOLID_HEIGHT / 2
    sides = [((x, 0.0, 0.0), (thin, wide, high)) for x in (away, -away)]
    sides += [((0.0, y, 0.0), (wide, thin, high)) for y in (away, -away)]
    _add_movable(spec, "fence", (0.0, 0.0, high), (_FREE_X, _FREE_Y), sides, mass)
    for geom in spec.body("fence").geoms:
        geom.rgba[3] = 0.2  # or it hides the robot


def _add_movable(
    spec: mujoco.MjSpec, name: str, centre: Point, slides: Sequence[Slide], boxes: Sequence[tuple[Point, Point]],
    mass: float,
) -> None:  # fmt: skip
    """Add a body of boxes, each given by its centre from the body's and its half sizes; it does not touch the floor."""
    for geom in spec.geoms:
        if geom.name == "floor":
            geom.contype = 0
    body = spec.worldbody.add_body(name=name, pos=centre)
    for i, slide in enumerate(slides):
        body.add_joint(
            name=f"{name}_{i}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=slide.axis, armature=0,
            limited=mujoco.mjtLimited.mjLIMITED_TRUE, range=slide.limits, damping=[slide.damping * mass / LIGHT, 0, 0],
        )  # fmt: skip
    for i, (pos, half) in enumerate(boxes):
        shape = {"type": _GEOM.mjGEOM_BOX, "pos": pos, "size": half, "mass": mass / len(boxes), "rgba": _MOVABLE}
        body.add_geom(name=f"{name}_{i}", **shape, contype=_BLOCK, conaffinity=BODY_BIT)


def _add_camera(spec: mujoco.MjSpec, arena: Arena) -> None:
    """Add a camera above the whole room, tilted a little so that heights are visible."""
    x_low, y_low, x_high, y_high = arena.room
    tilt, away = np.deg2rad(17), 1.35 * max(y_high - y_low, 0.8 * (x_high - x_low))
    pos = ((x_low + x_high) / 2, (y_low + y_high) / 2 - away * np.sin(tilt), arena.ground + away * np.cos(tilt))
    camera = spec.worldbody.add_camera(name="arena", pos=pos)
    camera.alt.type = mujoco.mjtOrientation.mjORIENTATION_XYAXES
    camera.alt.xyaxes = (1, 0, 0, 0, np.cos(tilt), np.sin(tilt))
