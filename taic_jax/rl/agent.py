"""An agent: a policy over options and the executor of the options; it decides for a rollout, or acts tick by tick."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, ArrayLike, Bool, Float, Int, Key

from taic_jax.networks import GreedyParams, GreedyPolicy, Policy, PolicyParams, SquashedParams, SquashedPolicy
from taic_jax.options.execution import Executor
from taic_jax.rl import normalize
from taic_jax.rl.rollout import DecideFn
from taic_jax.types import Scalar


class Acting(struct.PyTreeNode):
    """The state of an agent between two ticks of an episode.

    `noise` [X] has the executor's random numbers of the last tick, from which the end of its option is drawn.
    """

    option: Float[Array, " D"]
    running: Any
    duration: Int[Array, ""]
    noise: Float[Array, " X"]


class Tick(NamedTuple):
    """One tick of an agent: the running option, whether it began here, and its ticks so far, this one included."""

    option: Float[Array, " D"]
    began: Bool[Array, ""]
    duration: Int[Array, ""]


class Agent(struct.PyTreeNode):
    """A policy over options with its parameters, and the executor of the options: all that acting needs."""

    executor: Executor
    params: PolicyParams | SquashedParams | GreedyParams
    obs_statistics: normalize.Statistics
    policy: Policy | SquashedPolicy | GreedyPolicy = struct.field(pytree_node=False)

    @property
    def observation_size(self) -> int:
        """S, the numbers of an observation."""
        mean: Any = self.obs_statistics.mean
        return mean.shape[-1]

    @property
    def action_size(self) -> int:
        """A, the numbers of an action."""
        obs = jnp.zeros(self.observation_size)
        shapes: Any = jax.eval_shape(lambda: self.act(self.start(obs), obs))
        return shapes[1].shape[-1]

    def decide(self, exploration: Scalar = 1.0) -> DecideFn:
        """Return the policy as a function of raw observations and standard normal noise.

        The noise is scaled by `exploration`: 1 draws options from pi(o|s), 0 takes their mean.
        """
        return partial(_decide, self, exploration)

    def start(self, obs: ArrayLike) -> Acting:
        """Return the carry at the first observation [S] of an episode."""
        return _start(self, obs)

    def act(self, carry: Acting, obs: ArrayLike, key: Key[Array, ""] | None = None) -> tuple[Acting, Array, Tick]:
        """Return the next carry, the action [A], each entry in [-1, 1], and the option behind it.

        Pure, one environment at a time: jit and vmap it, or call it as it is. A key explores: it draws an option from
        pi(o|s) and, where D's end signal is a probability, its end. Without one the agent takes the mean option, and
        ends it if an end is more probable than not.
        """
        return _act(self, carry, obs, key)


@jax.jit
def _start(agent: Agent, obs: Any) -> Acting:
    executor = agent.executor
    option = jnp.zeros(executor.option_size)
    running = executor.start(option, jnp.asarray(obs, jnp.float32))
    return Acting(option, running, jnp.zeros((), jnp.int32), jnp.zeros(executor.noise_size))


@jax.jit
def _act(agent: Agent, carry: Acting, obs: Any, key: Any) -> tuple[Acting, Array, Tick]:
    size = agent.executor.option_size + agent.executor.noise_size
    return advance(agent, carry, obs, None if key is None else jax.random.normal(key, (size,)))


def advance(
    agent: Agent, carry: Acting, obs: ArrayLike, noise: Float[Array, " Z"] | None = None
) -> tuple[Acting, Array, Tick]:
    """Do as `Agent.act` with these standard normal numbers, those for the policy before those of the executor.

    Without them the policy takes its mean option, and those of the executor are zero.
    """
    executor, obs = agent.executor, jnp.asarray(obs, jnp.float32)
    policy: Any = agent.policy
    ended = executor.ended(carry.running, obs, carry.noise) | (carry.duration >= executor.length)
    began = ended | (carry.duration == 0)
    if noise is None:
        option = policy.mode(agent.params, normalize.normalize(agent.obs_statistics, obs))
        chance = jnp.zeros(executor.noise_size)
    else:
        option = agent.decide()(obs[None], noise[None, : executor.option_size])[0][0]
        chance = noise[executor.option_size :]
    fresh = option, executor.start(option, obs)
    option, running = jax.tree.map(partial(jnp.where, began), fresh, (carry.option, carry.running))
    running, action = executor.act(running, obs, chance)
    duration = jnp.where(began, 0, carry.duration) + 1
    return Acting(option, running, duration, chance), action, Tick(option, began, duration)


def _decide(
    agent: Agent, exploration: Scalar, obs: Float[Array, "B S"], noise: Float[Array, "B D"]
) -> tuple[Float[Array, "B D"], Float[Array, " B"]]:
    policy: Any = agent.policy
    return policy.draw(agent.params, normalize.normalize(agent.obs_statistics, obs), exploration, noise)
