"""Our environments as Brax's; imports Brax."""

from operator import attrgetter
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs import base
from jax import Array

from taic_jax.envs.adapters.admission import require_task
from taic_jax.envs.base import Env, State
from taic_jax.envs.errors import AdapterError
from taic_jax.envs.wrappers import TimeLimit


class BraxExport(base.Env):
    """An environment of ours as a `brax.envs.Env` (see `to_brax`).

    `pipeline_state` is our `physics`, and `done` says that the task itself ended. Actions are clipped to [-1, 1].
    """

    observation_size = property(attrgetter("env.observation_size"))
    action_size = property(attrgetter("env.action_size"))
    backend = property(lambda self: "taic_jax")  # the physics is no pipeline of Brax's

    def __init__(self, env: Env):
        require_task("to_brax", env)
        self.episode_length, self.dt = env.episode_length, env.dt
        while isinstance(env, TimeLimit):
            env = env.env
        start = require_task("to_brax", env)
        if start.tick is not None:
            inner = f"{env.name} has its TimeLimit inside {type(env).__name__}"
            raise AdapterError(f"to_brax: {inner}, expected it outside")
        self.env, self._metrics = env, tuple(start.metrics)

    def reset(self, rng: Array) -> base.State:
        """Reset under one of Brax's raw keys [2] uint32, or under a typed one."""
        typed = jnp.issubdtype(rng.dtype, jax.dtypes.prng_key)
        state = self.env.reset(rng if typed else jax.random.wrap_key_data(rng))
        return base.State(**_fields(state), metrics=dict(state.metrics), info={})

    def step(self, state: Any, action: Array) -> base.State:
        """Step; the entries of Brax's wrappers in metrics and info stay."""
        metrics = {name: state.metrics[name] for name in self._metrics}
        before = State.first(state.pipeline_state, state.obs, metrics)
        before = before.replace(reward=state.reward, terminated=state.done.astype(bool))
        after = self.env.step(before, jnp.clip(action, -1.0, 1.0))
        return state.replace(**_fields(after), metrics={**state.metrics, **after.metrics})


def _fields(state: State) -> dict[str, Any]:
    done = (state.terminated | state.truncated).astype(jnp.float32)
    return {"pipeline_state": state.physics, "obs": state.obs, "reward": state.reward, "done": done}
