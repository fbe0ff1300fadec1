"""Options that choose the view in which they are executed: which side of the body is the front."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import assert_trees_equal, draw, random_model
from tiny_runs import CONFIG, with_fields

from taic_jax.artifacts.models import load_options, save_options
from taic_jax.config import ConfigError, OptionsConfig
from taic_jax.config.checks import validate
from taic_jax.envs import make_env
from taic_jax.options.dataset import Experience
from taic_jax.options.execution import make_executor
from taic_jax.options.learning import learn
from taic_jax.sources import make_envs
from taic_jax.types import as_arrays

OPTIONS = OptionsConfig(
    decoder="closed", length=3, size=2, steps=2, batch_size=8, select="random", hidden_size=4, mlp_sizes=(4,),
    decoder_sizes=(8,), choose_view=True, termination="predict",
)  # fmt: skip
DIRECTIONS = jnp.array([[2.0, 0.5], [0.3, 1.0], [-1.0, 0.9], [0.2, -3.0]])


@pytest.fixture(scope="module")
def env():
    return make_env("ant", "mujoco")


@pytest.fixture(scope="module")
def executor(env):
    return make_executor(as_arrays(OPTIONS), random_model(OPTIONS, 27, 8).replace(views=env.views))


def test_a_direction_chooses_the_nearest_of_four_sides_and_back_undoes_it(env):
    assert [int(env.views.nearest(x)) for x in DIRECTIONS] == [0, 1, 2, 3]
    obs, action = draw(np.random.default_rng(0), 27), draw(np.random.default_rng(1), 8)
    for view in map(jnp.int32, range(4)):
        back = env.views.back(view)
        np.testing.assert_array_equal(env.views.obs(back, env.views.obs(view, obs)), obs)
        np.testing.assert_array_equal(env.views.action(back, env.views.action(view, action)), action)


def test_an_option_does_in_its_view_what_it_does_ahead(env, executor):
    """For three ticks from real states: actions, D's carry, and the memory of the termination rule."""
    rng, views = np.random.default_rng(0), env.views
    assert executor.option_size == 4
    code = jnp.array([0.4, -1.2])
    states = jax.jit(env.reset)(jax.random.key(0)).obs[None] + 0.1 * draw(rng, 4, 27)
    for view, direction in enumerate(DIRECTIONS):
        k = jnp.int32(view)
        turned, ahead = (
            executor.start(jnp.concatenate([code, x]), s)
            for x, s in ((direction, states[0]), (DIRECTIONS[0], views.obs(k, states[0])))
        )
        assert int(turned.view) == view
        for before, after in itertools.pairwise(states):
            turned, action = executor.act(turned, before, jnp.zeros(0))
            ahead, expected = executor.act(ahead, views.obs(k, before), jnp.zeros(0))
            np.testing.assert_allclose(views.action(k, action), expected, atol=1e-6)
            assert_trees_equal(turned.replace(view=k), ahead.replace(view=k))
            ends = [executor.ended(x, s, jnp.zeros(0)) for x, s in ((turned, after), (ahead, views.obs(k, after)))]
            assert ends[0] == ends[1]
        assert np.abs(np.asarray(action - expected)).max() > 0.01 or view == 0


def test_models_that_choose_are_learnt_saved_and_loaded_with_their_views(env, tmp_path):
    rng = np.random.default_rng(0)
    rows = Experience(draw(rng, 40, 2, 27), draw(rng, 40, 2, 8), draw(rng, 40, 2), jnp.zeros((40, 2), bool))
    options = dataclasses.replace(OPTIONS, termination="fixed")
    model, _ = learn(options, rows, jax.random.key(0), views=env.views)
    assert_trees_equal(model.views, env.views)
    save_options(tmp_path / "options", jax.tree.map(lambda x: x[None], model), env, options)
    loaded = load_options(tmp_path / "options", env, options, 1)
    assert_trees_equal(jax.tree.map(lambda x: x[0], loaded), model)
    with pytest.raises(ValueError, match=r"options.choose_view need the views of the body"):
        learn(options, rows, jax.random.key(0))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"train__fine_tune__epochs": 1, "train__fine_tune__minibatch_size": 4},
            "train.fine_tune.epochs: expected 0 with options.choose_view, got 1",
        ),
        ({"options__refresh_every": 1}, "options.refresh_every: expected 0 with options.choose_view, got 1"),
        ({"options__codes": 4}, "options.codes: expected 0 with options.choose_view, got 4"),
    ],
)
def test_what_would_change_d_in_one_view_is_refused(fields, message):
    validate(config := with_fields(CONFIG, options__choose_view=True))
    with pytest.raises(ConfigError) as error:
        validate(with_fields(config, **fields))
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("options__choose_view", True, "options.choose_view: expected a body with 4 equal sides, as ant has, got True"),
        ("options__frame", "heading", "options.frame: expected a body with a heading, as ant has, got heading"),
        ("options__way_weight", 3, "options.way_weight: expected a body with a heading, as ant has, got 3"),
    ],
)
def test_a_body_without_sides_or_heading_is_refused(field, value, message):
    with pytest.raises(ConfigError) as error:
        make_envs(with_fields(CONFIG, env__name="half_cheetah", **{field: value}))
    assert message in str(error.value)
