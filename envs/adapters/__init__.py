"""Adapters between libraries: their environments behind `Env`, and ours for them; each is imported at its first use."""

from typing import TYPE_CHECKING

from taic_jax.envs.adapters.admission import extra
from taic_jax.envs.adapters.brax import BRAX_PREFIX, BraxEnv
from taic_jax.envs.adapters.gymnax import GYMNAX_PREFIX, GymnaxEnv
from taic_jax.envs.adapters.playground import PLAYGROUND_PREFIX, PlaygroundEnv
from taic_jax.envs.base import Env
from taic_jax.envs.third_party import third_party

if TYPE_CHECKING:
    from taic_jax.envs.adapters.brax_export import BraxExport
    from taic_jax.envs.adapters.gymnasium_export import GymnasiumExport, GymnasiumVectorExport

__all__ = [
    "BRAX_PREFIX", "GYMNAX_PREFIX", "PLAYGROUND_PREFIX", "BraxEnv", "GymnaxEnv", "PlaygroundEnv", "to_brax",
    "to_gymnasium", "to_gymnasium_vector",
]  # fmt: skip


def to_brax(env: Env) -> "BraxExport":
    """Turn an environment of ours into a `brax.envs.Env`, for Brax's wrappers and trainers.

    Brax counts the ticks, in its `EpisodeWrapper`: a `TimeLimit` around `env` is removed, and its number stays as
    `episode_length`: `training.wrap(to_brax(env), env.episode_length)`. At an episode's end Brax goes back to the
    copy's first state: starts do not vary, and a task's `restart` has no effect. Brax has no discrete actions: of a
    vector [A], the largest entry counts. With JAX 0.10, Brax 0.14.2's PPO
    stops, for any environment, at a function that JAX no longer has (`device_put_replicated`); its wrappers work.

    Raises:
      AdapterError: `env` is none of ours, resets itself, or has its time limit inside another wrapper.
    """
    with third_party():
        from taic_jax.envs.adapters.brax_export import BraxExport

    return BraxExport(env)


def to_gymnasium(env: Env, render_mode: str | None = None) -> "GymnasiumExport":
    """Turn an environment of ours into a `gymnasium.Env`: NumPy in and out, compiled, with the metrics as info.

    Actions are a `Box`, or `Discrete(A)` if they are discrete.
    `truncated` comes from the `TimeLimit` that `make_env` puts around a task. `render_mode` is `rgb_array` or None.

    Raises:
      MissingExtraError: Gymnasium is not installed.
      UnknownNameError: there is no such render mode.
      AdapterError: `env` is none of ours, or resets itself.
    """
    with extra("gym"):
        from taic_jax.envs.adapters.gymnasium_export import GymnasiumExport

    return GymnasiumExport(env, render_mode)


def to_gymnasium_vector(env: Env, num_envs: int, render_mode: str | None = None) -> "GymnasiumVectorExport":
    """Turn an environment of ours into a `gymnasium.vector.VectorEnv` of N copies in one compiled program.

    An episode that ends is followed by the next in the same tick (`AutoresetMode.SAME_STEP`): obs is the next
    episode's first, and infos hold the last one's `final_obs` and, as `final_info`, its metrics. Errors are those of
    `to_gymnasium`, and `AdapterError` if N is not a positive integer.
    """
    with extra("gym"):
        from taic_jax.envs.adapters.gymnasium_export import GymnasiumVectorExport

    return GymnasiumVectorExport(env, num_envs, render_mode)
