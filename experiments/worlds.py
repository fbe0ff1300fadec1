"""Measure every task on every backend beside the bare engine; MJX's solver settings; ants let loose.

python -m taic_jax.experiments.worlds --json worlds.json
python -m taic_jax.experiments.worlds --solver --tasks ant ant_push
python -m taic_jax.experiments.worlds --soak --length 1000
"""

import dataclasses
import json
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from taic_jax import envs
from taic_jax.command_line import tell
from taic_jax.envs.arenas import outside
from taic_jax.envs.physics.mjx import MjxPhysics
from taic_jax.envs.physics.mujoco import MujocoPhysics
from taic_jax.envs.third_party import third_party
from taic_jax.experiments.loops import bare_engine, stepping
from taic_jax.experiments.turns import Loop, take_turns
from taic_jax.runtime.program_cache import keep_programs

ROUNDS = 7
ARENAS = ("ant_maze", "ant_push", "ant_fall")
SETTINGS = ((1, 4), (2, 4), (4, 4), (4, 8), (4, 50), (8, 8))  # iterations, ls_iterations


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Print the table of all tasks and backends, or of MJX's solver settings."""

    tasks: tuple[str, ...] = ()
    """Tasks to measure; by default all."""
    backends: tuple[str, ...] = ("mujoco", "mjx")
    """Backends to measure."""
    num_envs: int = 1024
    """Environments on mujoco."""
    num_envs_mjx: int = 64
    """Environments on mjx."""
    length: int = 64
    """Ticks per environment and measurement on mujoco; mjx makes a quarter of them."""
    solver: bool = False
    """Measure MJX's solver settings instead: speed, and error of a tick against the C engine."""
    soak: bool = False
    """Let random ants loose in the arenas instead, and count those that leave them."""
    json: Path | None = None
    """Also write the table to this file."""


def plain_mjx(env: envs.Env, actions: jax.Array) -> Callable[[], Any]:
    """Return a compiled loop of `mjx.step` with the same model and settings, that keeps the whole `mjx.Data`."""
    with third_party():
        from mujoco import mjx
    data = jax.tree.map(lambda x: jnp.broadcast_to(x, (actions.shape[1], *jnp.shape(x))), env.physics._data)
    actions = jnp.repeat(actions, env.physics.substeps, axis=0)

    def run(data: Any) -> Any:
        with third_party():
            step = jax.vmap(lambda data, ctrl: mjx.step(env.physics._model, data.replace(ctrl=ctrl)))
            return jax.lax.scan(lambda data, ctrl: (step(data, ctrl), None), data, actions)[0]

    compiled = jax.jit(run)
    return lambda: jax.block_until_ready(compiled(data))


def _random_actions(env: envs.Env, num_envs: int, length: int) -> jax.Array:
    return jax.random.uniform(jax.random.key(1), (length, num_envs, env.action_size), minval=-1.0)


def measure(arguments: Arguments, task: str, backend: str) -> dict[str, Any]:
    """Return one row: sizes, possible contacts, ticks per second, and the ratio to the bare engine."""
    env = envs.make_env(task, backend)
    num_envs, length = arguments.num_envs, arguments.length
    if backend in ("mjx", "warp"):
        num_envs, length = arguments.num_envs_mjx, arguments.length // 4
    row = {"task": task, "backend": backend, "obs": env.observation_size, "act": env.action_size, "envs": num_envs}
    actions = _random_actions(env, num_envs, length)
    loops = [Loop("ours", stepping(env, actions), actions[..., 0].size)]
    if hasattr(env.env, "physics"):
        row["contacts"] = possible_contacts(env)
        bares = {"mujoco": bare_engine, "mjx": plain_mjx}  # Warp's data cannot be handed in by the batch
        if backend in bares:
            loops.append(Loop("bare", bares[backend](env, actions), actions[..., 0].size))
    speeds = take_turns(loops, ROUNDS)
    row["ticks_per_second"] = speeds["ours"].median
    if "bare" in speeds:
        row["bare"] = speeds["bare"].median
        row["ratio"] = speeds["ours"].ratio(speeds["bare"])
    return row


