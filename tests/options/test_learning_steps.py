"""A step of learning: which weight and which step size belongs to what, and the state that an option ends in."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import draw, random_model

from taic_jax.config import OptionsConfig
from taic_jax.options.dataset import Experience, Window
from taic_jax.options.learning import learn, total_loss
from taic_jax.types import as_arrays

LENGTH, STATE_SIZE, ACTION_SIZE = 4, 3, 2
CONFIG = OptionsConfig(
    length=LENGTH, size=2, hidden_size=4, mlp_sizes=(4,), batch_size=8, select="random", lambda_kl=0.5,
    lambda_pred=2.0, lambda_adv=0.3, lambda_end=0.7, learning_rate=0.02, learning_rate_estimator=0.005,
)  # fmt: skip
OUTPUT = dataclasses.replace(CONFIG, termination="output")


@pytest.mark.parametrize("config", [CONFIG, OUTPUT], ids=["fixed", "output"])
def test_every_loss_enters_with_its_own_weight_and_predicts_where_the_option_ends(config):
    """Windows of 1, 2 and 4 of the four ticks: P is to tell the change from the first state to the one after them."""
    model = random_model(config, STATE_SIZE, ACTION_SIZE)
    rng, ticks = np.random.default_rng(1), np.array([1, 2, 4])
    mask = jnp.asarray(np.arange(LENGTH)[None] < ticks[:, None])
    windows = Window(draw(rng, 3, LENGTH + 1, STATE_SIZE), draw(rng, 3, LENGTH, ACTION_SIZE), mask)
    noise = draw(rng, 3, config.size)
    total, terms = jax.jit(total_loss)(model.params, model, as_arrays(config), windows, noise)
    errors = []
    for n, last in enumerate(ticks):
        means, log_stds = model.encode(windows.actions[n, :last])
        option = means[-1] + jnp.exp(log_stds[-1]) * noise[n]
        start, change = windows.states[n, 0], windows.states[n, last] - windows.states[n, 0]
        scaled = (change - model.change_scale.mean) / model.change_scale.std
        start = (start - model.state_scale.mean) / model.state_scale.std
        errors.append(jnp.mean((model.predict(start, option) - scaled) ** 2))
    np.testing.assert_allclose(terms["prediction_loss"], np.mean(errors), rtol=1e-4)
    np.testing.assert_allclose(terms["duration"], ticks.mean(), rtol=1e-6)
    weights = {"reconstruction_loss": 1.0, "kl_loss": 0.5, "prediction_loss": 2.0, "adversarial_loss": 1.0}
    weights |= {"end_loss": 0.7} if config is OUTPUT else {}
    assert set(terms) == {*weights, "duration"}
    assert min(terms[name] for name in weights) > 0.05
    np.testing.assert_allclose(total, sum(weight * terms[name] for name, weight in weights.items()), rtol=1e-5)


@jax.jit
def moved(config: OptionsConfig) -> dict[str, jax.Array]:
    """Return how far the first step moves the entry of each network that it moves most."""
    rng, shape = np.random.default_rng(0), (16, 4)
    experience = Experience(
        draw(rng, *shape, STATE_SIZE), draw(rng, *shape, ACTION_SIZE), draw(rng, *shape), jnp.zeros(shape, bool)
    )
    before, after = (
        learn(dataclasses.replace(config, steps=n), experience, jax.random.key(0))[0].params for n in (0, 1)
    )
    changes = jax.tree.map(lambda a, b: jnp.abs(a - b).max(), before, after)
    return {name: jnp.max(jnp.stack(jax.tree.leaves(tree))) for name, tree in changes.items()}


def test_adams_first_step_has_fs_size_for_f_and_the_models_for_the_rest():
    """Adam divides the first gradient by its own size, so that entries move by the step size itself.

    Clipped to a norm far below Adam's epsilon of 1e-8, gradients move nothing nearly as far.
    """
    sizes = {"encoder": 0.02, "decoder": 0.02, "predictor": 0.02, "estimator": 0.005}
    assert moved(as_arrays(CONFIG)) == pytest.approx(sizes, rel=1e-2)
    clipped = moved(as_arrays(dataclasses.replace(CONFIG, max_grad_norm=1e-10)))
    assert all(clipped[name] < 0.1 * size for name, size in sizes.items())
