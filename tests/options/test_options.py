"""The option model: its networks step by step, its executor, and what it learns where the answer is known."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import assert_trees_equal, draw, random_model

from taic_jax.config import OptionsConfig
from taic_jax.options.dataset import Experience
from taic_jax.options.execution import OptionExecutor, make_executor
from taic_jax.options.learning import learn
from taic_jax.options.model import OptionModel, Scale, make_networks

T, B, STATE_SIZE, ACTION_SIZE = 16, 32, 3, 2
CONFIG = OptionsConfig(
    length=3, size=2, hidden_size=16, mlp_sizes=(16,), steps=150, batch_size=64, learning_rate=0.03,
    lambda_kl=1e-3, lambda_adv=0.0, select="random",
)  # fmt: skip
CLOSED = dataclasses.replace(CONFIG, decoder="closed", decoder_sizes=(32,))
NETWORKS = make_networks(CONFIG, STATE_SIZE, ACTION_SIZE)


@pytest.fixture(scope="module")
def model() -> OptionModel:
    """Return a model of random parameters, whose scales change nothing."""
    return with_unit_scales(random_model(CONFIG, STATE_SIZE, ACTION_SIZE))


def with_unit_scales(model: OptionModel) -> OptionModel:
    scale = Scale(jnp.zeros(STATE_SIZE), jnp.ones(STATE_SIZE))
    return model.replace(state_scale=scale, change_scale=scale)


@pytest.mark.parametrize("config", [CONFIG, CLOSED], ids=["open", "closed"])
def test_decoder_steps_are_the_unrolled_call(config):
    model = random_model(config, STATE_SIZE, ACTION_SIZE)
    decoder, params, option = model.networks.decoder, model.params["decoder"], jnp.array([0.5, -1.0])
    states = draw(np.random.default_rng(3), 5, STATE_SIZE)
    unrolled = jax.jit(decoder.apply)
    actions, logits = unrolled(params, option, states)
    step = jax.jit(lambda carry, state: decoder.apply(params, carry, option, state, method="step"))
    carry = decoder.apply(params, option, method="start")
    for i in range(5):
        carry, (action, logit) = step(carry, states[i])
        np.testing.assert_allclose(action, actions[i], rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(logit, logits[i], rtol=1e-5, atol=1e-5)
    assert np.abs(np.diff(actions, axis=0)).min() > 1e-3  # one action is not another
    other, other_logits = unrolled(params, option, states.at[2].add(1.0))
    differs = [not np.array_equal(actions[i], other[i]) for i in range(5)]
    assert differs == [not np.array_equal(logits[i], other_logits[i]) for i in range(5)]
    # A closed loop answers to the state of the tick, and to no other.
    assert differs == [i == 2 and config is CLOSED for i in range(5)]


def test_a_closed_loop_can_tell_time():
    """In one and the same state its action and its end signal still change from tick to tick."""
    model = random_model(CLOSED, STATE_SIZE, ACTION_SIZE)
    outputs = model.decode(jnp.array([0.5, -1.0]), jnp.ones((3, STATE_SIZE)))
    for output in outputs:
        assert np.abs(np.diff(output, axis=0)).min() > 1e-3


def test_a_squashed_d_bounds_its_actions_and_not_its_end_signal():
    plain, squashed = (
        random_model(dataclasses.replace(CLOSED, squash=squash), STATE_SIZE, ACTION_SIZE) for squash in (False, True)
    )
    option, states = jnp.array([2.0, -4.0]), draw(np.random.default_rng(5), 3, STATE_SIZE)
    (actions, ends), (bounded, same) = plain.decode(option, states), squashed.decode(option, states)
    np.testing.assert_allclose(bounded, np.tanh(actions), rtol=1e-5)
    np.testing.assert_array_equal(ends, same)
    assert np.abs(actions).max() > 1.0


def test_the_executor_shows_a_closed_loop_the_normalised_state():
    model = random_model(CLOSED, STATE_SIZE, ACTION_SIZE)
    executor, option = make_executor(CLOSED, model), jnp.array([0.5, -1.0])
    obs = draw(np.random.default_rng(4), CLOSED.length, 7)
    states = (obs[:, :STATE_SIZE] - model.state_scale.mean[None]) / model.state_scale.std[None]
    decoded, _ = model.decode(option, states)
    act, carry = jax.jit(executor.act), executor.start(option, obs[0])
    for i in range(CLOSED.length):
        carry, action = act(carry, obs[i], jnp.zeros(0))
        np.testing.assert_allclose(action, np.clip(decoded[i], -1.0, 1.0), rtol=1e-5, atol=1e-5)
    assert np.abs(decoded).min() < 1.0  # so that not all was clipped


def test_encoder_gives_every_prefix_at_once(model):
    actions = jnp.asarray(np.random.default_rng(1).normal(size=(4, ACTION_SIZE)), jnp.float32)
    encode = jax.jit(model.encode)
    means, log_stds = encode(actions)
    assert means.shape == log_stds.shape == (4, CONFIG.size)
    for i in range(4):
        mean, log_std = encode(actions[: i + 1])
        np.testing.assert_allclose(mean[-1], means[i], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(log_std[-1], log_stds[i], rtol=1e-5, atol=1e-6)


def test_executor_emits_the_decoders_actions_and_never_ends_early(model):
    executor, option = make_executor(CONFIG, model), jnp.array([3.0, -2.0])
    assert isinstance(executor, OptionExecutor) and executor.option_size == CONFIG.size
    decoded, _ = model.decode(option, jnp.zeros((CONFIG.length, STATE_SIZE)))
    act, carry = jax.jit(executor.act), executor.start(option, jnp.zeros(7))
    for i in range(CONFIG.length):
        # An observation may have more entries than the slice the model knows.
        carry, action = act(carry, jnp.full(7, float(i)), jnp.zeros(0))
        np.testing.assert_allclose(action, np.clip(decoded[i], -1.0, 1.0), rtol=1e-5, atol=1e-6)
        assert not executor.ended(carry, jnp.zeros(7), jnp.zeros(0))
    assert (executor.length, executor.noise_size) == (CONFIG.length, 0)
    assert np.abs(decoded).max() > 1.0  # so that the clipping was seen


@pytest.fixture(scope="module")
def experience() -> Experience:
    """Action t of environment b is its 2-d latent turned by 40 t degrees, and every action moves the state."""
    rng = np.random.default_rng(2)
    latent, moves = rng.normal(size=(B, 2)), rng.normal(size=(ACTION_SIZE, STATE_SIZE))
    angle = np.deg2rad(40.0) * np.arange(T)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    action = 0.3 * np.einsum("ijt,bj->tbi", turn, latent)
    obs = rng.normal(size=(B, STATE_SIZE)) + np.cumsum(action @ moves, axis=0) - action @ moves
    arrays = (jnp.asarray(x, jnp.float32) for x in (obs, action, rng.normal(size=(T, B))))
    return Experience(*arrays, done=jnp.zeros((T, B), bool))


learn_alone = jax.jit(lambda experience, key: learn(CONFIG, experience, key))
learn_together = jax.jit(jax.vmap(lambda experience, key: learn(CONFIG, experience, key), (None, 0)))


def test_learns_a_latent_that_explains_actions_and_state_changes(experience):
    trained, losses = jax.device_get(learn_alone(experience, jax.random.key(0)))
    last = {name: np.mean(values[-20:]) for name, values in losses.items()}
    # A code that says nothing leaves the variance of the actions, and that of normalised changes, which is 1.
    assert last["reconstruction_loss"] < 0.05 * np.var(experience.action)
    assert last["prediction_loss"] < 0.05
    assert losses["reconstruction_loss"][0] > 0.5 * np.var(experience.action) and losses["prediction_loss"][0] > 0.5
    np.testing.assert_allclose(trained.state_scale.mean, np.mean(experience.obs, (0, 1)), atol=0.2)


def test_the_same_key_gives_the_same_model(experience):
    assert_trees_equal(*(learn_alone(experience, jax.random.key(0)) for _ in range(2)))


def test_vmapped_seeds_are_the_seeds_alone(experience):
    keys = jax.random.split(jax.random.key(0), 2)
    _, together = jax.device_get(learn_together(experience, keys))
    alone = [jax.device_get(learn_alone(experience, key))[1] for key in keys]
    for k in range(2):
        for name in together:
            # Rounding grows from step to step, so only the first are compared.
            np.testing.assert_allclose(together[name][k, :20], alone[k][name][:20], rtol=1e-3, err_msg=name)
    assert (alone[0]["kl_loss"] != alone[1]["kl_loss"]).all()


@pytest.mark.parametrize("config", [CONFIG, CLOSED], ids=["open", "closed"])
def test_only_a_closed_loop_learns_actions_that_depend_on_the_state(config):
    """Actions are the mean of a window's one latent and of the state at hand, which a code of one entry cannot hold."""
    rng = np.random.default_rng(5)
    obs, latent = draw(rng, T, B, STATE_SIZE), draw(rng, 1, B, 1)
    action = 0.5 * np.asarray(latent) + 0.5 * np.asarray(obs[..., :ACTION_SIZE])
    experience = Experience(obs, jnp.asarray(action), draw(rng, T, B), jnp.zeros((T, B), bool))
    config = dataclasses.replace(config, size=1, lambda_pred=0.0)
    _, losses = jax.device_get(jax.jit(partial(learn, config))(experience, jax.random.key(0)))
    share = np.mean(losses["reconstruction_loss"][-20:]) / np.var(action)
    # Half of the variance is the latent's. E cannot tell it from the states' mean, which leaves a seventh of that.
    assert share < 0.1 if config.decoder == "closed" else share > 0.25
