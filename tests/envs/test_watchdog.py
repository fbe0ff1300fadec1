"""A call into the engine that does not return is told of, once, and others are not."""

import gc
import time

import jax
import jax.numpy as jnp
import mujoco.batch

from taic_jax.envs import make_env
from taic_jax.envs.physics import mujoco as backend
from taic_jax.envs.physics.watchdog import Watchdog


def test_a_late_call_is_told_once(capfd):
    watchdog = Watchdog(0.2, "too long")
    for seconds in (0.0, 0.7, 0.0, 0.5):
        with watchdog:
            time.sleep(seconds)
    assert capfd.readouterr().err.count("taic_jax: too long\n") == 2


def test_calls_in_time_are_not(capfd):
    watchdog, end = Watchdog(0.2, "too long"), time.monotonic() + 0.6
    while time.monotonic() < end:
        with watchdog:
            time.sleep(0.01)
    assert capfd.readouterr().err == ""


def test_its_thread_ends_with_it():
    watchdog = Watchdog(0.04, "too long")
    with watchdog:
        thread = watchdog._thread
    assert thread and thread.is_alive()
    del watchdog
    gc.collect()
    thread.join(timeout=5)
    assert not thread.is_alive()


def test_a_hanging_engine_is_told_with_a_remedy(monkeypatch, capfd):
    monkeypatch.setattr(backend, "PATIENCE", 0.2)
    env = make_env("hopper", "mujoco", num_threads=3)  # an engine that no other test has made
    state = jax.jit(env.reset)(jax.random.key(0))
    step = jax.jit(env.step)
    jax.block_until_ready(step(state, jnp.zeros(3)))
    monkeypatch.setattr(mujoco.batch.Batch, "step", lambda *args, **kwargs: time.sleep(0.6))
    jax.block_until_ready(step(state, jnp.zeros(3)))
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and "--resume" in err and "--env.num-threads 1" in err
