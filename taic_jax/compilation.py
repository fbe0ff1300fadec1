"""Compiled programs are kept on disk, so that a run like an earlier one starts in seconds."""

import contextlib
from pathlib import Path

import jax
import platformdirs

MAX_BYTES = 2**30


def keep_programs() -> None:
    """Keep compiled programs in the user's cache folder, at most 1 GiB of them, unless JAX was told a folder."""
    if jax.config.values["jax_compilation_cache_dir"] is None:
        folder = platformdirs.user_cache_path("taic_jax") / "programs"
        with contextlib.suppress(OSError):  # JAX tells what is the matter with the folder
            _remove_half_written(folder)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_compilation_cache_max_size", MAX_BYTES)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def _remove_half_written(folder: Path) -> None:
    """Remove what a full disk or a killed process has left, which JAX would stumble over ever after.

    JAX writes when a program was last used after the program itself.
    """
    for path in folder.glob("*-cache"):
        if not path.with_name(path.name.removesuffix("-cache") + "-atime").exists():
            path.unlink(missing_ok=True)
