"""The physics backends: purity, batching, agreement."""

import concurrent.futures
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from taic_jax.envs import PhysicsState, make_env
from taic_jax.envs.physics import MujocoPhysics, make_physics
from taic_jax.envs.physics.mujoco import num_physical_cores


@functools.cache
def model(name: str):
    """Return a robot's model and its initial pose."""
    env = make_env(name, "mujoco").env
    return env.model, env._init_qpos


def states(name: str, *batch: int, seed: int = 0):
    """Draw physics states and controls with those leading axes."""
    mj_model, qpos = model(name)
    rng = np.random.default_rng(seed)

    def draw(size, scale, mean=0.0):
        return jnp.array(rng.normal(mean, scale, (*batch, size)), jnp.float32)

    state = PhysicsState(draw(mj_model.nq, 0.05, qpos), draw(mj_model.nv, 0.5), draw(mj_model.nv, 1.0))
    return state, draw(mj_model.nu, 0.5)


def assert_same(one, other):
    """Compare bit for bit."""
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.parametrize("name", ["half_cheetah", "ant"])
def test_nested_vmap_equals_a_loop_bit_for_bit(name):
    physics = MujocoPhysics(model(name)[0], 5)
    state, ctrl = states(name, 2, 3)
    nested = jax.jit(jax.vmap(jax.vmap(physics.step)))(state, ctrl)
    step = jax.jit(physics.step)
    for i in range(2):
        for j in range(3):
            pick = lambda leaf, i=i, j=j: leaf[i, j]  # noqa: E731
            assert_same(step(jax.tree.map(pick, state), ctrl[i, j]), jax.tree.map(pick, nested))


def test_vmap_over_controls_alone():
    """`broadcast_all`: what is not batched is broadcast."""
    physics = MujocoPhysics(model("ant")[0], 5)
    state, _ = states("ant")
    _, ctrl = states("ant", 4)
    after = jax.jit(jax.vmap(physics.step, (None, 0)))(state, ctrl)
    assert_same(jax.tree.map(lambda leaf: leaf[2], after), jax.jit(physics.step)(state, ctrl[2]))


def test_the_way_for_accelerators_gives_the_same(monkeypatch):
    """There, `pure_callback` copies to the host and back."""
    physics = MujocoPhysics(model("ant")[0], 5)
    state, ctrl = states("ant", 2, 3)
    expected = jax.jit(jax.vmap(jax.vmap(physics.step)))(state, ctrl)
    monkeypatch.setattr(jax.lax, "platform_dependent", lambda sent, cpu, default: default(sent))
    program = jax.jit(lambda state, ctrl: jax.vmap(jax.vmap(physics.step))(state, ctrl))
    assert "pure_callback" in str(jax.make_jaxpr(program)(state, ctrl))
    assert_same(expected, program(state, ctrl))


def test_result_depends_on_the_arguments_alone():
    """Not on what the engine stepped before, nor on the number of threads."""
    physics = MujocoPhysics(model("ant")[0], 5, num_threads=2)
    step = jax.jit(jax.vmap(physics.step))
    first = step(*states("ant", 7, seed=1))
    for seed in range(2, 5):
        step(*states("ant", 7, seed=seed))
    assert_same(first, step(*states("ant", 7, seed=1)))
    alone = MujocoPhysics(model("ant")[0], 5, num_threads=1)
    assert_same(first, jax.jit(jax.vmap(alone.step))(*states("ant", 7, seed=1)))


def test_a_diverged_simulation_does_not_touch_its_neighbours_or_the_next_call(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning to a file in the working folder
    physics = MujocoPhysics(model("ant")[0], 5)
    step = jax.jit(jax.vmap(physics.step))
    state, ctrl = states("ant", 3)
    good = step(state, ctrl)
    bad = step(state.replace(qvel=state.qvel.at[1].set(jnp.inf)), ctrl)
    assert np.isnan(bad.qpos[1]).all() and np.isnan(bad.qvel[1]).all()
    assert_same(jax.tree.map(lambda leaf: leaf[::2], good), jax.tree.map(lambda leaf: leaf[::2], bad))
    assert_same(good, step(state, ctrl))


def test_callers_in_several_threads_do_not_meet():
    physics = MujocoPhysics(model("half_cheetah")[0], 5)
    step = jax.jit(jax.vmap(physics.step))
    inputs = [states("half_cheetah", 16, seed=seed) for seed in range(4)]
    expected = [step(*args) for args in inputs]
    with concurrent.futures.ThreadPoolExecutor(4) as pool:
        got = list(pool.map(lambda i: jax.block_until_ready(step(*inputs[i % 4])), range(40)))
    for i, result in enumerate(got):
        assert_same(result, expected[i % 4])


def test_substeps_are_engine_steps():
    """One tick of five substeps is five ticks of one."""
    one, five = MujocoPhysics(model("ant")[0], 1), MujocoPhysics(model("ant")[0], 5)
    state, ctrl = states("ant")
    after = state
    for _ in range(5):
        after = one.step(after, ctrl)
    expected = five.step(state, ctrl)
    np.testing.assert_allclose(after.qpos, expected.qpos, atol=1e-5)
    np.testing.assert_allclose(after.qvel, expected.qvel, atol=1e-4)


def test_threads_default_to_physical_cores():
    each = max(1, num_physical_cores() // jax.local_device_count())
    assert each == MujocoPhysics(model("ant")[0], 1).num_threads


def test_auto_takes_the_engine_on_cpu():
    assert isinstance(make_physics(model("ant")[0], 5, "auto"), MujocoPhysics)


@pytest.mark.parametrize(
    "name", ["ant", *(pytest.param(n, marks=pytest.mark.slow) for n in ("half_cheetah", "hopper", "walker2d"))]
)
def test_mjx_agrees_with_the_engine(name):
    """In the air for 20 ticks, in contact for one; MJX computes in single precision."""
    env = make_env(name, "mjx").env
    engine = jax.jit(jax.vmap(MujocoPhysics(env.model, env.physics.substeps).step))
    step = jax.jit(jax.vmap(env.physics.step))

    height = env.robot.height_index
    state, _ = states(name, 8)
    state = ours = theirs = state.replace(qpos=state.qpos.at[:, height].add(20.0))
    for tick in range(20):
        _, ctrl = states(name, 8, seed=tick)
        ours, theirs = step(ours, ctrl), engine(theirs, ctrl)
    for got, wanted in ((ours.qpos, theirs.qpos), (ours.qvel, theirs.qvel)):
        np.testing.assert_allclose(got, wanted, rtol=1e-3, atol=1e-3 * float(jnp.abs(wanted).max()))

    state, ctrl = states(name, 8)
    for _ in range(30):
        state = engine(state, ctrl)  # fall to the ground and move there
    ours, theirs = step(state, ctrl), engine(state, ctrl)
    np.testing.assert_allclose(ours.qpos, theirs.qpos, atol=1e-4)
    np.testing.assert_allclose(ours.qvel, theirs.qvel, atol=1e-2)
