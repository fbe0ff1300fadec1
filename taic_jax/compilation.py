"""Compiled programs are kept on disk, so that a run like an earlier one starts in seconds."""

import jax
import platformdirs

MAX_BYTES = 2**30


def keep_programs() -> None:
    """Keep compiled programs in the user's cache folder, at most 1 GiB of them, unless JAX was told a folder."""
    if jax.config.values["jax_compilation_cache_dir"] is None:
        jax.config.update("jax_compilation_cache_dir", str(platformdirs.user_cache_path("taic_jax") / "programs"))
        jax.config.update("jax_compilation_cache_max_size", MAX_BYTES)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
