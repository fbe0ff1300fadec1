"""A point in HIRO's maze: all that a learner over options has to do there, without the ant.

    python tests/point_maze.py [--learner sac|ppo] [--goal drawn|fixed] [--decisions 50000] [--seeds 5]

prints the distance in m from the fixed goal at the end of evaluation, per seed; an option is a velocity, held 20 ticks.
"""

import argparse
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array

from taic_jax import train
from taic_jax.analysis.evaluate import evaluate
from taic_jax.config import PPOConfig, SACConfig
from taic_jax.envs import Env, State, TimeLimit
from taic_jax.envs.ant_tasks import SUCCESS_RADIUS
from taic_jax.envs.arenas import MAZE
from taic_jax.envs.base import Goals
from taic_jax.envs.navigation import inside
from taic_jax.options.execution import IdentityExecutor

LOW, HIGH = np.array(MAZE.room).reshape(2, 2).astype(np.float32)
WALLS, GOAL = np.array(MAZE.solids, np.float32), np.array(MAZE.goal, np.float32)
CENTRE, HALF = (LOW + HIGH) / 2, (HIGH - LOW) / 2


class PointState(struct.PyTreeNode):
    """Place and goal of the point, in m."""

    position: Array
    goal: Array


class PointMaze(Env):
    """Reach the goal: the action is the velocity in units of `speed`, and the reward is minus the distance in m.

    It observes position and goal, scaled to [-1, 1]. With `uniform` the goal is drawn in the room in training.
    """

    name = proprioception = "point_maze"
    observation_size = proprioceptive_size = 4
    action_size = 2
    episode_length, dt = 1000, 0.05

    def __init__(self, speed: float = 1.0, uniform: bool = False):
        self.speed, self.uniform = speed, uniform

    @property
    def evaluated(self) -> Env:
        """The maze with its fixed goal."""
        return PointMaze(self.speed)

    @property
    def goals(self) -> Goals:
        """Positions."""

        def reward(achieved: Array, goal: Array) -> tuple[Array, Array]:
            return -jnp.linalg.norm((goal - achieved) * HALF), jnp.zeros((), bool)

        return Goals(2, lambda obs: obs[:2], lambda obs, goal: jnp.concatenate([obs[:2], goal]), reward)

    def reset(self, key: Array) -> State:
        """Start at the origin."""
        drawn = jax.random.uniform(key, (2,), minval=LOW, maxval=HIGH)
        physics = PointState(jnp.zeros(2), drawn if self.uniform else jnp.array(GOAL))
        return State.first(physics, self._observe(physics), self._metrics(physics))

    def step(self, state: State, action: Array) -> State:
        """Move, first along x, then along y, as far as the walls allow."""
        x, y = state.physics.position
        moved = jnp.clip(state.physics.position + self.speed * self.dt * action, LOW, HIGH)
        stands = np.ones(len(WALLS), bool)
        x = jnp.where(inside(jnp.stack([moved[0], y]), jnp.array(WALLS), stands), x, moved[0])
        y = jnp.where(inside(jnp.stack([x, moved[1]]), jnp.array(WALLS), stands), y, moved[1])
        physics = state.physics.replace(position=jnp.stack([x, y]))
        metrics = self._metrics(physics)
        return state.replace(physics=physics, obs=self._observe(physics), reward=-metrics["distance"], metrics=metrics)

    def render(self, physics: Any, *, height: int = 240, width: int = 320) -> np.ndarray:
        """Draw nothing."""
        return np.zeros((len(physics.position), height, width, 3), np.uint8)

    def _observe(self, physics: PointState) -> Array:
        return jnp.concatenate([(physics.position - CENTRE) / HALF, (physics.goal - CENTRE) / HALF])

    def _metrics(self, physics: PointState) -> dict[str, Array]:
        distance = jnp.linalg.norm(physics.goal - physics.position)
        return {"distance": distance, "success": (distance < SUCCESS_RADIUS).astype(jnp.float32)}


HOLD = 20  # ticks of an option
LEARNERS = {
    "sac": SACConfig(
        num_envs=16, rollout_length=200, update_every=20, warmup=20_000, capacity=60_000, batch_size=128,
        hidden_sizes=(128, 128), gamma=0.998, relabel=4, learning_rate=1e-3,
    ),
    "ppo": PPOConfig(num_envs=16, rollout_length=1000, gamma=0.998, hidden_sizes=(128, 128), log_std_init=0.0),
}  # fmt: skip


def main() -> None:
    """Train a learner by the command line's settings, and evaluate it without exploration on the fixed goal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--learner", choices=LEARNERS, default="sac")
    parser.add_argument("--goal", choices=("drawn", "fixed"), default="drawn")
    parser.add_argument("--decisions", type=int, default=50_000)
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    env, executor = TimeLimit(PointMaze(uniform=arguments.goal == "drawn"), 1000), IdentityExecutor(2, HOLD)
    run = partial(train, LEARNERS[arguments.learner], env, executor, ticks=HOLD * arguments.decisions)
    key_train, key_evaluate = jax.random.split(jax.random.key(0))
    begun = time.monotonic()
    agents, _ = jax.jit(jax.vmap(run))(jax.random.split(key_train, arguments.seeds))
    test = jax.jit(jax.vmap(lambda agent, key: evaluate(env.evaluated, agent, key, 1, 0.0)))
    distance = test(agents, jax.random.split(key_evaluate, arguments.seeds))["final/distance"]
    reached = int((distance < SUCCESS_RADIUS).sum())
    print(arguments.learner, arguments.goal, arguments.decisions, "decisions:", np.round(distance, 1).tolist(), "m")
    print(f"{reached} of {arguments.seeds} seeds at the goal, {time.monotonic() - begun:.0f} s")


if __name__ == "__main__":
    main()
