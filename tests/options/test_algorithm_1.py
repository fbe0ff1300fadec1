"""Algorithm 1: the loss of a window under termination predict is what a plain loop over its prefixes gives."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import assert_trees_equal, draw, random_model

from taic_jax.config import OptionsConfig
from taic_jax.options.dataset import Window
from taic_jax.options.learning import total_loss
from taic_jax.options.model import OptionModel, Scale
from taic_jax.types import as_arrays

LENGTH, STATE_SIZE, ACTION_SIZE, NUM_WINDOWS = 4, 3, 2, 4
CONFIG = OptionsConfig(
    length=LENGTH, size=2, hidden_size=4, mlp_sizes=(4,), decoder_sizes=(4,), termination="predict",
    lambda_kl=0.5, lambda_pred=2.0, lambda_adv=0.3,
)  # fmt: skip

program = jax.jit(jax.value_and_grad(total_loss, has_aux=True))


@partial(jax.jit, static_argnums=0)
def call(network: Any, params: dict, *args: jax.Array) -> Any:
    """Apply a network; compiled once per shape, where Flax's loops would compile at every call."""
    return network.apply(params, *args)


def make_windows() -> tuple[Window, jax.Array]:
    """Return random windows and the noise of their options."""
    rng = np.random.default_rng(1)
    states, actions = draw(rng, NUM_WINDOWS, LENGTH + 1, STATE_SIZE), draw(rng, NUM_WINDOWS, LENGTH, ACTION_SIZE)
    return Window(states, actions, jnp.ones((NUM_WINDOWS, LENGTH), bool)), draw(rng, NUM_WINDOWS, CONFIG.size)


def normalized(scale: Scale, x: jax.Array) -> jax.Array:
    return (x - scale.mean) / scale.std


def algorithm_1(params: dict, model: OptionModel, config: OptionsConfig, window: Window, noise):
    """Run Algorithm 1 on one window as the paper prints it, with the adversary; return its sum and its losses."""
    s, a, k = window.states, window.actions, LENGTH
    i, prediction, predictions = 0, 0.0, []
    while prediction < model.delta and i < k:
        means, log_stds = call(model.networks.encoder, params["encoder"], a[: i + 1])
        mean, log_std = means[-1], log_stds[-1]
        option = mean + jnp.exp(log_std) * noise
        predicted = call(model.networks.predictor, params["predictor"], normalized(model.state_scale, s[0]), option)
        prediction = jnp.mean((predicted - normalized(model.change_scale, s[i + 1] - s[0])) ** 2)
        predictions.append(prediction)
        i += 1
    states = [normalized(model.state_scale, state) for state in s]
    decoded, _ = call(model.networks.decoder, params["decoder"], option, jnp.stack(states[:i]))
    reconstruction = jnp.mean((decoded - a[:i]) ** 2)
    kl = jnp.sum((mean**2 + jnp.exp(log_std) ** 2 - 1.0) / 2.0 - log_std)
    # Its value is the option's, its gradient -lambda_adv times the option's.
    hidden = jax.lax.stop_gradient((1.0 + config.lambda_adv) * option) - config.lambda_adv * option
    estimated = call(model.networks.estimator, params["estimator"], hidden)
    adversarial = jnp.mean((estimated - jnp.stack([states[0], states[i]])) ** 2)
    total = reconstruction + config.lambda_kl * kl + config.lambda_pred * sum(predictions) + adversarial
    terms = {
        "reconstruction_loss": reconstruction,
        "kl_loss": kl,
        "prediction_loss": sum(predictions),
        "adversarial_loss": adversarial,
        "duration": jnp.float32(i),
    }
    return total, terms


def transcribed(params: dict, model: OptionModel, config: OptionsConfig, windows: Window, noise):
    """Return the mean of Algorithm 1 over the windows, and the terms of each."""
    results = [
        algorithm_1(params, model, config, jax.tree.map(lambda x, n=n: x[n], windows), noise[n])
        for n in range(NUM_WINDOWS)
    ]
    return sum(total for total, _ in results) / NUM_WINDOWS, [terms for _, terms in results]


@pytest.mark.parametrize("decoder", ["open", "closed"])
@pytest.mark.parametrize(
    ("delta", "durations"), [(1e-6, [1, 1, 1, 1]), (None, [1, 2, 3, 4]), (jnp.inf, [4, 4, 4, 4])],
    ids=["at the first action", "in the middle", "never"],
)  # fmt: skip
def test_the_loss_is_algorithm_1(decoder, delta, durations):
    config = as_arrays(dataclasses.replace(CONFIG, decoder=decoder))
    model = random_model(config, STATE_SIZE, ACTION_SIZE)
    windows, noise = make_windows()
    if delta is None:
        delta, windows = 3.0, stretched(model, windows, noise, jnp.array(durations), 3.0)
    model = model.replace(delta=jnp.float32(delta))
    (total, terms), gradient = program(model.params, model, config, windows, noise)
    plain = jax.value_and_grad(transcribed, has_aux=True)
    (expected, each), expected_gradient = plain(model.params, model, config, windows, noise)
    assert [int(terms["duration"]) for terms in each] == durations
    np.testing.assert_allclose(total, expected, rtol=1e-5)
    assert set(terms) == set(each[0])
    for name, value in terms.items():
        np.testing.assert_allclose(value, np.mean([terms[name] for terms in each]), rtol=1e-5, err_msg=name)
    for name in ("encoder", "decoder", "predictor", "estimator"):
        assert max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(gradient[name])) > 1e-2
        assert_trees_equal(gradient[name], expected_gradient[name], rtol=1e-4, atol=1e-4)


def stretched(model: OptionModel, windows: Window, noise, durations, delta: float) -> Window:
    """Return the windows with states at which P errs by half of delta, and by twice delta from `durations` on."""

    def one(window: Window, noise: jax.Array, duration: jax.Array) -> Window:
        means, log_stds = model.encode(window.actions)
        first = normalized(model.state_scale, window.states[0])
        options = means + jnp.exp(log_stds) * noise[None]
        predicted = jax.vmap(partial(model.predict, first))(options)
        off = jnp.sqrt(delta * jnp.where(jnp.arange(1, LENGTH + 1) < duration, 0.5, 2.0))
        change = (predicted + off[:, None]) * model.change_scale.std[None] + model.change_scale.mean[None]
        return window.replace(states=jnp.concatenate([window.states[:1], window.states[:1] + change]))

    return jax.vmap(one)(windows, noise, durations)
