"""Nothing is compiled twice: not for other values, other seeds, a run that goes on, or another process."""

import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from tiny_runs import CONFIG, KilledError, die, tiny_steps, with_fields

from taic_jax.config import Config
from taic_jax.nonfinite import begin
from taic_jax.pipeline import run_pipeline
from taic_jax.runtime import program_cache as compilation
from taic_jax.runtime.checkpoint import Checkpoints
from taic_jax.runtime.devices import Devices
from taic_jax.runtime.driver import resume
from taic_jax.runtime.program_cache import keep_programs

HIT, MISS = "/jax/compilation_cache/cache_hits", "/jax/compilation_cache/cache_misses"
STEP = """
import jax, jax.numpy as jnp
from taic_jax.envs import make_env
count = []
jax.monitoring.register_event_listener(lambda event, **_: count.append(event) if "cache_" in event else None)
env = make_env("hopper", "mujoco", num_threads=1)
state = jax.eval_shape(env.reset, jax.random.key(0))
jax.jit(env.step).lower(state, jnp.zeros(3)).compile()
print(count.count("/jax/compilation_cache/cache_hits"), count.count("/jax/compilation_cache/cache_misses"))
"""


@pytest.fixture
def events() -> Iterator[Counter]:
    """Count what JAX tells of its cache."""
    count: Counter = Counter()

    def listen(event: str, **_) -> None:
        count[event] += 1

    jax.monitoring.register_event_listener(listen)
    yield count
    jax.monitoring.unregister_event_listener(listen)


def run_in_two_parts(config: Config, folder: Path) -> None:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(KilledError):
        die(patch, Checkpoints, "save", 5)
        run_pipeline(config, folder)
    run_pipeline(config, folder, resume=True)


def test_other_values_and_seeds_and_a_run_that_goes_on_compile_nothing(events, tmp_path):
    changed = with_fields(CONFIG, seed=7, train__ppo__gamma=0.9, options__lambda_kl=0.5, collect__ppo__clip=0.3)
    with tiny_steps():
        run_in_two_parts(CONFIG, tmp_path / "first")
        events.clear()
        run_in_two_parts(changed, tmp_path / "second")
    assert events[MISS] == 0 < events[HIT]


def test_a_run_begins_with_the_types_that_it_resumes_with(tmp_path):
    guard = begin({"weak": jnp.asarray(1.0)[None]}, jnp.zeros(1, jnp.int32))
    assert guard.state["weak"].weak_type
    resumed, step = resume(Checkpoints(tmp_path), guard)
    assert step == 0 and not resumed.state["weak"].weak_type


def test_products_of_matrices_are_not_left_to_ynnpack():
    x = jnp.ones((64, 64))
    assert "__ynn" in jax.jit(lambda x: x @ x).lower(x).compile().as_text()
    assert "__ynn" not in Devices().compile(lambda x: x @ x, x).as_text()


def test_an_option_that_xla_does_not_know_is_left_out(monkeypatch):
    monkeypatch.setattr(compilation, "WITHOUT_YNNPACK", {"xla_no_such_option": ""})
    assert compilation.compiler_options.__wrapped__() == {}


def test_a_program_with_physics_is_found_by_another_process(tmp_path):
    def count() -> list[int]:
        settings = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        told = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", STEP],
            env={**os.environ, **settings},
            check=True,
            capture_output=True,
        )  # fmt: skip
        return [int(word) for word in told.stdout.split()]

    (_, misses), (hits, again) = count(), count()
    assert misses > 0 and (hits, again) == (misses, 0)


def test_a_folder_that_jax_was_told_is_kept():
    before = jax.config.values["jax_compilation_cache_dir"]
    keep_programs()
    assert jax.config.values["jax_compilation_cache_dir"] == before


def test_else_it_is_the_users_without_what_is_half_written_or_long_unused(monkeypatch, tmp_path):
    monkeypatch.setattr("platformdirs.user_cache_path", lambda name: tmp_path / name)
    monkeypatch.setattr(compilation, "MAX_PROGRAMS", 1)
    told = {
        name: getattr(jax.config, name) for name in jax.config.values if name.startswith("jax_") and "cache" in name
    }
    folder = tmp_path / "taic_jax/programs"
    folder.mkdir(parents=True)
    for i, name in enumerate(("half-cache", "old-cache", "old-atime", "whole-cache", "whole-atime")):
        (folder / name).touch()
        os.utime(folder / name, (i, i))
    try:
        jax.config.update("jax_compilation_cache_dir", None)
        keep_programs()
        assert jax.config.values["jax_compilation_cache_dir"] == str(folder)
        assert {path.name for path in folder.iterdir()} == {"whole-cache", "whole-atime"}
    finally:
        for name, value in told.items():
            jax.config.update(name, value)
