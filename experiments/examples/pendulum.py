"""Swing a pendulum up and keep it there; the motor is too weak to lift it in one go."""

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image, ImageDraw

from taic_jax.envs import Env, State

GRAVITY, LENGTH, TORQUE, DAMPING = 9.81, 1.0, 4.0, 0.1  # m/s^2, m, N m, N m s; the mass is 1 kg


class Pendulum(Env):
    """Reward each tick: the tip's height over the pivot in m, less a little for the motor's work."""

    name, episode_length, dt = "pendulum", 200, 0.05
    observation_size = proprioceptive_size = 3
    action_size = 1

    def reset(self, key):
        """Hang, almost at rest."""
        physics = jnp.array([jnp.pi, 0.0]) + 0.1 * jax.random.normal(key, (2,))  # angle from above, speed
        return self.make_state(physics, jnp.zeros(()))

    def step(self, state, action):
        """Turn by one tick."""
        angle, speed = state.physics
        torque = TORQUE * action[0] - DAMPING * speed
        speed = speed + self.dt * (GRAVITY / LENGTH * jnp.sin(angle) + torque / LENGTH**2)
        physics = jnp.stack([angle + self.dt * speed, speed])
        return self.make_state(physics, LENGTH * jnp.cos(physics[0]) - 0.1 * action[0] ** 2)

    def render(self, physics, *, height=240, width=320):
        """Draw the rod, white on grey."""
        frames = []
        for angle in np.asarray(physics)[:, 0]:
            image, scale = Image.new("RGB", (width, height), "#3d4451"), 0.4 * height
            tip = (width / 2 + scale * np.sin(angle), height / 2 - scale * np.cos(angle))
            ImageDraw.Draw(image).line([(width / 2, height / 2), tip], "white", height // 16)
            frames.append(np.asarray(image))
        return np.stack(frames)

    def make_state(self, physics, reward):
        """Observe cosine, sine and speed over 8 rad/s; the episode never ends by itself."""
        angle, no = physics[0], jnp.zeros((), bool)
        obs = jnp.array([jnp.cos(angle), jnp.sin(angle), physics[1] / 8.0])
        return State(physics, obs, reward, terminated=no, truncated=no, metrics={"height": LENGTH * obs[0]})
