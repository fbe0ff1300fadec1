"""The frame of the heading: turning the world changes nothing that options see, and the way is where the body went."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from taic_jax.config import OptionsConfig
from taic_jax.envs import make_env
from taic_jax.options.dataset import Experience, Window
from taic_jax.options.execution import make_executor
from taic_jax.options.frame import Frame, make_frame
from taic_jax.options.learning import learn, window_losses
from taic_jax.options.losses import reconstruction_loss
from taic_jax.options.termination import prefix_errors
from taic_jax.rl.refresh import action_change
from taic_jax.types import as_arrays

CONFIG = OptionsConfig(
    decoder="closed", frame="heading", way_weight=4, length=5, size=2, steps=3, batch_size=16, select="random",
    hidden_size=8, mlp_sizes=(8,), decoder_sizes=(8,),
)  # fmt: skip
TICKS = 30


@pytest.fixture(scope="module")
def walks():
    """The same random actions from starts that differ by a turn: angles [N], observations and places [N, T, ...]."""
    env = make_env("ant", "mujoco", contacts="body")
    angles = jnp.array([0.0, 1.3, 3.0, -2.0])
    first = jax.jit(env.reset)(jax.random.key(0))
    actions = jax.random.uniform(jax.random.key(1), (TICKS, 8), minval=-1.0)

    return env, angles, actions, *jax.jit(jax.vmap(partial(walk, env, first, actions)))(angles)


def walk(env, first, actions, angle):
    """Return the observations and places of a walk that starts turned by an angle."""
    physics = first.physics
    qpos = physics.qpos.at[3:7].set(product(turn_of(angle), physics.qpos[3:7]))
    qpos = qpos.at[:2].set(rotated(qpos[:2], angle))
    qvel = physics.qvel.at[:2].set(rotated(physics.qvel[:2] + jnp.array([6.0, 3.0]), angle))
    physics = physics.replace(qpos=qpos, qvel=qvel)
    state = first.replace(physics=physics, obs=jnp.concatenate([qpos[2:], qvel]))

    def tick(state, action):
        after = env.step(state, action)
        return after, (state.obs, state.physics.qpos[:2])

    return jax.lax.scan(tick, state, actions)[1]


def turn_of(angle):
    return jnp.array([jnp.cos(angle / 2), 0.0, 0.0, jnp.sin(angle / 2)])


def product(p, q):
    """Return the product of two quaternions, by its definition."""
    (a, u), (b, v) = (p[0], p[1:]), (q[0], q[1:])
    return jnp.concatenate([(a * b - u @ v)[None], a * v + b * u + jnp.cross(u, v)])


def rotated(vector, angle):
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def test_a_turn_of_the_world_changes_nothing_that_is_seen(walks):
    env, _, _, obs, _ = walks
    frame = make_frame(CONFIG, env.heading)
    for seen in (jax.vmap(frame.seen)(obs, obs), jax.vmap(frame.seen)(obs, obs[:, :1]), jax.vmap(frame.changes)(obs)):
        for other in seen[1:]:
            np.testing.assert_allclose(other[:10], seen[0][:10], atol=2e-2)  # contacts amplify roundings
    assert np.abs(obs[1, 0] - obs[0, 0]).max() > 0.3
    world = Frame(env.heading, turns=False, weight=1)
    np.testing.assert_array_equal(world.seen(obs, obs), obs)


def test_the_heading_has_no_yaw_and_the_forward_speed_first(walks):
    env, angles, *_ = walks
    frame, state = make_frame(CONFIG, env.heading), jnp.zeros(27)
    for angle in angles:
        tilted = product(turn_of(angle), jnp.array([jnp.cos(0.2), 0.0, jnp.sin(0.2), 0.0]))
        ahead = state.at[1:5].set(-tilted).at[13:16].set(jnp.array([*(2 * rotated(jnp.array([1.0, 0.0]), angle)), 0.7]))
        seen = frame.seen(ahead, ahead)
        np.testing.assert_allclose(seen[1:5], [np.cos(0.2), 0, np.sin(0.2), 0], atol=1e-6)
        np.testing.assert_allclose(seen[13:16], [2, 0, 0.7], atol=1e-6)


def test_the_way_is_where_the_body_went(walks):
    env, angles, _, obs, place = walks
    frame = make_frame(CONFIG, env.heading)
    ways = jax.vmap(frame.changes)(obs)[:, :, -2:]
    assert ways.shape == (len(angles), TICKS - 1, 2)
    gone = place[0, 1:] - place[0, :1]
    yaw = 2 * np.arctan2(obs[0, 0, 4], obs[0, 0, 1])
    np.testing.assert_allclose(ways[0], jax.vmap(partial(rotated, angle=-yaw))(gone), atol=0.3)
    assert np.abs(gone[-1]).max() > 2.0
    world = Frame(env.heading, turns=False, weight=1)
    np.testing.assert_allclose(world.changes(obs[1])[:, -2:], place[1, 1:] - place[1, :1], atol=0.3)


@pytest.fixture(scope="module")
def model(walks):
    env, _, actions, obs, _ = walks
    actions = jnp.broadcast_to(actions[:, None], (TICKS, 4, 8))
    rows = jnp.swapaxes(obs, 0, 1), actions, jnp.zeros((TICKS, 4)), jnp.zeros((TICKS, 4), bool)
    return jax.jit(partial(learn, CONFIG, heading=env.heading))(Experience(*rows), jax.random.key(0))[0]


def test_the_model_acts_and_predicts_alike_after_a_turn(walks, model):
    _, _, _, obs, _ = walks
    executor, option = make_executor(as_arrays(CONFIG), model), jnp.array([0.5, -1.0])

    def act(first, state):
        return executor.act(executor.start(option, first), state, jnp.zeros(0))[1]

    actions = jax.vmap(jax.vmap(act, (None, 0)))(obs[:, 0], obs[:, :8])
    np.testing.assert_allclose(actions[1:], np.broadcast_to(actions[0], actions[1:].shape), atol=1e-2)
    assert np.abs(np.diff(actions[0], axis=0)).max() > 0.01
    for state, action in zip(obs[0, :3], actions[0], strict=False):
        decoded = model.decode(option, model.see(state, obs[0, 0])[None])[0][0]
        np.testing.assert_allclose(action, jnp.clip(decoded, -1.0, 1.0), atol=1e-5)
    other = jax.vmap(act, (0, None))(obs[:, 0], obs[0, 0])
    assert np.abs(other[1:] - other[:1]).max() > 0.01, "D sees how far it has turned since the option began"
    predicted = jax.vmap(lambda s: model.predict(model.see(s, s), option))(obs[:, 0])
    assert predicted.shape == (4, 29)
    np.testing.assert_allclose(predicted[1:], np.broadcast_to(predicted[0], predicted[1:].shape), atol=1e-4)


def test_d_learns_from_what_it_sees_when_it_acts(walks, model):
    """In stage learn, and when a refresh holds its actions: from the heading of the window's first state."""
    _, _, actions, obs, _ = walks
    window, noise = Window(obs[1, 3:9], actions[3:8], jnp.ones(5, bool)), jnp.array([0.3, -0.6])
    means, log_stds = model.encode(window.actions)
    option, seen = means[-1] + jnp.exp(log_stds[-1]) * noise, jax.vmap(lambda s: model.see(s, obs[1, 3]))(obs[1, 3:8])
    other = model.with_decoder(jax.tree.map(lambda x: 0.5 * x, model.params["decoder"]))
    decoded, halved = (m.decode(option, seen)[0] for m in (model, other))
    loss = window_losses(model, CONFIG, window, noise)["reconstruction_loss"]
    np.testing.assert_allclose(loss, reconstruction_loss(decoded, window.actions, window.mask), rtol=1e-5)
    change = action_change(model, other, window, option)
    np.testing.assert_allclose(change, reconstruction_loss(halved, decoded, window.mask), rtol=1e-5)


