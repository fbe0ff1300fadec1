"""The option model: its networks step by step, its executor, and what it learns where the answer is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import assert_trees_equal

from taic_jax.config import OptionsConfig
from taic_jax.options.dataset import Experience
from taic_jax.options.execution import OptionExecutor, make_executor
from taic_jax.options.learning import learn
from taic_jax.options.model import OptionModel, Scale, init_params, make_networks

T, B, STATE_SIZE, ACTION_SIZE = 16, 32, 3, 2
CONFIG = OptionsConfig(
    length=3, size=2, hidden_size=16, mlp_sizes=(16,), steps=150, batch_size=64, learning_rate=0.03,
    lambda_kl=1e-3, lambda_adv=0.0, select="random",
)  # fmt: skip
NETWORKS = make_networks(CONFIG, STATE_SIZE, ACTION_SIZE)


@pytest.fixture(scope="module")
def model() -> OptionModel:
    """Return a model of random parameters."""
    rng = np.random.default_rng(0)
    shapes = jax.eval_shape(lambda: init_params(NETWORKS, CONFIG, jax.random.key(0)))
    params = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape), jnp.float32), shapes)
    scale = Scale(jnp.zeros(STATE_SIZE), jnp.ones(STATE_SIZE))
    return OptionModel(params, scale, scale, jnp.ones(()))


def test_decoder_steps_are_the_unrolled_call(model):
    decoder, params, option = NETWORKS.decoder, model.params["decoder"], jnp.array([0.5, -1.0])
    states = jnp.asarray(np.random.default_rng(3).normal(size=(5, STATE_SIZE)), jnp.float32)
    actions, logits = jax.jit(decoder.apply)(params, option, states)
    step = jax.jit(lambda carry, state: decoder.apply(params, carry, option, state, method="step"))
    carry = decoder.apply(params, option, method="start")
    for i in range(5):
        carry, (action, logit) = step(carry, states[i])
        np.testing.assert_allclose(action, actions[i], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(logit, logits[i], rtol=1e-5, atol=1e-6)
    assert np.abs(np.diff(actions, axis=0)).min() > 1e-3  # one action is not another


def test_encoder_gives_every_prefix_at_once(model):
    actions = jnp.asarray(np.random.default_rng(1).normal(size=(4, ACTION_SIZE)), jnp.float32)
    encode = jax.jit(lambda actions: NETWORKS.encoder.apply(model.params["encoder"], actions))
    means, log_stds = encode(actions)
    assert means.shape == log_stds.shape == (4, CONFIG.size)
    for i in range(4):
        mean, log_std = encode(actions[: i + 1])
        np.testing.assert_allclose(mean[-1], means[i], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(log_std[-1], log_stds[i], rtol=1e-5, atol=1e-6)


def test_executor_emits_the_decoders_actions_and_never_ends_early(model):
    executor, option = make_executor(CONFIG, ACTION_SIZE, model), jnp.array([3.0, -2.0])
    assert isinstance(executor, OptionExecutor) and executor.option_size == CONFIG.size
    decoded, _ = NETWORKS.decoder.apply(model.params["decoder"], option, jnp.zeros((CONFIG.length, STATE_SIZE)))
    act, carry = jax.jit(executor.act), executor.start(option, jnp.zeros(7))
    for i in range(CONFIG.length):
        # An observation may have more entries than the slice the model knows.
        carry, action = act(carry, jnp.full(7, float(i)))
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
