"""Options chosen by the way that they shall lead: P tells which code, and which side of the body as its front."""

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
from taic_jax.options.choice import menu
from taic_jax.options.dataset import Experience
from taic_jax.options.execution import make_executor
from taic_jax.options.learning import learn
from taic_jax.options.model import OptionModel
from taic_jax.sources import make_envs
from taic_jax.types import as_arrays

OPTIONS = OptionsConfig(
    decoder="closed", length=3, size=2, steps=2, batch_size=8, select="random", hidden_size=4, mlp_sizes=(4,),
    decoder_sizes=(8,), frame="heading", way_weight=2, choose="way", termination="predict",
)  # fmt: skip
BY_WAY = {"options__choose": "way", "options__frame": "heading", "options__way_weight": 4}


@pytest.fixture(scope="module")
def env():
    return make_env("ant", "mujoco")


@pytest.fixture(scope="module")
def executor(env):
    return make_executor(as_arrays(OPTIONS), random_model(OPTIONS, 27, 8, env.heading).replace(views=env.views))


def facing(env, yaw):
    """Return a level state with this yaw in rad."""
    at = env.heading.quaternion
    return jnp.zeros(27).at[at].set(np.cos(yaw / 2)).at[at + 3].set(np.sin(yaw / 2))


def test_views_turn_directions_as_they_turn_velocities(env):
    at, velocity = env.heading.quaternion, env.heading.velocity
    state = jnp.zeros(27).at[at].set(1.0).at[velocity : velocity + 2].set(jnp.array([0.6, -1.1]))
    seen = [env.views.obs(jnp.int32(view), state)[velocity : velocity + 2] for view in range(4)]
    np.testing.assert_allclose(env.views.directions(jnp.array([0.6, -1.1])), seen, atol=1e-6)


@pytest.mark.parametrize("yaw", [0.0, 2.5])
def test_a_way_chooses_the_side_and_the_code_that_lead_along_it(env, executor, monkeypatch, yaw):
    """By a P that says that a code leads to the left of ahead by its first entry in rad."""
    monkeypatch.setattr(OptionModel, "way", lambda _, state, code: jnp.stack([jnp.cos(code[0]), jnp.sin(code[0])]))
    assert executor.option_size == 2
    for angle in np.radians([-170, -100, -40, -10, 0, 30, 60, 120]):
        way = 3.0 * jnp.array([np.cos(angle + yaw), np.sin(angle + yaw)])
        running = executor.start(way, facing(env, yaw))
        # View k sees the world turned to the left by k quarters.
        seen = (angle + int(running.view) * np.pi / 2 + np.pi) % (2 * np.pi) - np.pi
        assert abs(seen - float(running.option[0])) < 0.15


def test_among_codes_that_lead_the_same_way_the_farthest_is_chosen(env, executor, monkeypatch):
    monkeypatch.setattr(OptionModel, "way", lambda _, state, code: jnp.stack([2.0 + code[1], 0.0 * code[1]]))
    running = executor.start(jnp.array([1.0, 0.0]), facing(env, 0.0))
    codes = menu(2)
    np.testing.assert_allclose(running.option, codes[np.argmax(codes[:, 1])], rtol=1e-6)
    assert int(running.view) == 0


def test_a_code_that_leads_farther_but_more_aside_is_not_chosen(env, executor, monkeypatch):
    """By a P of which each metre more ahead costs one and a half to the side, or a half."""
    codes = np.abs(menu(2)[:, 0])
    for slope, chosen in ((1.5, np.argmin(codes)), (-0.5, np.argmax(codes))):
        aside = jnp.array([1.0, slope])
        monkeypatch.setattr(
            OptionModel, "way", lambda *x, aside=aside: jnp.array([2.0, 0.0]) + jnp.abs(x[2][0]) * aside
        )
        running = executor.start(jnp.array([1.0, 0.0]), facing(env, 0.0))
        np.testing.assert_allclose(running.option, menu(2)[chosen], rtol=1e-6)


def test_the_menu_is_the_middle_of_the_prior():
    """Of four dimensions a quarter of the prior lies within 1.39, the root of a chi-squared quantile."""
    codes = menu(4)
    assert codes.shape == (64, 4) and 1.2 < np.linalg.norm(codes, axis=1).max() < 1.55
    np.testing.assert_allclose(codes.mean(axis=0), 0.0, atol=0.3)


def test_the_way_of_a_code_is_ps_prediction(executor):
    model, state, code = executor.model, draw(np.random.default_rng(1), 27), jnp.array([0.3, -0.9])
    predicted = model.predict(state, code) * model.change_scale.std + model.change_scale.mean
    np.testing.assert_array_equal(model.way(state, code), predicted[27:])


