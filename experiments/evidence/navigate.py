"""A navigator without learning, which leads an ant through an arena by its options: a gate before long runs.

Codes are measured on open ground. Then, at every decision, the navigator takes the one that leads best to the next
place on the arena's way, and seldom overturns the ant; options that are chosen by their way are given it. An arena is
within reach of a policy over these options if it is within reach of the navigator.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from taic_jax.analysis.option_space import always
from taic_jax.envs.ant_tasks import BODY_WIDTH, SUCCESS_RADIUS
from taic_jax.envs.arenas import SOLID_HEIGHT, Arena
from taic_jax.envs.base import Env, State
from taic_jax.envs.orientation import upside_down
from taic_jax.envs.wrappers import AutoReset, Wrapper
from taic_jax.options.execution import Executor
from taic_jax.options.frame import Frame
from taic_jax.rl.rollout import Rollout, rollout, start

CODES, STARTS, SECONDS = 128, 16, 6.0
"""Codes that the navigator chooses among, starts of each, and the time under one code."""
WARM_UP = 1.0  # s under another code, so that starts differ
EPISODES = 64
ROUND = 1.5  # m, radius of the round about the goal
RISK = 4.0  # m/s of speed that an overturned ant in every start is worth


class Compass(NamedTuple):
    """Codes [M, D], and of each the velocity [M, 2] in m/s at which it leads, in the frame of the options; `agreement`
    [M] of its ways from several starts, the length of the mean of their unit vectors; `overturned` [M], a share of all.
    """

    codes: Array
    velocity: Array
    agreement: Array
    overturned: Array


class Unending(Wrapper):
    """A task that continues after a fall, as the arenas do; it counts unhealthy ticks, and those on the back."""

    def reset(self, key: Key[Array, ""]) -> State:
        state = self.env.reset(key)
        return state.replace(metrics={"unhealthy": jnp.zeros(()), "upside_down": jnp.zeros(())})

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        after = self.env.step(state, action)
        flags = {"unhealthy": after.terminated, "upside_down": upside_down(after.physics.qpos[3:7])}
        metrics = {name: flag.astype(jnp.float32) for name, flag in flags.items()}
        return after.replace(terminated=jnp.zeros((), bool), metrics=metrics)


@partial(jax.jit, static_argnums=(0, 2))
def measure_codes(env: Env, executor: Executor, frame: Frame | None, key: Key[Array, ""]) -> Compass:
    """Measure codes from the prior, each from several starts on open ground."""
    key_codes, key_start, key_warm_up, key_run = jax.random.split(key, 4)
    env = AutoReset(Unending(env))
    codes, others = jax.random.normal(key_codes, (2, CODES, executor.option_size))
    repeated, before = (
        jnp.repeat(x, STARTS, axis=0) for x in (codes, others[jax.random.permutation(key_warm_up, CODES)])
    )
    begin = start(env, executor, CODES * STARTS, key_start)
    begin, _ = rollout(env, executor, partial(always, before), begin, key_warm_up, round(WARM_UP / env.dt))
    upright = begin.env.metrics["upside_down"] == 0.0
    begin = begin.replace(ended=jnp.ones_like(begin.ended))
    ticks = round(SECONDS / env.dt)
    after, run = rollout(env, executor, partial(always, repeated), begin, key_run, ticks)
    obs = run.obs[..., : env.proprioceptive_size]
    turning = Frame(env.heading, bool(frame and frame.turns), 1)
    ways = jnp.sum(turning.way(obs, obs), axis=0)
    over = after.env.metrics["upside_down"]
    stood = upright.astype(jnp.float32).reshape(CODES, STARTS)
    ways, over = ways.reshape(CODES, STARTS, 2), over.reshape(CODES, STARTS) * stood
    units = ways / jnp.maximum(jnp.linalg.norm(ways, axis=-1, keepdims=True), 1e-6)
    count = jnp.maximum(jnp.sum(stood, axis=1), 1.0)
    mean = [jnp.sum(x * stood[..., None], axis=1) / count[:, None] for x in (ways / SECONDS, units)]
    return Compass(codes, mean[0], jnp.linalg.norm(mean[1], axis=-1), jnp.sum(over, axis=1) / count)


def way_of(arena: Arena, place: Float[Array, "B 2"]) -> Float[Array, "B 2"]:
    """Return the direction in which to go from these places; near the goal round it, since options do not stop."""
    target, goal = next_place(arena, place), jnp.array(arena.goal[:2])[None]
    low, high = jnp.array(arena.room).reshape(2, 1, 2)
    centre = jnp.clip(goal, low + ROUND + BODY_WIDTH, high - ROUND - BODY_WIDTH)
    last = jnp.all(target == goal, axis=1, keepdims=True)
    way = jnp.where(last, centre, target) - place
    distance = jnp.maximum(jnp.linalg.norm(way, axis=1, keepdims=True), 1e-6)
    inward = jnp.where(last, jnp.clip(distance / ROUND - 1.0, -1.0, 1.0), 1.0)
    side = jnp.stack([-way[:, 1], way[:, 0]], axis=1)
    return (inward * way + jnp.sqrt(1.0 - inward**2) * side) / distance


def next_place(arena: Arena, place: Float[Array, "B 2"]) -> Float[Array, "B 2"]:
    """Return where to go next from these places; outside all rectangles to the goal."""
    boxes, places = (np.array(x, np.float32) for x in zip(*arena.ways, strict=True))
    low, high = boxes[None, :, :2], boxes[None, :, 2:]
    inside = jnp.all((low <= place[:, None]) & (place[:, None] <= high), axis=-1)
    found = jnp.asarray(places)[jnp.argmax(inside, axis=1)]
    return jnp.where(jnp.any(inside, axis=1)[:, None], found, jnp.asarray(arena.goal[:2], jnp.float32)[None])


@partial(jax.jit, static_argnums=(0, 3))
def navigate(
    env: Any, executor: Executor, compass: Compass | None, frame: Frame | None, key: Key[Array, ""]
) -> Rollout:
    """Return an episode each of several ants that the compass leads, or that are given the way if there is none.

    The extras are metrics, and places [T, B, 2].
    """
    size, turning = env.proprioceptive_size, Frame(env.heading, bool(frame and frame.turns), 1)

    def decide(obs: Array, noise: Array) -> tuple[Array, Array]:
        place = obs[:, size : size + 2]
        way = way_of(env.arena, place)
        if compass is None:
            return way, jnp.zeros(len(obs))
        way = turning.turned(way, obs[:, :size])
        score = way @ compass.velocity.T - RISK * compass.overturned[None]
        return compass.codes[jnp.argmax(score, axis=1)], jnp.zeros(len(obs))

    key_start, key_run = jax.random.split(key)
    env = AutoReset(env.evaluated)
    begin = start(env, executor, EPISODES, key_start)
    keep = lambda state: (state.metrics, state.physics.qpos[..., :2])  # noqa: E731
    return rollout(env, executor, decide, begin, key_run, env.episode_length - 1, keep)[1]


def measures_of(ticks: Rollout, dt: float) -> dict[str, float]:
    """Return the measures of navigated episodes."""
    metrics, place = jax.device_get(ticks.extras)
    over = metrics["upside_down"] > 0.5
    return {
        "success": float((metrics["distance"][-1] < SUCCESS_RADIUS).mean()),
        "ever": float((metrics["closest_approach"][-1] < SUCCESS_RADIUS).mean()),
        "final_distance": float(metrics["distance"][-1].mean()),
        "speed": float(np.linalg.norm(place[20:] - place[:-20], axis=-1)[~over[20:]].mean() / (20 * dt)),
        "overturned_per_1000": onsets_per_1000(over),
        "overturned": float(over[-1].mean()),
    }


def onsets_per_1000(flag: Bool[np.ndarray, "T B"]) -> float:
    """Return how often in 1000 ticks a flag rises."""
    return float(1000 * (flag[1:] & ~flag[:-1]).sum() / flag.size)


def measures_of_codes(compass: Compass) -> dict[str, float]:
    """Return the measures of a compass: medians of speed and agreement, the share of starts overturned, and the widest
    angle in degrees in which no fast and safe code leads."""
    speed, overturned = np.linalg.norm(compass.velocity, axis=-1), np.asarray(compass.overturned)
    angle = np.degrees(np.arctan2(compass.velocity[:, 1], compass.velocity[:, 0]))
    safe = (speed > 1.0) & (overturned < 0.1)
    ordered = np.sort(angle[safe])
    gaps = np.diff(np.append(ordered, ordered[:1] + 360))
    return {
        "speed": float(np.median(speed)),
        "agreement": float(np.median(compass.agreement)),
        "overturned": float(overturned.mean()),
        "widest_gap": float(gaps.max(initial=0.0)) if safe.any() else 360.0,
    }


def straight(arena: Arena, speed: float, seconds: float) -> float:
    """Return the distance from the goal in m of a point that goes straight to it, to the first wall or chasm."""
    goal = np.array(arena.goal[:2])
    steps = np.linspace(0, 1, 1000)[:, None] * min(speed * seconds / np.linalg.norm(goal), 1.0) * goal
    boxes = [*arena.solids]
    if arena.block:
        (x, y, _), (half_x, half_y, _) = arena.block.centre, arena.block.half
        boxes.append((x - half_x, y - half_y, x + half_x, y + half_y))
    within = np.zeros((len(boxes), len(steps)), bool)
    for i, (a, b, c, d) in enumerate(boxes):
        within[i] = (steps[:, 0] > a) & (steps[:, 0] < c) & (steps[:, 1] > b) & (steps[:, 1] < d)
    on_platforms = arena.ground >= SOLID_HEIGHT  # there solids are the ground, and a chasm is between them
    blocked = ~within[: len(arena.solids)].any(axis=0) if on_platforms else within.any(axis=0)
    last = np.argmax(blocked) - 1 if blocked.any() else len(steps) - 1
    return float(np.linalg.norm(goal - steps[last]))
