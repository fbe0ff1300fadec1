"""Brax's own PPO at the work of ours, on each of its pipelines."""

import itertools
import time
from collections.abc import Sequence
from functools import partial
from typing import Any, Literal, get_args
from unittest import mock

import jax
import jax.numpy as jnp

from taic_jax.config import PPOConfig
from taic_jax.envs.third_party import third_party

Pipeline = Literal["spring", "positional", "generalized", "mjx"]
"""Brax's engines, from the simplest physics to MuJoCo's."""
PIPELINES: tuple[Pipeline, ...] = get_args(Pipeline)
ITERATIONS = 3  # After the first, which compiles.


def ticks_per_second(name: str, pipeline: str, config: PPOConfig) -> list[float]:
    """Train with Brax and return the ticks per second of each iteration but the first, which compiles.

    A function that Brax calls and JAX no longer has is put back. Brax's loop cannot be entered from outside: it takes
    no turns with others. Brax's trainer, which is older than this JAX, may raise any error.
    """
    times = [time.perf_counter()]
    ticks, sizes = config.num_envs * config.rollout_length, tuple(config.hidden_sizes)
    minibatches = ticks // config.minibatch_size
    replicate = getattr(jax, "device_put_replicated", _replicated)
    with third_party(), mock.patch.object(jax, "device_put_replicated", replicate, create=True):
        from brax import envs
        from brax.training.agents.ppo import networks, train

        make_networks = partial(
            networks.make_ppo_networks, policy_hidden_layer_sizes=sizes, value_hidden_layer_sizes=sizes,
            activation=jax.nn.tanh,
        )  # fmt: skip
        # Brax's batches are of environments: all their ticks at once. Each of its iterations is one rollout.
        train.train(
            envs.get_environment(name, backend=pipeline), num_timesteps=ticks * (1 + ITERATIONS),
            num_envs=config.num_envs, episode_length=1000, unroll_length=config.rollout_length,
            batch_size=max(1, config.num_envs // minibatches), num_minibatches=minibatches,
            num_updates_per_batch=config.epochs, learning_rate=config.learning_rate,
            network_factory=make_networks, num_evals=2 + ITERATIONS, run_evals=False,
            progress_fn=lambda *_: times.append(time.perf_counter()),
        )  # fmt: skip
    return [ticks / (after - before) for before, after in itertools.pairwise(times[1:])]


def _replicated(tree: Any, devices: Sequence[jax.Device]) -> Any:
    """Return arrays with an axis of devices before the others, as `jax.device_put_replicated` did on one device."""
    return jax.tree.map(lambda x: jnp.stack([x] * len(devices)), tree)
