"""Gymnasium's environments behind `Env`, stepped on the host by one call a tick."""

import functools
import hashlib
import importlib
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import Float, Key, UInt8
from PIL import Image, ImageOps

from taic_jax.envs.adapters.admission import extra, require_vector_actions
from taic_jax.envs.adapters.episodes import WORDS, Episodes, as_seed, flat
from taic_jax.envs.base import Env, Heading, State
from taic_jax.envs.errors import AdapterError, MissingExtraError, RenderingError, UnknownNameError
from taic_jax.envs.locomotion import Locomotion
from taic_jax.envs.physics.host_call import HostFunction
from taic_jax.envs.rendering import make_renderer
from taic_jax.envs.robots import ROBOTS
from taic_jax.envs.views import Views

GYMNASIUM_PREFIX = "gymnasium:"
# Where these parts of two models and the seconds of a tick agree, so do the bodies.
_BODY = "jnt_type jnt_axis jnt_range dof_damping dof_armature body_mass body_inertia actuator_gear actuator_ctrlrange"


class GymnasiumPhysics(struct.PyTreeNode):
    """An episode so far, and all that repeats it: see `adapters.episodes`."""

    seed: Array  # [W]
    name: Array  # [W]
    obs: Array  # [S]
    tick: Array  # [] int32
    actions: Array  # [T, A]; those of the first `tick` ticks count


class GymnasiumEnv(Env):
    """The environment registered with Gymnasium under `ID`, or under `MODULE:ID` after the import of a module.

    An observation is one box, or boxes by name: first `observation`, then the others in the order of their names.
    Vectors of [-1, 1] are scaled to the limits of actions; numbers in Gymnasium's info are metrics. The time limit is
    `episode_length`, which `TimeLimit` enforces. A body like one of our robots' shares its proprioceptive slice.

    Raises:
      MissingExtraError: Gymnasium, or a package of ours for MODULE, is not installed.
      UnknownNameError: there is no such environment.
      AdapterError: MODULE cannot be imported, or the environment cannot be made or has no time limit; its actions or
        observations are of another kind; or a seed and actions do not repeat an episode.
    """

    def __init__(self, name: str):
        self.name = self.proprioception = GYMNASIUM_PREFIX + name
        self._episodes, self._start, self._step = _on_host(name)
        env, obs, self.episode_length = self._episodes.env, self._episodes.obs, find_spec(name).max_episode_steps
        self.observation_size, self.action_size = obs.size, self._episodes.action_size
        data, dt = getattr(env.unwrapped, "data", None), getattr(env.unwrapped, "dt", None)  # after one tick
        self.dt = float(getattr(data, "time", None) or dt or 1.0 / env.metadata.get("render_fps", 10))
        own = getattr(env.observation_space, "spaces", {}).get("observation", env.observation_space)
        self.proprioceptive_size = flat(own.sample()).size
        self._robot = _robot_of(env, self.dt, obs)
        if self._robot:
            self.proprioception = self._robot.proprioception
            self.proprioceptive_size = self._robot.proprioceptive_size

    @property
    def views(self) -> Views:
        """Views of our robot of this body."""
        return self._robot.views if self._robot else super().views

    @property
    def heading(self) -> Heading | None:
        """Heading of our robot of this body."""
        return self._robot.heading if self._robot else None

    def reset(self, key: Key[Array, ""]) -> State:
        """Reset by Gymnasium, from a seed."""
        return self._begin(key, jnp.ones(1), jnp.zeros(WORDS), jnp.zeros((self.episode_length, self.action_size)))

    def restart(self, key: Key[Array, ""], ended: GymnasiumPhysics) -> State:
        """Reset the environment of the episode that ended, if one did."""
        wanted = jnp.any(~jax.random.key_data(key) != 0).astype(jnp.float32)
        return self._begin(key, wanted[None], ended.name, ended.actions)

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Step by Gymnasium."""
        now, episodes = state.physics, self._episodes
        tick = now.tick.astype(jnp.float32)[None]
        sent = jnp.concatenate([now.seed, now.name, now.obs, tick, action])
        sizes = WORDS, now.obs.size, 1, 1, 1, len(episodes.metrics)
        after = self._step(sent, now.actions, size=sum(sizes))
        name, obs, reward, terminated, truncated, metrics = jnp.split(after, np.cumsum(sizes)[:-1])
        actions = now.actions.at[now.tick].set(action)
        return state.replace(
            physics=now.replace(name=name, obs=obs, tick=now.tick + 1, actions=actions),
            obs=obs, reward=reward[0], terminated=terminated[0] > 0, truncated=truncated[0] > 0,
            metrics=dict(zip(episodes.metrics, metrics, strict=True)),
        )  # fmt: skip

    def render(self, physics: GymnasiumPhysics, *, height: int = 240, width: int = 320) -> UInt8[np.ndarray, "T h w 3"]:
        """Draw by Gymnasium, with black bars where its pictures have another shape."""
        if isinstance(model := getattr(self._episodes.env.unwrapped, "model", None), mujoco.MjModel):
            make_renderer(model, height, width).close()  # or it raises the error of a machine that cannot draw
        frames, before = [], None
        try:
            env = _make(self.name.removeprefix(GYMNASIUM_PREFIX), render_mode="rgb_array")
            for words, tick, actions in zip(physics.seed, physics.tick, physics.actions, strict=True):
                goes_on = before == (seed := as_seed(words), tick - 1)
                self._episodes.play(env, None if goes_on else seed, actions[tick - 1 if goes_on else 0 : tick])
                before = seed, tick
                frames.append(ImageOps.pad(Image.fromarray(env.render()), (width, height)))
        except Exception as error:
            raise RenderingError(f"{self.name}: cannot be drawn: {_line(error)}") from error
        return np.stack(frames)

    def _begin(self, key: Key[Array, ""], wanted: Array, before: Array, actions: Array) -> State:
        seed = jax.random.bits(key, (WORDS,), jnp.uint16).astype(jnp.float32)
        obs = self._start(jnp.concatenate([wanted, seed, before]), size=self.observation_size)
        physics = GymnasiumPhysics(seed, seed, obs, jnp.zeros((), jnp.int32), actions)
        return State.first(physics, obs, dict.fromkeys(self._episodes.metrics, jnp.zeros(())))


def find_spec(name: str) -> Any:
    """Return what is registered under a name, after the import of its module."""
    with extra("gym"):
        gymnasium: Any = importlib.import_module("gymnasium")
    module, _, identifier = name.rpartition(":")
    try:
        importlib.import_module(module or "gymnasium")
        return gymnasium.spec(identifier)
    except gymnasium.error.Error:
        valid = [GYMNASIUM_PREFIX + name.removesuffix(identifier) + each for each in gymnasium.registry]
        raise UnknownNameError("environment", GYMNASIUM_PREFIX + name, valid) from None
    except Exception as error:
        if module == "gymnasium_robotics" and isinstance(error, ModuleNotFoundError):
            raise MissingExtraError(error.name or module, "robotics") from error
        raise AdapterError(f"{GYMNASIUM_PREFIX}{name}: cannot import {module}: {_line(error)}") from error


@functools.cache
def _on_host(name: str) -> tuple[Episodes, HostFunction, HostFunction]:
    """Return an environment's episodes and their two calls, one a process: compiled programs call them by name."""
    try:
        episodes = Episodes(GYMNASIUM_PREFIX + name, functools.partial(_make, name))
    except (AdapterError, UnknownNameError, MissingExtraError):
        raise
    except Exception as error:
        raise AdapterError(f"{GYMNASIUM_PREFIX}{name}: cannot be made: {_line(error)}") from error
    digest = hashlib.sha256(name.encode()).hexdigest()[:16]
    start, step = (
        HostFunction(f"taic_jax_gymnasium_{digest}_{function.__name__}", function)
        for function in (episodes.start, episodes.step)
    )
    return episodes, start, step


