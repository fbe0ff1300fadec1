"""Doors between libraries: others' environments behind `Env`, and ours for theirs; each is loaded when used."""

from taic_jax.envs.adapters.brax import BRAX_PREFIX, BraxEnv, to_brax
from taic_jax.envs.adapters.gymnasium import to_gymnasium, to_gymnasium_vector
from taic_jax.envs.adapters.playground import PLAYGROUND_PREFIX, PlaygroundEnv

__all__ = [
    "BRAX_PREFIX",
    "PLAYGROUND_PREFIX",
    "BraxEnv",
    "PlaygroundEnv",
    "to_brax",
    "to_gymnasium",
    "to_gymnasium_vector",
]
