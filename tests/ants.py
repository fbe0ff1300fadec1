"""Ants on MuJoCo's C engine: their tasks, jitted over a batch, from anywhere."""

import functools

import jax
import jax.numpy as jnp

from taic_jax.envs import make_env


@functools.cache
def task(name: str, **options):
    """Return the task on MuJoCo's C engine, and its jitted functions over a batch."""
    env = make_env(name, "mujoco", **options)
    return env, jax.jit(jax.vmap(env.reset)), jax.jit(jax.vmap(env.step))


def start(name: str, num: int = 2, **options):
    return task(name, **options)[1](jax.random.split(jax.random.key(0), num))


def placed(state, where):
    """Put the torsos there, and stop them."""
    physics = state.physics
    qpos = physics.qpos.at[:, : len(where[0])].set(jnp.array(where))
    return state.replace(physics=physics.replace(qpos=qpos, qvel=jnp.zeros_like(physics.qvel)))
