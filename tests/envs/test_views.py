"""Views of a symmetric body: simulation commutes with them, windows are learnt from in all of them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import draw

from taic_jax.config import ConfigError, OptionsConfig
from taic_jax.config.files import load_config
from taic_jax.envs import Env, make_env
from taic_jax.envs.views import make_views, one_view
from taic_jax.options.dataset import Experience, gather, make_dataset
from taic_jax.options.learning import learn
from taic_jax.sources import make_envs
from taic_jax.types import as_arrays

VIEWS = make_views(((1, -1), (0, 1)), ((1, 1), (2, 1), (0, 1)), 3)
"""Of two observations, turned by a quarter each time, and three actions, shifted by one."""


def seen_state(env: Env, state, view: int):
    """Return the state whose body part is that of `state` in a view, at the place turned as far."""
    turned = jax.tree.map(jnp.asarray, env.views.obs(jnp.int32(view), state.obs))
    place = state.physics.qpos[:2]
    for _ in range(view):
        place = jnp.stack([-place[1], place[0]])
    nq = state.physics.qpos.shape[0]
    physics = state.physics.replace(
        qpos=jnp.concatenate([place, turned[: nq - 2]]),
        qvel=turned[nq - 2 :],
        qacc_warmstart=jnp.zeros_like(state.physics.qacc_warmstart),
    )
    return state.replace(physics=physics, obs=turned)


def test_the_ant_moves_alike_in_all_of_its_views():
    """Random actions for ten ticks: what is seen of one is what the other does."""
    env = make_env("ant")
    step = jax.jit(jax.vmap(env.step))
    start = jax.jit(env.reset)(jax.random.key(0))
    states = jax.tree.map(lambda *x: jnp.stack(x), *[seen_state(env, start, view) for view in range(4)])
    assert len(env.views) == 4
    numbers = jnp.arange(4)
    for action in jax.random.uniform(jax.random.key(1), (10, 8), minval=-1.0, maxval=1.0):
        states = step(states, jax.vmap(env.views.action, (0, None))(numbers, action))
        expected = jax.vmap(env.views.obs, (0, None))(numbers, states.obs[0])
        np.testing.assert_allclose(states.obs, expected, atol=1e-4)
    x, y = states.physics.qpos[:, 0], states.physics.qpos[:, 1]
    np.testing.assert_allclose(x[1:], [-y[0], -x[0], y[0]], atol=1e-4)
    assert jnp.abs(states.obs[1] - states.obs[0]).max() > 0.1, "the views differ"


def test_views_by_hand():
    obs, action = jnp.array([1.0, 2.0]), jnp.array([5.0, 6.0, 7.0])
    seen = [np.asarray(VIEWS.obs(jnp.int32(v), obs)).tolist() for v in range(3)]
    assert seen == [[1, 2], [-2, 1], [-1, -2]]
    seen = [np.asarray(VIEWS.action(jnp.int32(v), action)).tolist() for v in range(3)]
    assert seen == [[5, 6, 7], [6, 7, 5], [7, 5, 6]]


def test_arenas_have_the_ants_views_and_other_bodies_one():
    for name, count in (("ant_maze", 4), ("ant_turn", 4), ("half_cheetah", 1), ("nav2d", 1)):
        env = make_env(name)
        views = env.views
        assert len(views) == count and views.obs_order.shape == (count, env.proprioceptive_size)
        assert views.action_sign.shape == (count, env.action_size)


def experience() -> Experience:
    rng = np.random.default_rng(0)
    obs = draw(rng, 40, 2, 2) + jnp.array([[[3.0, 0.0]]])
    return Experience(obs, draw(rng, 40, 2, 3), draw(rng, 40, 2), jnp.zeros((40, 2), bool))


def test_windows_are_seen_whole_in_one_view_and_scales_are_of_all():
    config = as_arrays(OptionsConfig(length=2, select="random", views="all"))
    dataset = make_dataset(experience(), config, VIEWS)
    which, ticks = jnp.arange(6), jnp.full(6, 2)
    own = gather(dataset, which, ticks, 2)
    seen = gather(dataset, which, ticks, 2, jnp.full(6, 2))
    np.testing.assert_array_equal(seen.states, -own.states)
    np.testing.assert_array_equal(seen.actions, own.actions[..., jnp.array([2, 0, 1])])
    alone = make_dataset(experience(), as_arrays(OptionsConfig(length=2, select="random")), VIEWS)
    assert len(alone.views) == 1 and alone.state_scale.mean[0] > 2.5
    # Over three quarters of a turn of a vector near (3, 0): (3, 0), (0, 3) and (-3, 0).
    np.testing.assert_allclose(dataset.state_scale.mean, [0.0, 1.0], atol=0.4)


def test_options_learn_from_all_views():
    """Actions that are told apart by their order alone: from one view the code need not tell which, from three it must.

    Every window holds the same actions, so E has nothing to tell, unless it meets them in other orders.
    """
    same = experience().replace(action=jnp.broadcast_to(jnp.array([0.9, -0.9, 0.0]), (40, 2, 3)))
    kl = {}
    for views in ("one", "all"):
        config = OptionsConfig(
            length=2, size=2, hidden_size=12, mlp_sizes=(4,), steps=400, batch_size=32, learning_rate=0.02,
            lambda_kl=1e-3, lambda_pred=0.0, lambda_adv=0.0, select="random", views=views,
        )  # fmt: skip
        _, losses = jax.jit(lambda e, k, c=config: learn(c, e, k, VIEWS))(same, jax.random.key(0))
        kl[views] = float(losses["kl_loss"][-50:].mean())
        assert losses["reconstruction_loss"][-50:].mean() < 0.1
    assert kl["one"] < 0.5 and kl["all"] > 0.8, f"a third of the windows each: ln 3 nats, got {kl}"


def test_noise_on_the_state_makes_a_closed_loop_decoder_heed_the_code():
    """Actions that the state tells as well as the code: D reads them from the state, unless that is too noisy."""
    rng = np.random.default_rng(0)
    side = jnp.sign(draw(rng, 40, 1, 1))
    seen = Experience(side, 0.8 * side, draw(rng, 40, 1), jnp.zeros((40, 1), bool))
    kl = []
    for noise in (0.0, 3.0):
        config = OptionsConfig(
            length=1, size=2, hidden_size=12, mlp_sizes=(4,), decoder="closed", decoder_sizes=(16,), steps=600,
            batch_size=32, learning_rate=0.02, lambda_kl=0.03, lambda_pred=0.0, lambda_adv=0.0, select="random",
            state_noise=noise,
        )  # fmt: skip
        _, losses = jax.jit(lambda e, k, c=config: learn(c, e, k))(seen, jax.random.key(0))
        kl.append(float(losses["kl_loss"][-50:].mean()))
    assert kl[0] < 0.1 and kl[1] > 0.5, kl


def test_all_views_are_not_learnt_from_where_none_are_given():
    config = OptionsConfig(length=2, select="random", views="all")
    with pytest.raises(ValueError, match=r"options.views: all and options.choose: way need the views of the body"):
        learn(config, experience(), jax.random.key(0))


def test_a_body_of_one_side_refuses_all_views():
    config = load_config("half_cheetah")
    config = dataclasses.replace(config, options=dataclasses.replace(config.options, views="all"))
    message = "options.views: expected a body with several equal sides, as ant has, got all with half_cheetah"
    with pytest.raises(ConfigError, match=message):
        make_envs(config)
    assert len(one_view(3, 2)) == 1
