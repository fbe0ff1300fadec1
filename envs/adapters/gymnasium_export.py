"""Our environments as Gymnasium's; imports Gymnasium."""

import re
from collections.abc import Callable
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
Action = np.ndarray | np.integer | int


class _Export:
    """The common part of both exports: an environment, and its state between calls."""

    env: Env
    action_space: Any
    np_random: np.random.Generator
    _step: Callable[[State, np.ndarray], State]
    _state: State | None = None

    def _admit(self, adapter: str, env: Env, render_mode: str | None) -> tuple[gymnasium.Space, gymnasium.Space]:
        """Set the metadata, and return the spaces of obs [S] and action, [A] or discrete; refuse another library's
        environment, or an unknown render mode."""
        require_task(adapter, env)
        if render_mode not in (None, *RENDER_MODES):
            raise UnknownNameError("render mode", str(render_mode), RENDER_MODES)
        self.metadata, self.render_mode = {"render_modes": list(RENDER_MODES), "render_fps": 1.0 / env.dt}, render_mode
        limits = (np.inf, env.observation_size), (1.0, env.action_size)
        obs, action = (gymnasium.spaces.Box(-limit, limit, (size,), np.float32) for limit, size in limits)
        return obs, gymnasium.spaces.Discrete(env.action_size) if env.discrete else action

    def _draw_key(self) -> Array:
        return jax.random.key(int(self.np_random.integers(2**31)))

    def _present(self) -> State:
        if self._state is None:
            raise gymnasium.error.ResetNeeded("expected reset before the first step or render")
        return self._state

    def _frame(self, physics: Any) -> np.ndarray:
        """Draw one state alone, without the path to it."""
        return self.env.render(jax.tree.map(lambda leaf: leaf[None], physics))[0]

    def _to_ours(self, action: Action) -> np.ndarray:
        """Return one action or N of them as vectors [..., A], one-hot if they are discrete."""
        discrete, last = self.env.discrete, self.env.action_size - 1
        action = np.asarray(action, None if discrete else np.float32)
        if action.shape != (shape := self.action_space.shape):
            raise AdapterError(f"{self.env.name}: action: got the shape {action.shape}, expected {shape}")
        if discrete and (action.dtype.kind not in "iu" or ((action < 0) | (action > last)).any()):
            raise AdapterError(f"{self.env.name}: action: got {action}, expected integers from 0 to {last}")
        return np.eye(last + 1, dtype=np.float32)[action] if discrete else action

    def _advance(self, action: Action) -> tuple[Any, ...]:
        """Make one tick; return obs, reward, terminated, truncated and metrics as arrays of the caller's own."""
        self._state = state = self._step(self._present(), self._to_ours(action))
        outputs = state.obs, state.reward, state.terminated, state.truncated, state.metrics
        return jax.tree.map(np.array, jax.device_get(outputs))


class GymnasiumExport(_Export, gymnasium.Env[np.ndarray, Action]):
    """An environment of ours as a `gymnasium.Env` (see `to_gymnasium`); actions are clipped to [-1, 1]."""

    def __init__(self, env: Env, render_mode: str | None = None):
        self.env = env
        self.observation_space, self.action_space = self._admit("to_gymnasium", env, render_mode)
        # With a spec, Gymnasium's checker also tests the render modes, and that seeds repeat an episode. Copies of the
        # spec share a closure, unlike the arguments of a partial.
        identifier = re.sub(r"[^\w:.-]", "_", env.name)
        self.spec = EnvSpec(f"taic_jax/{identifier}-v0", entry_point=lambda **kwargs: GymnasiumExport(env, **kwargs))
        self._reset, self._restart, self._step = jax.jit(env.reset), jax.jit(env.restart), jax.jit(_clipped(env))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start an episode and return obs [S] float32 and the metrics; there are no options.

        With a seed, or for the first time, it is a task's first episode, else the one after the last.
        """
        super().reset(seed=seed)
        key, before = self._draw_key(), self._state if seed is None else None
        self._state = state = self._reset(key) if before is None else self._restart(key, before.physics)
        return np.array(state.obs), _floats(state.metrics)

    def step(self, action: Action) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Make one tick; `AdapterError` at an action of another shape or range, `ResetNeeded` before a reset."""
        obs, reward, terminated, truncated, metrics = self._advance(action)
        return obs, float(reward), bool(terminated), bool(truncated), _floats(metrics)

    def render(self) -> np.ndarray | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Draw the present state as a frame [240, 320, 3] uint8, or nothing without a render mode."""
        return None if self.render_mode is None else self._frame(self._present().physics)


class GymnasiumVectorExport(_Export, gymnasium.vector.VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """N copies of an environment of ours as a `gymnasium.vector.VectorEnv` (see `to_gymnasium_vector`)."""

    def __init__(self, env: Env, num_envs: int, render_mode: str | None = None):
        spaces = self._admit("to_gymnasium_vector", env, render_mode)
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise AdapterError(f"to_gymnasium_vector: num_envs: got {num_envs!r}, expected an integer of at least 1")
        self.env, self.num_envs = AutoReset(env), num_envs
        self.metadata["autoreset_mode"] = gymnasium.vector.AutoresetMode.SAME_STEP
        self.single_observation_space, self.single_action_space = spaces
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._reset, self._step = jax.jit(jax.vmap(self.env.reset)), jax.jit(jax.vmap(_clipped(self.env)))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Start a task's first episode in every copy; return obs [N, S] float32 and the metrics [N] with their masks.

        `AdapterError` if the options have a `reset_mask`.
        """
        if options and "reset_mask" in options:
            problem = "reset_mask: got one, expected none: ended episodes restart by themselves"
            raise AdapterError(f"{self.env.name}: {problem}")
        super().reset(seed=seed)
        self._state = state = self._reset(jax.random.split(self._draw_key(), self.num_envs))
        return np.array(state.obs), _masked(jax.device_get(state.metrics), np.ones(self.num_envs, bool))

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Make one tick in every copy under actions [N, A] or [N]; the same errors; an end starts the next episode."""
        obs, reward, terminated, truncated, metrics = self._advance(actions)
        ended = terminated | truncated
        infos: dict[str, Any] = _masked(metrics, ~ended)  # an episode that starts in this tick has no metrics
        if ended.any():
            final_obs = np.full(self.num_envs, None, dtype=object)
            for index in np.flatnonzero(ended):
                final_obs[index] = np.array(self._present().final_obs[index])
            infos |= {"final_obs": final_obs, "_final_obs": ended}
            infos |= {"final_info": _masked(metrics, ended), "_final_info": ended.copy()}
        return obs, reward, terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Draw the present states as N frames [240, 320, 3] uint8, or nothing without a render mode."""
        if self.render_mode is None:
            return None
        physics = self._present().physics
        return tuple(self._frame(jax.tree.map(lambda leaf, i=i: leaf[i], physics)) for i in range(self.num_envs))


def _clipped(env: Env) -> Callable[[State, Array], State]:
    return lambda state, action: env.step(state, jnp.clip(action, -1.0, 1.0))


def _floats(metrics: dict[str, Any]) -> dict[str, float]:
    return {name: float(value) for name, value in metrics.items()}


def _masked(metrics: dict[str, np.ndarray], mask: np.ndarray) -> dict[str, np.ndarray]:
    """Return each metric [N], 0 outside the mask, and the mask under its name with an underscore, as Gymnasium does."""
    values = {name: np.where(mask, values, np.zeros_like(values)) for name, values in metrics.items()}
    return values | {f"_{name}": mask.copy() for name in metrics}
