"""Measure every task on every backend beside the bare engine; MJX's solver settings; ants that leave their arena.

python -m taic_jax.experiments.benchmark.worlds --json worlds.json
python -m taic_jax.experiments.benchmark.worlds --solver --tasks ant ant_push
python -m taic_jax.experiments.benchmark.worlds --soak --length 1000
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from taic_jax import envs
from taic_jax.envs.arenas import outside
from taic_jax.envs.physics.mjx import MjxPhysics
from taic_jax.envs.third_party import third_party
from taic_jax.experiments.benchmark.command import Command, Row, answer, show
from taic_jax.experiments.benchmark.loops import bare_engine, random_actions, stepping
from taic_jax.experiments.benchmark.timing import Loop, interleave

ROUNDS = 7
ARENAS = ("ant_maze", "ant_push", "ant_fall")
SETTINGS = ((1, 4), (2, 4), (4, 4), (4, 8), (4, 50), (8, 8))  # iterations, ls_iterations


@dataclass(frozen=True)
class Arguments(Command):
    """Print the table of all tasks and backends, or of MJX's solver settings."""

    tasks: tuple[str, ...] = ()  # Tasks to measure; by default all.
    backends: tuple[str, ...] = ("mujoco", "mjx")  # Backends to measure.
    num_envs: int = 1024  # Environments on mujoco.
    num_envs_mjx: int = 64  # Environments on mjx.
    length: int = 64  # Ticks per environment and measurement on mujoco; mjx makes a quarter of them.
    solver: bool = False  # Measure MJX's solver settings instead: speed, and error of a tick against the C engine.
    soak: bool = False  # Let ants act at random in the arenas instead, and count those that leave them.


def plain_mjx(env: envs.Env, actions: jax.Array) -> Loop:
    """Return a compiled loop of `mjx.step` on the whole `mjx.Data`, with the same model and settings."""
    with third_party():
        from mujoco import mjx
    data = jax.tree.map(lambda x: jnp.broadcast_to(x, (actions.shape[1], *jnp.shape(x))), env.physics._data)
    controls = jnp.repeat(actions, env.physics.substeps, axis=0)

    def run(data: Any) -> Any:
        with third_party():
            step = jax.vmap(lambda data, ctrl: mjx.step(env.physics._model, data.replace(ctrl=ctrl)))
            return jax.lax.scan(lambda data, ctrl: (step(data, ctrl), None), data, controls)[0]

    return Loop(partial(jax.jit(run), data), actions[..., 0].size)


BARE = {"mujoco": bare_engine, "mjx": plain_mjx}  # Warp has none: its data cannot be passed in as a batch.


def measure(arguments: Arguments, task: str, backend: str) -> Row:
    """Return one row: sizes, possible contacts, ticks per second, and the ratio to the bare engine."""
    env = envs.make_env(task, backend)
    num_envs, length = arguments.num_envs, arguments.length
    if backend in ("mjx", "warp"):
        num_envs, length = arguments.num_envs_mjx, arguments.length // 4
    row = {"task": task, "backend": backend, "obs": env.observation_size, "act": env.action_size, "envs": num_envs}
    row |= {"contacts": possible_contacts(env)} if hasattr(env, "physics") else {}
    actions = random_actions(env, num_envs, length)
    loops = {"ours": stepping(env, actions)}
    if hasattr(env, "physics") and backend in BARE:
        loops["bare"] = BARE[backend](env, actions)
    ours, *bare = interleave(loops, ROUNDS).values()
    row["ticks_per_second"] = ours.median
    return row | ({"bare": bare[0].median, "ratio": ours.ratio(bare[0])} if bare else {})


def soak(arguments: Arguments, task: str, backend: str) -> Row:
    """Count the states of `num_envs_mjx` ants in `length` ticks that are outside their arena or not finite."""
    env = envs.make_env(task, backend)
    actions = random_actions(env, arguments.num_envs_mjx, arguments.length)
    qpos = np.asarray(stepping(env, actions, lambda before, action, after: after.physics.qpos).run()[1])
    counts = {"states": actions[..., 0].size, "outside": outside(env.arena, qpos), "nan": int(np.isnan(qpos).sum())}
    return {"task": task, "backend": backend} | counts


def possible_contacts(env: envs.Env) -> int:
    """Count the contacts that MJX computes at every engine step."""
    with third_party():
        from mujoco import mjx

        return mjx.make_data(env.model, impl="jax")._impl.contact.dist.shape[0]


def measure_solver(task: str, num_envs: int, length: int) -> Iterator[Row]:
    """Yield one row per setting: speed, and the error in qvel of a tick from states with contacts.

    The states are those after 50 ticks of random actions, without resets.
    """
    env = envs.make_env(task, "mujoco")
    exact = jax.vmap(env.physics.step)
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), num_envs)).physics
    ctrl, actions = random_actions(env, num_envs, 1)[0], random_actions(env, num_envs, 50)
    state = jax.jit(lambda state: jax.lax.scan(lambda s, a: (exact(s, a), None), state, actions)[0])(state)
    expected = exact(state, ctrl)
    for iterations, ls_iterations in SETTINGS:
        step = jax.vmap(MjxPhysics(env.model, env.physics.substeps, iterations, ls_iterations).step)
        error = jnp.abs(jax.jit(step)(state, ctrl).qvel - expected.qvel).max(axis=1)
        loop = jax.jit(lambda state, step=step: jax.lax.fori_loop(0, length, lambda _, s: step(s, ctrl), state))
        speeds = interleave({"loop": Loop(partial(loop, state), num_envs * length)}, ROUNDS)["loop"]
        yield {
            "task": task, "iterations": iterations, "ls_iterations": ls_iterations,
            "ticks_per_second": speeds.median,
            "median_error": float(jnp.median(error)), "worst_error": float(jnp.max(error)),
        }  # fmt: skip


def rows(arguments: Arguments) -> Iterator[Row]:
    """Yield each row of the table as it is measured."""
    for task in arguments.tasks or (ARENAS if arguments.soak else envs.environment_names()):
        has_physics = hasattr(envs.make_env(task), "physics")
        if arguments.solver:
            yield from measure_solver(task, arguments.num_envs_mjx, arguments.length // 4) if has_physics else ()
            continue
        for backend in arguments.backends if has_physics else ("auto",):
            yield (soak if arguments.soak else measure)(arguments, task, backend)


def main(args: Sequence[str] | None = None) -> int:
    """Print the table and return the exit code."""
    return answer(Arguments, lambda arguments: show(rows(arguments)), args)


if __name__ == "__main__":
    sys.exit(main())