def _make(name: str, **settings: Any) -> Any:
    """Make an environment without its time limit; raise `AdapterError` if it is of another kind."""
    spec, gymnasium, name = find_spec(name), importlib.import_module("gymnasium"), GYMNASIUM_PREFIX + name
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)  # MuJoCo would write MUJOCO_LOG.TXT into the current folder
    try:
        with warnings.catch_warnings(action="ignore"):
            env: Any = gymnasium.make(spec, max_episode_steps=-1, disable_env_checker=True, **settings)
    finally:
        mujoco.set_mju_user_warning(before)
    require_vector_actions(name, env)
    space = env.observation_space
    if not all(isinstance(part, gymnasium.spaces.Box) for part in getattr(space, "values", lambda: [space])()):
        raise AdapterError(f"{name}: observations: got {space}, expected a box, or boxes by name")
    if not spec.max_episode_steps:
        raise AdapterError(f"{name}: expected a time limit, max_episode_steps of its registration, got none")
    return env


def _robot_of(env: Any, dt: float, obs: Float[np.ndarray, " S"]) -> Locomotion | None:
    """Return our robot of the same body, if the model shows it and the observation begins with its slice."""
    model, data = (getattr(env.unwrapped, name, None) for name in ("model", "data"))
    for name, robot in ROBOTS["gym"].items() if isinstance(model, mujoco.MjModel) else ():
        ours = Locomotion(name, robot, "mujoco")
        parts = ((getattr(each, part) for each in (model, ours.physics.model)) for part in _BODY.split())
        if dt == ours.dt and all(np.shape(one) == np.shape(other) and np.allclose(one, other) for one, other in parts):
            seen = np.concatenate(
                [data.qpos[robot.num_unobserved :], data.qvel.clip(-robot.velocity_limit, robot.velocity_limit)]
            )
            return ours if np.allclose(obs[: seen.size], seen, atol=1e-5) else None
    return None


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"