def soak(arguments: Arguments, task: str, backend: str) -> dict[str, Any]:
    """Return how many states of `num_envs_mjx` ants in `length` ticks are outside their arena or not finite."""
    env = envs.AutoReset(envs.make_env(task, backend))
    num_envs = arguments.num_envs_mjx
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), num_envs))
    actions = _random_actions(env, num_envs, arguments.length)
    step = jax.vmap(env.step)

    def tick(state: envs.State, action: jax.Array) -> tuple[envs.State, jax.Array]:
        state = step(state, action)
        return state, state.physics.qpos

    qpos = np.asarray(jax.jit(lambda state: jax.lax.scan(tick, state, actions)[1])(state))
    return {
        "task": task, "backend": backend, "states": num_envs * arguments.length,
        "outside": outside(env.arena, qpos), "nan": int(np.isnan(qpos).sum()),
    }  # fmt: skip


def possible_contacts(env: envs.Env) -> int:
    """Count the contacts that MJX computes at every engine step."""
    with third_party():
        from mujoco import mjx

        return mjx.make_data(env.model, impl="jax")._impl.contact.dist.shape[0]


def measure_solver(task: str, num_envs: int, length: int) -> Iterator[dict[str, Any]]:
    """Yield one row per setting: speed, and the error in qvel of a tick from states with contacts."""
    env = envs.make_env(task, "mujoco")
    exact = env.physics
    state = _moving_states(env, exact, num_envs)
    ctrl = _random_actions(env, num_envs, 1)[0]
    expected = jax.vmap(exact.step)(state, ctrl)
    for iterations, ls_iterations in SETTINGS:
        physics = MjxPhysics(env.model, env.physics.substeps, iterations, ls_iterations)
        step = jax.jit(jax.vmap(physics.step))
        error = jnp.abs(step(state, ctrl).qvel - expected.qvel).max(axis=1)
        loop = jax.jit(lambda state, step=step: jax.lax.fori_loop(0, length, lambda _, s: step(s, ctrl), state))
        run = partial(lambda loop: jax.block_until_ready(loop(state)), loop)
        speeds = take_turns([Loop("loop", run, num_envs * length)], ROUNDS)["loop"]
        yield {
            "task": task, "iterations": iterations, "ls_iterations": ls_iterations,
            "ticks_per_second": speeds.median,
            "median_error": float(jnp.median(error)), "worst_error": float(jnp.max(error)),
        }  # fmt: skip


def _moving_states(env: envs.Env, physics: MujocoPhysics, num_envs: int) -> envs.PhysicsState:
    """Return states after 50 ticks of random actions."""
    state = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), num_envs)).physics
    actions = _random_actions(env, num_envs, 50)
    return jax.jit(lambda s: jax.lax.scan(lambda s, a: (jax.vmap(physics.step)(s, a), None), s, actions)[0])(state)


def show(row: dict[str, Any]) -> None:
    """Print one row."""
    texts = [f"{value:,.4g}" if isinstance(value, float) else str(value) for value in row.values()]
    print(
        f"{texts[0]:12}",
        *(f"{name} {text}" for name, text in zip(list(row)[1:], texts[1:], strict=True)),
        sep="  ",
        flush=True,
    )


def main() -> None:
    """Print the table."""
    arguments = tyro.cli(Arguments)
    keep_programs()
    tasks = arguments.tasks or (ARENAS if arguments.soak else envs.environment_names())
    rows = []
    for task in tasks:
        has_engine = hasattr(envs.make_env(task).env, "physics")
        if arguments.solver and not has_engine:
            continue
        if arguments.solver:
            found = measure_solver(task, arguments.num_envs_mjx, arguments.length // 4)
        else:
            engines = arguments.backends if has_engine else ("auto",)
            row_of = soak if arguments.soak else measure
            found = (row_of(arguments, task, backend) for backend in engines)
        for row in found:
            show(row)
            rows.append(row)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    sys.exit(tell(main))
