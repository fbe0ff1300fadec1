"""Refitting: its options are those of D in any view, and its windows are as D saw them. See also `test_practise`."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import draw, random_model

from taic_jax.config import OptionsConfig
from taic_jax.envs import make_env
from taic_jax.options.dataset import Window
from taic_jax.options.execution import make_executor
from taic_jax.rl.refit import AnyView, seen_in_view, view_of
from taic_jax.types import as_arrays

OPTIONS = OptionsConfig(
    decoder="closed", length=3, size=2, hidden_size=4, mlp_sizes=(4,), decoder_sizes=(8,), frame="heading", way_weight=2
)


@pytest.fixture(scope="module")
def env():
    return make_env("ant", "mujoco")


@pytest.fixture(scope="module")
def executor(env):
    model = random_model(OPTIONS, 27, 8, env.heading).replace(views=env.views)
    plain = make_executor(as_arrays(OPTIONS), model)
    return AnyView(model, plain.termination, plain.length)


def test_every_view_is_as_likely(executor):
    options = draw(np.random.default_rng(0), 2000, 3)
    views = jax.vmap(lambda option: view_of(executor.model, option))(options)
    np.testing.assert_allclose(np.bincount(views, minlength=4) / 2000, 0.25, atol=0.03)
    assert int(view_of(executor.model, jnp.array([0.0, 0.0, 9.0]))) == 3


def test_windows_are_as_d_saw_them(env, executor):
    """D of the code alone, without views, gives the window's actions in the window's states."""
    rng, model = np.random.default_rng(1), executor.model
    states = jax.jit(env.reset)(jax.random.key(0)).obs[None] + 0.1 * draw(rng, 4, 27)
    plain = make_executor(as_arrays(OPTIONS), model.replace(views=None))
    for number in (-1.0, -0.3, 0.3, 1.0):
        option, actions = jnp.array([0.4, -1.2, number]), []
        running = executor.start(option, states[0])
        for before, _ in itertools.pairwise(states):
            running, action = executor.act(running, before, jnp.zeros(0))
            actions.append(action)
        window = seen_in_view(model, Window(states, jnp.stack(actions), jnp.ones(3, bool)), option)
        carry = plain.start(option[:2], window.states[0])
        for i in range(3):
            carry, expected = plain.act(carry, window.states[i], jnp.zeros(0))
            np.testing.assert_allclose(window.actions[i], expected, atol=1e-6)


def test_without_views_nothing_is_turned(env, executor):
    plain = executor.replace(model=executor.model.replace(views=None))
    window = Window(jnp.ones((4, 27)), jnp.ones((3, 8)), jnp.ones(3, bool))
    assert seen_in_view(plain.model, window, jnp.array([0.4, -1.2, 2.0])) is window
    assert plain.start(jnp.array([0.4, -1.2, 2.0]), jnp.ones(27)).view is None
