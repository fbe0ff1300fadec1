"""Losses of option learning: by hand, against Monte Carlo, and the direction of every gradient."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import draw, random_model

from taic_jax.config import OptionsConfig
from taic_jax.options import losses
from taic_jax.options.dataset import Window
from taic_jax.options.learning import total_loss
from taic_jax.options.model import OptionModel
from taic_jax.types import as_arrays

CONFIG = OptionsConfig(length=3, size=2, hidden_size=3, mlp_sizes=(4,), lambda_kl=0.5, lambda_pred=2.0)
STATE_SIZE, ACTION_SIZE, NUM_WINDOWS = 3, 2, 4


def test_reconstruction_loss_by_hand():
    # Ticks: (1 + 9) / 2 = 5 and (0 + 4) / 2 = 2, the third is masked; mean (5 + 2) / 2.
    decoded = jnp.array([[1.0, 3.0], [5.0, 2.0], [100.0, 100.0]])
    actions = jnp.array([[0.0, 0.0], [5.0, 4.0], [-7.0, 8.0]])
    assert losses.reconstruction_loss(decoded, actions, jnp.array([True, True, False])) == 3.5


def test_kl_loss_by_hand():
    # Per entry (mean^2 + std^2 - 1) / 2 - ln std: (4 + 1 - 1) / 2 - 0 = 2, and (0 + e^2 - 1) / 2 - 1 = 2.1945.
    loss = losses.kl_loss(jnp.array([2.0, 0.0]), jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(loss, 2.0 + (np.e**2 - 1) / 2 - 1, rtol=1e-5)
    assert losses.kl_loss(jnp.zeros(2), jnp.zeros(2)) == 0.0


def test_kl_loss_is_monte_carlos():
    mean, log_std = np.array([0.7, -1.2]), np.array([-0.5, 0.3])
    noise = np.random.default_rng(0).normal(size=(400_000, 2))
    option = mean + np.exp(log_std) * noise
    log_ratio = np.sum(-(noise**2) / 2 - log_std + option**2 / 2, axis=1)
    got = losses.kl_loss(jnp.asarray(mean, jnp.float32), jnp.asarray(log_std, jnp.float32))
    np.testing.assert_allclose(got, log_ratio.mean(), atol=4 * log_ratio.std() / np.sqrt(len(noise)))


def test_prediction_loss_by_hand():
    # (1 + 4 + 1) / 3.
    assert losses.prediction_loss(jnp.array([1.0, 2.0, 0.0]), jnp.array([0.0, 0.0, 1.0])) == 2.0


def test_adversarial_loss_by_hand():
    # Start: 1 + 1, end: 4 + 0; over four entries.
    estimated = jnp.array([[1.0, 1.0], [2.0, 5.0]])
    assert losses.adversarial_loss(estimated, jnp.zeros(2), jnp.array([0.0, 5.0])) == 1.5


def test_gradient_reversal_flips_and_scales():
    x, scale = jnp.array([1.0, -2.0]), jnp.float32(0.25)
    np.testing.assert_array_equal(losses.gradient_reversal(x, scale), x)
    # Of sum x^2: 2x, times -1/4.
    gradient = jax.grad(lambda x: jnp.sum(losses.gradient_reversal(x, scale) ** 2))(x)
    np.testing.assert_array_equal(gradient, [-0.5, 1.0])


@pytest.fixture(scope="module")
def problem() -> tuple[dict, OptionModel, Window, jax.Array]:
    """Random parameters, scales and windows whose last action is masked, and the noise of their options."""
    rng, model = np.random.default_rng(1), random_model(CONFIG, STATE_SIZE, ACTION_SIZE)
    mask = jnp.tile(jnp.array([True, True, False]), (NUM_WINDOWS, 1))
    windows = Window(draw(rng, NUM_WINDOWS, 4, STATE_SIZE), draw(rng, NUM_WINDOWS, 3, ACTION_SIZE), mask)
    return model.params, model, windows, draw(rng, NUM_WINDOWS, CONFIG.size)


@jax.jit
def gradients_of(config: OptionsConfig, params: dict, model: OptionModel, windows: Window, noise: jax.Array):
    """Return the gradient of the loss that is descended, the losses, and the gradient of the true L_adv."""
    descended, terms = jax.grad(total_loss, has_aux=True)(params, model, config, windows, noise)
    return descended, terms, jax.grad(adversarial_alone)(params, model, windows, noise)


def adversarial_alone(params: dict, model: OptionModel, windows: Window, noise: jax.Array) -> jax.Array:
    """L_adv written out, with no reversal in it."""

    def one(window: Window, noise: jax.Array) -> jax.Array:
        means, log_stds = model.replace(params=params).encode(window.actions)
        option = means[1] + jnp.exp(log_stds[1]) * noise  # the last action of the mask is the second
        estimated = model.replace(params=params).estimate(option)
        true = model.state_scale(window.states[jnp.array([0, 2])])  # the last action leads to the third state
        return jnp.mean((estimated - true) ** 2)

    return jnp.mean(jax.vmap(one)(windows, noise))


def with_lambda_adv(value: float) -> OptionsConfig:
    return as_arrays(dataclasses.replace(CONFIG, lambda_adv=value))


def flat(tree: dict) -> np.ndarray:
    return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)])


def test_only_the_encoder_climbs_the_adversarial_loss(problem):
    """E's gradient with lambda_adv is that without, minus lambda_adv times the gradient of L_adv; no other's is."""
    without, terms, _ = gradients_of(with_lambda_adv(0.0), *problem)
    reversed_, terms_reversed, plain = gradients_of(with_lambda_adv(0.3), *problem)
    assert terms == terms_reversed
    change = flat(reversed_["encoder"]) - flat(without["encoder"])
    np.testing.assert_allclose(change, -0.3 * flat(plain["encoder"]), rtol=1e-3, atol=1e-6)
    assert np.abs(change).max() > 1e-3
    for name in ("decoder", "predictor", "estimator"):
        np.testing.assert_array_equal(flat(reversed_[name]), flat(without[name]))
    np.testing.assert_allclose(flat(reversed_["estimator"]), flat(plain["estimator"]), rtol=1e-4, atol=1e-7)


def test_total_is_the_weighted_sum(problem):
    params, model, windows, noise = problem
    total, terms = jax.jit(total_loss)(params, model, with_lambda_adv(0.3), windows, noise)
    # What is minimised over F and, behind the reversal, E: the forward value of L_adv enters with weight one.
    expected = terms["reconstruction_loss"] + 0.5 * terms["kl_loss"] + 2.0 * terms["prediction_loss"]
    np.testing.assert_allclose(total, expected + terms["adversarial_loss"], rtol=1e-6)


def test_masked_actions_change_nothing(problem):
    params, model, windows, noise = problem
    other = windows.replace(actions=windows.actions.at[:, 2].set(99.0))
    gradients = gradients_of(with_lambda_adv(0.3), *problem)
    changed = gradients_of(with_lambda_adv(0.3), params, model, other, noise)
    for x, y in zip(jax.tree.leaves(gradients), jax.tree.leaves(changed), strict=True):
        np.testing.assert_array_equal(x, y)
    shown = windows.replace(mask=jnp.ones_like(windows.mask))
    assert gradients_of(with_lambda_adv(0.3), params, model, shown, noise)[1] != gradients[1]
