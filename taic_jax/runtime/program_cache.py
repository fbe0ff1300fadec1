"""The cache of compiled programs on disk: a run like an earlier one starts in seconds."""

import contextlib
from functools import cache
from pathlib import Path

import jax
import platformdirs

MAX_BYTES, MAX_PROGRAMS = 2**30, 500
# On a CPU, Eigen multiplies matrices: with YNNPACK, XLA's own choice, an update of PPO takes 1.2 times as long.
WITHOUT_YNNPACK: dict[str, str | bool] = {"xla_cpu_experimental_ynn_fusion_type": ""}


def keep_programs() -> None:
    """Keep compiled programs in the user's cache folder, at most 1 GiB of them, unless a setting of JAX names one.

    Each start leaves at most `MAX_PROGRAMS`: JAX looks at all of them when it adds one, 0.7 s for 5,700.
    """
    if jax.config.values["jax_compilation_cache_dir"] is None:
        folder = platformdirs.user_cache_path("taic_jax") / "programs"
        with contextlib.suppress(OSError):  # JAX warns of such a folder itself
            _remove_half_written(folder)
            _remove_oldest(folder)
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_compilation_cache_max_size", MAX_BYTES)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


@cache
def compiler_options() -> dict[str, str | bool]:
    """Return XLA's options for programs: on a CPU `WITHOUT_YNNPACK`, if this version of XLA has the option."""
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(lambda: 0).lower().compile(compiler_options=WITHOUT_YNNPACK)
    except jax.errors.JaxRuntimeError:  # no such option
        return {}
    return WITHOUT_YNNPACK


def _remove_half_written(folder: Path) -> None:
    """Remove incomplete programs, which JAX cannot read: they lack the file of their last use, written later."""
    for path in folder.glob("*-cache"):
        if not path.with_name(path.name.removesuffix("-cache") + "-atime").exists():
            path.unlink(missing_ok=True)


def _remove_oldest(folder: Path) -> None:
    """Remove all programs but the last used ones."""
    last_uses = sorted(folder.glob("*-atime"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in last_uses[MAX_PROGRAMS:]:
        path.with_name(path.name.removesuffix("-atime") + "-cache").unlink(missing_ok=True)
        path.unlink(missing_ok=True)
