"""Walk to the left: a robot of MuJoCo Menagerie in a task of one's own."""

import dataclasses

import jax.numpy as jnp

from taic_jax.envs import Locomotion, menagerie_robot


class Sidestep(Locomotion):
    """Reward each tick: the speed to the left in m/s, less that forward or backward, plus health, less the action."""

    def __init__(self, backend="auto", num_threads=0):
        # For an MJCF of your own: legged_robot(Path("my_robot.xml"), "my_robot").
        robot = dataclasses.replace(menagerie_robot("unitree_go2"), control_cost=0.1, reach=0.3)
        super().__init__("sidestep", robot, backend, num_threads)

    def step(self, state, action):
        """Simulate a tick; replace the forward speed, which `Locomotion` rewards."""
        after = super().step(state, action)
        forward, left = (after.physics.qpos[:2] - state.physics.qpos[:2]) / self.dt
        return after.replace(reward=after.reward - forward + left - jnp.abs(forward))
