"""A pole on a cart, with two discrete actions: a task that a flat learner solves in minutes."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from taic_jax.envs import Env, State

GRAVITY, CART, POLE, HALF, FORCE = 9.8, 1.0, 0.1, 0.5, 10.0  # m/s^2, kg, kg, m of half the pole, N
ROOM, FALLEN = 2.4, 12 * np.pi / 180  # m and rad, from which on the episode ends


class CartPole(Env):
    """Reward 1 each tick; push left or right. Observation and physics [4]: place, speed, angle, turning speed."""

    name = proprioception = "cart_pole"
    observation_size = proprioceptive_size = 4
    action_size, discrete = 2, True
    episode_length, dt = 500, 0.02

    def reset(self, key: Array) -> State:
        """Start near the middle, almost upright."""
        x = jax.random.uniform(key, (4,), minval=-0.05, maxval=0.05)
        return State.first(x, x, {"angle": jnp.abs(x[2])})

    def step(self, state: State, action: Array) -> State:
        """Make one step of Euler's method from the speeds before it."""
        _, speed, angle, turning = state.physics
        force = jnp.where(jnp.argmax(action) == 1, FORCE, -FORCE)
        sin, cos, mass = jnp.sin(angle), jnp.cos(angle), CART + POLE
        free = (force + POLE * HALF * turning**2 * sin) / mass
        turn = (GRAVITY * sin - cos * free) / (HALF * (4 / 3 - POLE * cos**2 / mass))
        change = jnp.stack([speed, free - POLE * HALF * turn * cos / mass, turning, turn])
        x = state.physics + self.dt * change
        terminated = (jnp.abs(x[0]) > ROOM) | (jnp.abs(x[2]) > FALLEN)
        flags = {"terminated": terminated, "truncated": jnp.zeros((), bool)}
        return state.replace(physics=x, obs=x, reward=jnp.ones(()), metrics={"angle": jnp.abs(x[2])}, **flags)

    def render(self, physics: Any, *, height: int = 240, width: int = 320) -> np.ndarray:
        """Draw nothing."""
        return np.zeros((len(physics), height, width, 3), np.uint8)