def test_scales_are_of_what_is_seen_and_the_way_counts_by_its_weight(walks, model):
    env, _, _, obs, _ = walks
    frame = make_frame(CONFIG, env.heading)
    windows = jnp.stack([obs[:, t : t + 6] for t in range(TICKS - 5)], axis=1).reshape(-1, 6, 27)
    seen = frame.seen(windows, windows[:, :1])
    np.testing.assert_allclose(model.state_scale.mean, seen.mean(axis=(0, 1)), atol=2e-2)
    changes = jax.vmap(frame.changes)(windows)[:, -1]
    np.testing.assert_allclose(model.change_scale.std[-2:], changes.std(axis=0)[-2:] / 2, rtol=0.05)
    np.testing.assert_allclose(model.change_scale.std[13:27], changes.std(axis=0)[13:27], rtol=0.05)
    far = windows[0, :1].at[0, 13].set(1e3)
    assert model.see(far, far).max() == 5.0, "what is seen is clipped"


def test_term_predict_measures_the_error_of_algorithm_1_while_it_acts(walks, model):
    _, _, actions, obs, _ = walks
    states, taken = obs[1, 3:9], actions[3:8]
    errors = prefix_errors(model, model.encode(taken)[0], states)
    executor = make_executor(as_arrays(dataclasses.replace(CONFIG, termination="predict")), model)
    rule, memory = executor.termination, executor.termination.start(model, states[0])
    for i, error in enumerate(errors):
        memory = rule.follow(model, memory, states[i], taken[i], jnp.zeros(()))
        for delta, ends in ((error * 0.999, True), (error * 1.001, False)):
            assert bool(rule.ended(model.replace(delta=delta), memory, states[i + 1], jnp.zeros(0))) == ends


def test_a_body_without_heading_is_refused():
    with pytest.raises(ValueError, match="need a body with a heading, as ant; got none"):
        make_frame(CONFIG, None)
    assert make_frame(OptionsConfig(), None) is None
