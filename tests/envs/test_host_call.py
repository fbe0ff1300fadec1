"""Host calls: their known answer, and the slower way that physics takes where XLA refuses them or answers otherwise."""

import subprocess
import sys

import jax
import numpy as np
import pytest

from taic_jax.envs import make_env
from taic_jax.envs.physics import host_call
from taic_jax.envs.physics.host_call import HostCall, host_calls_work

# A HalfCheetah that takes three ticks, as programs that trainers compile do: within jit, vmap and scan.
STEPS = """
import jax, jax.numpy as jnp
from taic_jax.envs import make_env
from taic_jax.envs.physics import host_call
{change}
env = make_env("half_cheetah", "mujoco")
states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 2))
step = lambda states, _: (jax.vmap(env.step)(states, jnp.full((2, 6), 0.3)), None)
program = jax.jit(lambda states: jax.lax.scan(step, states, length=3)[0].obs)
print("ffi_call" in str(jax.make_jaxpr(program)(states)), program(states).tolist())
"""
CHANGES = {
    "as it is": ("", None),
    "an XLA of another version": ("host_call.API_VERSION = (1, 0)", "handler's API version (1.0) is incompatible"),
    "another layout of results": ("host_call._answer = lambda argument, one, result: None", "known answer went wrong"),
    "another layout of arguments": ("host_call._NUM_ARGUMENTS = 6", "missing 2 required positional arguments"),
    "errors that get lost": ("host_call._as_error = lambda api, message: None", "known answer went wrong"),
}


@pytest.mark.parametrize(("change", "reason"), CHANGES.values(), ids=CHANGES)
def test_an_unlike_xla_is_refused_with_one_warning_and_physics_goes_the_slower_way(change, reason):
    code = STEPS.format(change=change)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    directly, _, observations = done.stdout.partition(" ")
    warnings = [line for line in done.stderr.splitlines() if line.startswith("taic_jax: warning: ")]
    assert (directly == "False", len(warnings)) == (reason is not None, reason is not None)
    assert reason is None or reason in warnings[0]
    np.testing.assert_array_equal(eval(observations), expected())


def expected() -> np.ndarray:
    """Return the observations after three ticks, stepped in this process."""
    env = make_env("half_cheetah", "mujoco")
    states = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 2))
    for _ in range(3):
        states = jax.jit(jax.vmap(env.step))(states, np.full((2, 6), 0.3, np.float32))
    return np.asarray(states.obs)


def test_a_process_without_a_cpu_device_is_not_warned(monkeypatch, capfd):
    def no_device(backend):
        raise RuntimeError(f"Unknown backend {backend}")

    monkeypatch.setattr(jax, "local_devices", no_device)
    assert not host_calls_work.__wrapped__()
    assert capfd.readouterr().err == ""


def test_the_known_answer_is_asked_for_while_a_program_is_traced_too(monkeypatch):
    named = lambda _, function: HostCall("taic_jax_probe_while_traced", function)  # noqa: E731
    monkeypatch.setattr(host_call, "HostCall", named)
    answers = []
    jax.jit(lambda x: (answers.append(host_calls_work.__wrapped__()), x)[1])(1.0)
    assert answers == [True]


def test_a_script_may_end_while_its_programs_run():
    """Two hundred ticks of 64 hoppers are dispatched, and nothing waits for them."""
    code = """
import jax, jax.numpy as jnp
from taic_jax.envs import make_env
env = make_env("hopper", "mujoco")
state, step = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 64)), jax.jit(jax.vmap(env.step))
for _ in range(200):
    state = step(state, jnp.zeros((64, 3)))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
