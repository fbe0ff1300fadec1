"""A body that faces anywhere, without physics: the cheapest one whose options can be practised."""

import jax
import jax.numpy as jnp
import numpy as np
from probes import NO

from taic_jax.envs import Env, State
from taic_jax.envs.base import Heading


class Sled(Env):
    """A sled that faces anywhere, whose action is its velocity in its own frame."""

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
        """Move at the velocity."""
        w, z = state.obs[0], state.obs[3]
        c, s = w**2 - z**2, 2 * w * z
        velocity = jnp.stack([c * action[0] - s * action[1], s * action[0] + c * action[1]])
        obs = state.obs.at[4:].set(velocity)
        return state.replace(physics=obs, obs=obs, terminated=NO, truncated=NO)

    def render(self, physics, *, height=240, width=320):
        """Draw nothing."""
        return np.zeros((len(physics), height, width, 3), np.uint8)
