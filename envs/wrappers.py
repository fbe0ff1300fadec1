"""Time limit and automatic reset, apart from the tasks' own dynamics."""

import copy
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Key

from taic_jax.envs.base import Env, Goals, Heading, State
from taic_jax.envs.views import Views


class Wrapper(Env):
    """An environment around another, with the inner one's attributes and methods."""

    def __init__(self, env: Env):
        self.env = env

    def __getattr__(self, name: str) -> Any:
        if name == "env":  # not yet set, as while unpickling
            raise AttributeError(name)
        return getattr(self.env, name)

    @property
    def views(self) -> Views:
        """Views of the inner environment's body."""
        return self.env.views

    @property
    def discrete(self) -> bool:
        """Whether the inner environment's actions are one-hot."""
        return self.env.discrete

    @property
    def staggered(self) -> bool:
        """Whether training of the inner environment begins at ticks apart."""
        return self.env.staggered

    @property
    def goals(self) -> Goals | None:
        """Goals of the inner environment."""
        return self.env.goals

    @property
    def heading(self) -> Heading | None:
        """Heading of the inner environment's body."""
        return self.env.heading

    @property
    def evaluated(self) -> Env:
        """This wrapper, with its own settings, around the inner environment's `evaluated`."""
        wrapper = copy.copy(self)
        wrapper.env = self.env.evaluated
        return wrapper

    def reset(self, key: Key[Array, ""]) -> State:
        return self.env.reset(key)

    def restart(self, key: Key[Array, ""], ended: Any) -> State:
        return self.env.restart(key, ended)

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        return self.env.step(state, action)

    def render(self, physics: Any, *, height: int = 240, width: int = 320) -> np.ndarray:
        return self.env.render(physics, height=height, width=width)


class TimeLimit(Wrapper):
    """Set `truncated` at the last allowed tick, besides `terminated` if the task ended at that very tick."""

    def __init__(self, env: Env, ticks: int):
        super().__init__(env)
        self.episode_length = ticks

    def reset(self, key: Key[Array, ""]) -> State:
        """Reset with the count of ticks at zero."""
        return self.env.reset(key).replace(tick=jnp.zeros((), jnp.int32))

    def restart(self, key: Key[Array, ""], ended: Any) -> State:
        """Restart with the count of ticks at zero."""
        return self.env.restart(key, ended).replace(tick=jnp.zeros((), jnp.int32))

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Step and count the tick."""
        tick = state.tick + 1
        no = jnp.zeros((), bool)  # for a task that does not set them
        state = self.env.step(state.replace(terminated=no, truncated=no), action)
        return state.replace(tick=tick, truncated=state.truncated | (tick >= self.episode_length))


class AutoReset(Wrapper):
    """Start the next episode, from a fresh key, in the tick that ends one.

    That tick's reward, terminated, truncated and metrics stay, and `final_obs` is its observation; physics, obs and
    tick are the next episode's. If no episode of the whole batch ends, no reset is computed, under any nesting of vmap.
    """

    def reset(self, key: Key[Array, ""]) -> State:
        """Reset, with a key for the episodes to come."""
        key, key_reset = jax.random.split(key)
        state = self.env.reset(key_reset)
        return state.replace(key=key, final_obs=state.obs)

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Step, and start the next episode if this one ends."""
        key, key_reset = jax.random.split(state.key)
        state = self.env.step(state, action)
        running = (state.physics, state.obs, state.tick)
        physics, obs, tick = self._restart(state.terminated | state.truncated, key_reset, running)
        return state.replace(physics=physics, obs=obs, tick=tick, key=key, final_obs=state.obs)

    def _restart(self, *args: Any) -> Any:
        """Call `_restart_ended`, under `vmap` once for the whole batch."""
        restart = jax.custom_batching.custom_vmap(self._restart_ended)
        restart.def_vmap(self._restart_batched)
        return restart(*args)

    def _restart_ended(self, ended: Array, key: Array, running: Any) -> Any:
        """Replace each state at an episode's end by a fresh start; all arguments have the leading axes of `ended`."""

        def restart(ended: Array, key: Array, running: Any) -> Any:
            blank = jax.random.wrap_key_data(~jnp.zeros_like(jax.random.key_data(key)), impl=jax.random.key_impl(key))
            start = self.env.restart(jnp.where(ended, key, blank), running[0])
            start = (start.physics, start.obs, start.tick)
            return jax.tree.map(lambda new, old: jnp.where(ended, new, old), start, running)

        for _ in range(ended.ndim):
            restart = jax.vmap(restart)
        return jax.lax.cond(jnp.any(ended), restart, lambda ended, key, running: running, ended, key, running)

    def _restart_batched(self, axis_size: int, batched: Any, *args: Any) -> tuple[Any, Any]:
        """Decide once for the whole batch: a plain vmap would turn the condition into a select."""

        def broadcast(x: Array, has_axis: bool) -> Array:
            return x if has_axis else jnp.broadcast_to(x, (axis_size, *x.shape))

        running = self._restart(*jax.tree.map(broadcast, args, tuple(batched)))
        return running, jax.tree.map(lambda _: True, running)
