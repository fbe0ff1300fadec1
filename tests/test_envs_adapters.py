"""Brax's environments behind our contract."""

import jax
import jax.numpy as jnp
import numpy as np
from brax import envs as brax_envs

from taic_jax.envs import AutoReset, TimeLimit, make_env
from taic_jax.envs.third_party import third_party


def test_adapter_is_braxs_own_step():
    """Ten ticks of the inverted pendulum, which falls on the way; both in one program, to compile once."""
    env = make_env("brax:inverted_pendulum")
    with third_party():
        theirs = brax_envs.get_environment("inverted_pendulum", backend="spring")
    actions = jnp.array([-1.0, *[1.0] * 9])[:, None]

    def our_episode(key):
        return jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, env.reset(key), actions)[1]

    def their_episode(key):
        with third_party():
            return jax.lax.scan(lambda s, a: (theirs.step(s, a),) * 2, theirs.reset(key), actions)[1]

    ours, expected = jax.jit(lambda key: (our_episode(key), their_episode(key)))(jax.random.key(0))
    np.testing.assert_array_equal(ours.obs, expected.obs)
    np.testing.assert_array_equal(ours.reward, expected.reward)
    np.testing.assert_array_equal(ours.terminated, expected.done.astype(bool))
    np.testing.assert_array_equal(ours.physics.pipeline_state.q, expected.pipeline_state.q)
    assert ours.terminated.any() and not ours.truncated.any()
    assert env.episode_length == 1000 and env.dt == 0.02


def test_step_keeps_what_reset_made():
    """Brax's pendulum itself does not: its step makes a weakly typed number, which would compile twice."""
    env = make_env("brax:inverted_pendulum").env
    state = jax.eval_shape(env.reset, jax.random.key(0)).replace(tick=jax.ShapeDtypeStruct((), jnp.int32))
    after = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((1,), jnp.float32))
    assert jax.tree.structure(after) == jax.tree.structure(state)
    for one, other in zip(jax.tree.leaves(state), jax.tree.leaves(after), strict=True):
        assert (one.shape, one.dtype, one.weak_type) == (other.shape, other.dtype, other.weak_type)


def test_time_limit_is_ours():
    env = AutoReset(TimeLimit(make_env("brax:fast"), 3))
    step, state = jax.jit(env.step), env.reset(jax.random.key(0))
    for tick in range(1, 7):
        state = step(state, jnp.ones(1))
        assert bool(state.truncated) == (tick % 3 == 0) and not state.terminated
