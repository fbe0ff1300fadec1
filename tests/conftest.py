"""Strict modes for every test: no silent promotion of dtypes or ranks."""

import ctypes.util
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import beartype
import hypothesis
import jax
import pytest

# A test may import MuJoCo before the package does, which would choose how to draw without a display.
if "DISPLAY" not in os.environ:
    os.environ.setdefault("MUJOCO_GL", "egl" if ctypes.util.find_library("EGL") else "glfw")

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")
# Programs are tiny here and run once or twice, so nearly all the time goes into compiling them. Each is compiled once,
# for this process and for those that tests start. Without a largest size: JAX would look at every program of the cache,
# 0.7 s for 5,700 of them, each time it adds one.
CACHE = {
    "jax_compilation_cache_dir": str(Path(__file__).parents[1] / ".pytest_cache/programs"),
    "jax_compilation_cache_max_size": -1,
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}
for _name, _value in CACHE.items():
    jax.config.update(_name, _value)
    os.environ[_name.upper()] = str(_value)
jax.config.update("jax_disable_most_optimizations", True)
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "true"
# Two devices to split over; all that does not ask for it is on the first.
flags = "--xla_force_host_platform_device_count=2"
if jax.__version_info__ < (0, 11):  # quicker to compile; later ones have no such flag, and abort at an unknown one
    flags += " --xla_cpu_use_fusion_emitters=false"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flags}"

# The first example of a property compiles, the others do not: a deadline would only measure that.
hypothesis.settings.register_profile("taic_jax", deadline=None, max_examples=25)
hypothesis.settings.load_profile("taic_jax")


HEAVY = ("kills", "readme", "hosts", "sweep", "signals", "throughput", "transfer", "pipeline", "pbt", "files")
"""Files that take longest. They are begun first, or one process would still be at the last while the others idle."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the tests of heavy files first; pytest-xdist is told to keep this order."""
    names = [f"test_{name}.py" for name in HEAVY]
    items.sort(key=lambda item: names.index(item.path.name) if item.path.name in names else len(names))


def check_functions(function: Callable) -> Callable:
    """Check the types and shapes of a call, but for a dataclass's `__init__`: JAX rebuilds trees with placeholders."""
    return function if function.__name__ == "__init__" else beartype.beartype(function)


@pytest.fixture
def limit() -> Iterator[Callable[[int | None], None]]:
    """Give a function that lets no file grow beyond so many bytes, as on a disk that is full; None takes it back."""
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (soft if size is None else size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
