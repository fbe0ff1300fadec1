"""Our environments for Gymnasium."""

from typing import TYPE_CHECKING

from taic_jax.envs.adapters.admission import extra
from taic_jax.envs.base import Env

if TYPE_CHECKING:
    from taic_jax.envs.adapters.gymnasium_export import GymnasiumExport, GymnasiumVectorExport


def to_gymnasium(env: Env, render_mode: str | None = None) -> "GymnasiumExport":
    """Turn an environment of ours into a `gymnasium.Env`: NumPy in and out, compiled, info holding the metrics.

    `truncated` comes from the `TimeLimit` that `make_env` puts around a task.

    Args:
      env: an environment of ours.
      render_mode: `rgb_array`, or None for no pictures.

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
    episode's first, and infos hold the last one's `final_obs` and, as `final_info`, its metrics.

    Args:
      env: an environment of ours, without `AutoReset`.
      num_envs: N, at least 1.
      render_mode: `rgb_array`, or None for no pictures.

    Raises:
      MissingExtraError: Gymnasium is not installed.
      UnknownNameError: there is no such render mode.
      AdapterError: `env` is none of ours or resets itself, or `num_envs` is not a positive integer.
    """
    with extra("gym"):
        from taic_jax.envs.adapters.gymnasium_export import GymnasiumVectorExport

    return GymnasiumVectorExport(env, num_envs, render_mode)
