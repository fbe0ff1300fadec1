"""Reach a ball on a table with an arm of two links; MuJoCo simulates it, from C or in JAX."""

import jax
import jax.numpy as jnp
from mujoco import MjModel

from taic_jax.envs import Env, State
from taic_jax.envs.physics import make_physics
from taic_jax.envs.rendering import render_mujoco

MJCF = """<mujoco>
  <option timestep="0.02"/>
  <default><geom contype="0" density="300" rgba=".2 .4 .7 1"/> <joint axis="0 0 1" damping="2"/></default>
  <worldbody>
    <camera name="track" pos="0 0 2.6"/> <light pos="1 -1 3" dir="-.3 .3 -1"/>
    <geom type="plane" size="2 2 .1" rgba=".95 .94 .9 1"/>
    <body pos="0 0 .1"> <joint name="shoulder"/> <geom type="capsule" fromto="0 0 0 .5 0 0" size=".05"/>
      <body pos=".5 0 0"> <joint name="elbow"/> <geom type="capsule" fromto="0 0 0 .4 0 0" size=".04"/> </body></body>
    <body pos="0 0 .1"> <geom type="sphere" size=".06" rgba=".8 .3 .3 1"/>
      <joint name="ball_x" type="slide" axis="1 0 0"/> <joint name="ball_y" type="slide" axis="0 1 0"/> </body>
  </worldbody>
  <actuator> <motor joint="shoulder" gear="4"/> <motor joint="elbow" gear="4"/> </actuator>
</mujoco>"""


class ReacherArm(Env):
    """Reward each tick: less the tip's distance to the ball in m, which lies in a new place every episode."""

    name, episode_length, dt = "reacher_arm", 100, 0.04
    observation_size, proprioceptive_size, action_size = 6, 4, 2  # the ball is no part of the body

    def __init__(self, backend="auto", num_threads=0):
        self.model = MjModel.from_xml_string(MJCF)
        self.physics = make_physics(self.model, substeps=2, backend=backend, num_threads=num_threads)

    def reset(self, key):
        """Draw the ball's place and the arm's pose, at rest."""
        shoulder, elbow, bearing, radius = jax.random.uniform(key, (4,), minval=-1.0) * jnp.array([3.1, 2.0, 3.1, 0.3])
        ball_x, ball_y = (0.5 + radius) * jnp.cos(bearing), (0.5 + radius) * jnp.sin(bearing)
        physics = self.physics.init(jnp.stack([shoulder, elbow, ball_x, ball_y]), jnp.zeros(4))
        return self.make_state(physics).replace(reward=jnp.zeros(()))

    def step(self, state, action):
        """Simulate one tick."""
        return self.make_state(self.physics.step(state.physics, action))

    def render(self, physics, *, height=240, width=320):
        """Draw with MuJoCo's renderer, from the camera `track`."""
        return render_mujoco(self.model, physics.qpos, height=height, width=width)

    def make_state(self, physics):
        """Observe and reward a pose; the episode never ends by itself."""
        joints, ball = physics.qpos[:2], physics.qpos[2:]
        angles = jnp.cumsum(joints)  # of the links, to the table's x axis
        cos, sin = jnp.cos(angles), jnp.sin(angles)
        way = ball - jnp.stack([cos, sin]) @ jnp.array([0.5, 0.4])  # from the tip; observed as the forearm sees it
        seen = jnp.stack([cos[1] * way[0] + sin[1] * way[1], cos[1] * way[1] - sin[1] * way[0]])
        obs = jnp.concatenate([jnp.cos(joints[1:]), jnp.sin(joints[1:]), physics.qvel[:2] / 5.0, seen])
        distance, no = jnp.linalg.norm(way), jnp.zeros((), bool)
        return State(physics, obs, -distance, terminated=no, truncated=no, metrics={"distance": distance})
