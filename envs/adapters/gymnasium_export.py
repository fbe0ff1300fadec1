"""Our environments as Gymnasium's; imports Gymnasium."""

import re
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector.utils import batch_space
from jax import Array

from taic_jax.envs.adapters.admission import require_task
from taic_jax.envs.base import Env, State
from taic_jax.envs.errors import AdapterError, UnknownNameError
from taic_jax.envs.wrappers import AutoReset

RENDER_MODES = ("rgb_array",)


class GymnasiumExport(gymnasium.Env[np.ndarray, np.ndarray]):
    """An environment of ours as a `gymnasium.Env` (see `to_gymnasium`); actions are clipped to [-1, 1]."""

    def __init__(self, env: Env, render_mode: str | None = None):
        require_task("to_gymnasium", env)
        self.env = env
        self.render_mode = _known(render_mode)
        self.metadata = _metadata(env)
        self.observation_space, self.action_space = _spaces(env)
        # With a spec, Gymnasium's checker also tries the render modes and that seeds repeat an episode.
        identifier = re.sub(r"[^\w:.-]", "_", env.name)
        self.spec = EnvSpec(f"taic_jax/{identifier}-v0", entry_point=_entry_point(env))
        self._reset, self._restart, self._step = jax.jit(env.reset), jax.jit(env.restart), jax.jit(_clipped(env))
        self._state: State | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode and return obs [S] float32 and the metrics; there are no options.

        With a seed, or for the first time, it is a task's first episode, else the one after the last.
        """
        super().reset(seed=seed)
        key = _draw_key(self.np_random)
        if seed is None and self._state is not None:
            self._state = state = self._restart(key, self._state.physics)
        else:
            self._state = state = self._reset(key)
        return np.array(state.obs), _floats(state.metrics)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Make one tick under an action [A].

        Raises:
          AdapterError: the action has another shape.
          ResetNeeded: there was no reset.
        """
        self._state = state = self._step(_reached(self._state), _checked(action, self.action_space, self.env.name))
        obs, reward, terminated, truncated, metrics = jax.device_get(_outputs(state))
        return np.array(obs), float(reward), bool(terminated), bool(truncated), _floats(metrics)

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw the present state as a frame [240, 320, 3] uint8, or nothing without a render mode."""
        if self.render_mode is None:
            return None
        return _frame(self.env, jax.tree.map(lambda leaf: leaf[None], _reached(self._state).physics))


class GymnasiumVectorExport(gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """N copies of an environment of ours as a `gymnasium.vector.VectorEnv` (see `to_gymnasium_vector`)."""

    def __init__(self, env: Env, num_envs: int, render_mode: str | None = None):
        require_task("to_gymnasium_vector", env)
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise AdapterError(f"to_gymnasium_vector: num_envs: got {num_envs!r}, expected an integer of at least 1")
        self.env = AutoReset(env)
        self.num_envs = num_envs
        self.render_mode = _known(render_mode)
        self.metadata = {**_metadata(env), "autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP}
        self.single_observation_space, self.single_action_space = _spaces(env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._reset, self._step = jax.jit(jax.vmap(self.env.reset)), jax.jit(jax.vmap(_clipped(self.env)))
        self._state: State | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start a task's first episode in every copy; return obs [N, S] float32 and the metrics [N] with their masks.

        Raises:
          AdapterError: only some copies shall start anew, which happens by itself here.
        """
        if options and "reset_mask" in options:
            raise AdapterError(
                f"{self.env.name}: reset_mask: got one, expected none: ended episodes restart by themselves"
            )
        super().reset(seed=seed)
        self._state = state = self._reset(jax.random.split(_draw_key(self.np_random), self.num_envs))
        return np.array(state.obs), _masked(jax.device_get(state.metrics), np.ones(self.num_envs, bool))

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Make one tick in every copy under actions [N, A]; where an episode ends, the next one starts.

        Raises:
          AdapterError: the actions have another shape.
          ResetNeeded: there was no reset.
        """
        self._state = state = self._step(_reached(self._state), _checked(actions, self.action_space, self.env.name))
        obs, reward, terminated, truncated, metrics = jax.device_get(_outputs(state))
        ended = terminated | truncated
        infos = _masked(metrics, ~ended)  # of a start that happens in this tick, no metrics are kept
        if ended.any():
            final_obs = np.full(self.num_envs, None, dtype=object)
            for index in np.flatnonzero(ended):
                final_obs[index] = np.array(state.final_obs[index])
            infos |= {"final_obs": final_obs, "_final_obs": ended, "final_info": _masked(metrics, ended)}
            infos["_final_info"] = ended.copy()
        return np.array(obs), np.array(reward), np.array(terminated), np.array(truncated), infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw the present states as N frames [240, 320, 3] uint8, or nothing without a render mode."""
        if self.render_mode is None:
            return None
        physics = _reached(self._state).physics
        one = [jax.tree.map(lambda leaf, i=i: leaf[i : i + 1], physics) for i in range(self.num_envs)]
        return tuple(_frame(self.env, each) for each in one)


def _known(render_mode: str | None) -> str | None:
    if render_mode not in (None, *RENDER_MODES):
        raise UnknownNameError("render mode", str(render_mode), RENDER_MODES)
    return render_mode


def _metadata(env: Env) -> dict[str, Any]:
    return {"render_modes": list(RENDER_MODES), "render_fps": 1.0 / env.dt}


def _spaces(env: Env) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Return the spaces of obs [S] and action [A]."""
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (env.observation_size,), np.float32),
        gymnasium.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32),
    )


def _entry_point(env: Env) -> Callable[..., GymnasiumExport]:
    # A closure, which Gymnasium's copies of the spec share, unlike the arguments of a partial.
    return lambda render_mode=None: GymnasiumExport(env, render_mode)


def _draw_key(generator: np.random.Generator) -> Array:
    return jax.random.key(int(generator.integers(2**31)))


def _clipped(env: Env) -> Callable[[State, Array], State]:
    return lambda state, action: env.step(state, jnp.clip(action, -1.0, 1.0))


def _outputs(state: State) -> tuple[Array, Array, Array, Array, dict[str, Array]]:
    return state.obs, state.reward, state.terminated, state.truncated, state.metrics


def _reached(state: State | None) -> State:
    if state is None:
        raise gymnasium.error.ResetNeeded("expected reset before the first step or render")
    return state


def _checked(action: np.ndarray, space: gymnasium.Space, name: str) -> np.ndarray:
    action = np.asarray(action, np.float32)
    if action.shape != space.shape:
        raise AdapterError(f"{name}: action: got the shape {action.shape}, expected {space.shape}")
    return action


def _floats(metrics: Mapping[str, Array | np.ndarray]) -> dict[str, float]:
    return {name: float(value) for name, value in metrics.items()}


def _masked(metrics: Mapping[str, np.ndarray], mask: np.ndarray) -> dict[str, np.ndarray]:
    """Return each metric [N], 0 where the mask is not set, and, as Gymnasium does, the mask beside it."""
    infos = {}
    for name, values in metrics.items():
        infos[name] = np.where(mask, values, np.zeros_like(values))
        infos[f"_{name}"] = mask.copy()
    return infos


def _frame(env: Env, physics: Any) -> np.ndarray:
    return env.render(physics)[0]
