"""Evaluation on the counting task, whose returns are sums that can be written down."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from probes import Counting, Probe, Repeat

from taic_jax.analysis.evaluate import evaluate, record
from taic_jax.config import PPOConfig
from taic_jax.rl import normalize, ppo
from taic_jax.rl.agent import Agent

END, EPISODES = 6, 100


def make_agent() -> Agent:
    """Return an agent that draws options of two ticks from N(0, 1/e^2), whatever it sees."""
    executor = Repeat(2)
    policy = ppo.make_policy(executor, PPOConfig(hidden_sizes=(2,)))
    shapes = jax.eval_shape(lambda: policy.init(jax.random.key(0), 1, jnp.zeros(())))
    params = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), shapes).replace(log_std=jnp.full(1, -1.0))
    return Agent(executor, params, normalize.init((1,)), policy)


AGENT = make_agent()


class Earning(Probe):
    """Three ticks, each rewarded by the square of the action."""

    episode_length = 3

    def move(self, x: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        return x + 1.0, action**2, x > 1.5, jnp.zeros((), bool)


def run(env: Probe, seed: int = 0) -> dict[str, float]:
    result = jax.jit(partial(evaluate, env, AGENT, episodes=EPISODES))(jax.random.key(seed))
    # Every tick is of one option, and of those that began in the first episodes only.
    np.testing.assert_allclose(result["durations"] @ jnp.array([1.0, 2.0]), EPISODES * result["length"], rtol=1e-5)
    assert result.pop("durations")[1] > 0
    return {name: float(value) for name, value in result.items()}


def test_counts_the_first_episode_of_each_environment_only():
    """Episodes of one to six ticks: many that follow the first begin within the ticks that are run."""
    result = run(Counting(END, truncated=True, spread=END))
    assert 2 < result["length"] < 5
    # An episode of n ticks goes from 7 - n to 6, of mean (13 - n) / 2, which is linear in n; ...
    np.testing.assert_allclose(result["mean/last"], (13 - result["length"]) / 2, rtol=1e-6)
    assert result["final/last"] == END
    # ... and earns n (13 - n) / 2 <= 21, which is concave in it; two episodes of one environment would earn more.
    assert END < result["return"] <= result["length"] * (13 - result["length"]) / 2


def test_runs_the_task_as_evaluation_sets_it():
    class Drawn(Counting):
        """Trained on longer episodes than those it is evaluated in."""

        @property
        def evaluated(self) -> Counting:
            return Counting(END)

    assert run(Drawn(END + 3))["return"] == run(Counting(END))["return"]


def test_returns_are_sums_over_one_episode():
    """Without a spread every episode is 1 + ... + 6."""
    result = run(Counting(END))
    expected = {"return": 21.0, "length": 6.0, "mean/last": 3.5, "final/last": 6.0}
    assert result == expected


def test_no_exploration_takes_the_mean_option():
    step = jax.jit(lambda exploration: evaluate(Earning(), AGENT, jax.random.key(0), EPISODES, exploration))
    whole, half, none = (step(exploration)["return"] for exploration in (1.0, 0.5, 0.0))
    # Three squares of standard deviation 1/e, clipped at 1.
    np.testing.assert_allclose(whole, 3 * np.exp(-2.0), rtol=0.3)
    np.testing.assert_allclose(half, whole / 4, rtol=0.1)
    assert none == 0.0


def test_record_returns_the_physics_tick_by_tick():
    physics = jax.jit(partial(record, Counting(4), AGENT, ticks=6))(jax.random.key(0))
    # Of the state after the tick, which is the next episode's where one ended.
    np.testing.assert_array_equal(physics, [1.0, 2.0, 3.0, 0.0, 1.0, 2.0])