@pytest.mark.parametrize("angle", [0.0, np.pi / 2, np.pi, -np.pi / 2])
def test_p_sees_the_state_in_every_view(env, executor, monkeypatch, angle):
    """By a P that says that an ant goes on ahead if it does so now, and otherwise nowhere."""
    at = env.heading.velocity
    scale = executor.model.state_scale

    def way(_, state, code):
        ahead = (state * scale.std + scale.mean)[at]
        return jnp.stack([jnp.where(ahead > 0.1, ahead, 0.0), jnp.zeros(())])

    monkeypatch.setattr(OptionModel, "way", way)
    moving = jnp.array([np.cos(angle), np.sin(angle)], jnp.float32)
    state = facing(env, 0.0).at[at : at + 2].set(moving)
    running = executor.start(moving, state)
    assert int(running.view) == round(-angle / (np.pi / 2)) % 4


def test_an_option_does_in_its_view_what_it_does_ahead(env, executor):
    """For three ticks from real states: actions, D's carry, and the memory of the termination rule."""
    rng, views = np.random.default_rng(0), env.views
    states = jax.jit(env.reset)(jax.random.key(0)).obs[None] + 0.1 * draw(rng, 4, 27)
    ahead = executor.replace(by_way=False, model=executor.model.replace(views=None))
    seen = set()
    for x, y in ((1.0, 0.2), (0.1, 1.0), (-1.0, 0.0), (0.2, -1.0)):
        running = executor.start(jnp.array([x, y]), states[0])
        k = running.view
        seen.add(int(k))
        plain = ahead.start(running.option, views.obs(k, states[0]))
        for before, after in itertools.pairwise(states):
            running, action = executor.act(running, before, jnp.zeros(0))
            plain, expected = ahead.act(plain, views.obs(k, before), jnp.zeros(0))
            np.testing.assert_allclose(views.action(k, action), expected, atol=1e-6)
            assert_trees_equal(running.replace(view=None), plain)
            assert executor.ended(running, after, jnp.zeros(0)) == ahead.ended(plain, views.obs(k, after), jnp.zeros(0))
    assert len(seen) == 4


def test_models_that_choose_are_learnt_saved_and_loaded_with_their_views(env, tmp_path):
    rng = np.random.default_rng(0)
    rows = Experience(draw(rng, 40, 2, 27), draw(rng, 40, 2, 8), draw(rng, 40, 2), jnp.zeros((40, 2), bool))
    options = dataclasses.replace(OPTIONS, termination="fixed")
    model, _ = learn(options, rows, jax.random.key(0), views=env.views, heading=env.heading)
    assert_trees_equal(model.views, env.views)
    save_options(tmp_path / "options", jax.tree.map(lambda x: x[None], model), env, options)
    loaded = load_options(tmp_path / "options", env, options, 1)
    assert_trees_equal(jax.tree.map(lambda x: x[0], loaded), model)
    with pytest.raises(ValueError, match=r"options.choose: way need the views of the body"):
        learn(options, rows, jax.random.key(0))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"train__fine_tune__epochs": 1, "train__fine_tune__minibatch_size": 4},
            "train.fine_tune.epochs: expected 0 with options.choose way, got 1",
        ),
        ({"options__refresh_every": 1}, "options.refresh_every: expected 0 with options.choose way, got 1"),
        ({"options__codes": 4}, "options.codes: expected 0 with options.choose way, got 4"),
    ],
)
def test_what_would_change_d_or_its_codes_is_refused(fields, message):
    validate(config := with_fields(CONFIG, **BY_WAY))
    with pytest.raises(ConfigError) as error:
        validate(with_fields(config, **fields))
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("options__frame", "heading", "options.frame: expected a body with a heading, as ant has, got heading"),
        ("options__way_weight", 3, "options.way_weight: expected a body with a heading, as ant has, got 3"),
    ],
)
def test_a_body_without_sides_or_heading_is_refused(field, value, message):
    with pytest.raises(ConfigError) as error:
        make_envs(with_fields(CONFIG, env__name="half_cheetah", **{field: value}))
    assert message in str(error.value)


@pytest.mark.parametrize(("field", "needed"), [("frame", "heading"), ("way_weight", "16")])
def test_a_choice_by_the_way_needs_codes_that_say_where_they_lead(field, needed):
    neutral = {"frame": "world", "way_weight": 0}[field]
    with pytest.raises(ConfigError, match=rf"options.{field}: expected {needed} with options.choose way, .*, got"):
        validate(with_fields(CONFIG, **(BY_WAY | {f"options__{field}": neutral})))
