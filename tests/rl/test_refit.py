"""Refitting: its options are those of D in any view, and its windows are as D saw them. See also `test_practise`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import draw, random_model

from taic_jax.config import OptionsConfig, PractiseConfig
from taic_jax.envs import make_env
from taic_jax.options.execution import make_executor
from taic_jax.rl import refit
from taic_jax.rl.refit import AnyView, view_of
from taic_jax.types import as_arrays

OPTIONS = OptionsConfig(
    decoder="closed", length=3, size=2, batch_size=16, hidden_size=4, mlp_sizes=(4,), decoder_sizes=(8,),
    frame="heading", way_weight=2,
)  # fmt: skip


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


def compare(_loss, _options, model, state, windows, codes):
    """Take no gradient step, and return how far the windows' actions are from those of D in their states."""
    states = windows.states[:, :-1]
    decoded = jax.vmap(lambda code, seen: model.decode(code, model.see(seen, seen[:1]))[0])(codes, states)
    return state, {"error": jnp.max(jnp.abs(jnp.clip(decoded, -1.0, 1.0) - windows.actions))}


def test_it_learns_from_windows_as_d_saw_them(env, executor, monkeypatch):
    """D of the code alone gives the actions of every window in its states."""
    model = executor.model

    for name, value in (("REFIT_ENVS", 4), ("REFIT_OPTIONS", 6), ("descend", compare)):
        monkeypatch.setattr(refit, name, value)
    config = PractiseConfig(refit_steps=5)
    losses = refit.refit(as_arrays(OPTIONS), config, env, model, jax.random.key(0))[1]
    assert losses["error"].shape == (5,) and float(losses["error"].max()) < 1e-5


def test_without_views_nothing_is_turned(executor):
    plain = executor.replace(model=executor.model.replace(views=None))
    assert view_of(plain.model, jnp.array([0.4, -1.2, 2.0])) is None
    assert plain.start(jnp.array([0.4, -1.2, 2.0]), jnp.ones(27)).view is None
