"""A body that faces anywhere, without physics: the cheapest one whose options can be practised."""

import jax
import jax.numpy as jnp
import numpy as np
from probes import NO

from taic_jax.envs import Env, State
from taic_jax.envs.base import Heading

TURN = 0.2  # rad to the left in each tick


def turned(vector, angle):
    """Return vectors [..., 2] turned to the left."""
    c, s, (x, y) = jnp.cos(angle), jnp.sin(angle), jnp.moveaxis(vector, -1, 0)
    return jnp.stack([c * x - s * y, s * x + c * y], axis=-1)


class Sled(Env):
    """A sled that spins slowly, whose action is its velocity in its own frame."""

    name = proprioception = "sled"
    observation_size = proprioceptive_size = 6
    action_size = 2
    episode_length, dt = 50, 0.5
    heading = Heading(quaternion=0, velocity=4, dt=0.5)

    def reset(self, key):
        """Face anywhere, at rest."""
        half = jax.random.uniform(key, (), minval=-3.1, maxval=3.1) / 2
        obs = jnp.array([1.0, 0, 0, 0, 0, 0]).at[0].set(jnp.cos(half)).at[3].set(jnp.sin(half))
        return State.first(obs, obs, {})

    def step(self, state, action):
        """Move at the velocity, and turn."""
        yaw = 2.0 * jnp.arctan2(state.obs[3], state.obs[0])
        half = (yaw + TURN) / 2.0
        velocity = turned(action, yaw)
        obs = state.obs.at[0].set(jnp.cos(half)).at[3].set(jnp.sin(half)).at[4:].set(velocity)
        return state.replace(physics=obs, obs=obs, terminated=NO, truncated=NO)

    def render(self, physics, *, height=240, width=320):
        """Draw nothing."""
        return np.zeros((len(physics), height, width, 3), np.uint8)
