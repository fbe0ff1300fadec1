"""Learning options from windows: E, D, P and F jointly (§3.2, §3.3)."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Key

from taic_jax.config import OptionsConfig
from taic_jax.networks import apply
from taic_jax.options.dataset import Dataset, Experience, Window, gather, make_dataset
from taic_jax.options.losses import (
    adversarial_loss,
    gradient_reversal,
    kl_loss,
    prediction_loss,
    reconstruction_loss,
)
from taic_jax.options.model import Networks, OptionModel, init_params, make_networks
from taic_jax.types import Scalar, as_arrays


class LearnState(struct.PyTreeNode):
    """Everything a learning run is: saved and restored whole."""

    params: dict
    optimizer: optax.OptState
    key: Array
    step: Array


def make_optimizer(config: OptionsConfig) -> optax.GradientTransformation:
    """Return Adam with one learning rate for E, D and P and another for F."""

    def adam(learning_rate: Scalar) -> optax.GradientTransformation:
        clip = optax.clip_by_global_norm(config.max_grad_norm)
        return optax.flatten(optax.chain(clip, optax.scale_by_adam(), optax.scale(-learning_rate)))

    labels: Any = {"encoder": "model", "decoder": "model", "predictor": "model", "estimator": "estimator"}
    transforms: Any = {"model": adam(config.learning_rate), "estimator": adam(config.learning_rate_estimator)}
    return optax.multi_transform(transforms, labels)


def init(config: OptionsConfig, networks: Networks, key: Key[Array, ""]) -> LearnState:
    """Return the state before the first step."""
    key, key_params = jax.random.split(key)
    params = init_params(networks, config, key_params)
    return LearnState(params, make_optimizer(config).init(params), key, jnp.zeros((), jnp.int32))


def window_losses(
    params: dict, networks: Networks, model: OptionModel, config: OptionsConfig, window: Window, noise: Array
) -> dict[str, Array]:
    """Return the losses of one window, `noise` [D] drawing o from q(o|a).

    The sum E descends is L_recons + lambda_kl L_KL + lambda_pred L_pred - lambda_adv L_adv, and F descends
    L_adv: the reversal in front of F changes the sign on its way into E and nowhere else.
    """
    means, log_stds = apply(networks.encoder, params["encoder"], window.actions)
    last = jnp.sum(window.mask, dtype=jnp.int32) - 1
    mean, log_std = means[last], log_stds[last]
    option = mean + jnp.exp(log_std) * noise
    decoded, _ = apply(networks.decoder, params["decoder"], option, window.actions.shape[0])
    start, end = model.state_scale(window.start), model.state_scale(window.end)
    change = model.change_scale(window.end - window.start)
    predicted = apply(networks.predictor, params["predictor"], start, option)
    estimated = apply(networks.estimator, params["estimator"], gradient_reversal(option, config.lambda_adv))
    return {
        "reconstruction_loss": reconstruction_loss(decoded, window.actions, window.mask),
        "kl_loss": kl_loss(mean, log_std),
        "prediction_loss": prediction_loss(predicted, change),
        "adversarial_loss": adversarial_loss(estimated, start, end),
    }


def total_loss(
    params: dict, networks: Networks, model: OptionModel, config: OptionsConfig, windows: Window, noise: Array
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Return the weighted sum over N windows and the mean of each loss."""
    one = partial(window_losses, params, networks, model, config)
    losses = jax.tree.map(jnp.mean, jax.vmap(one)(windows, noise))
    total = (
        losses["reconstruction_loss"]
        + config.lambda_kl * losses["kl_loss"]
        + config.lambda_pred * losses["prediction_loss"]
        + losses["adversarial_loss"]
    )
    return total, losses


def step(
    config: OptionsConfig, networks: Networks, dataset: Dataset, num_envs: int, state: LearnState
) -> tuple[LearnState, dict[str, Array]]:
    """Take one gradient step on a batch of windows drawn at random from the selection."""
    key, key_windows, key_option = jax.random.split(state.key, 3)
    which = jax.random.randint(key_windows, (config.batch_size,), 0, dataset.count)
    windows = gather(dataset, which, config.length, num_envs)
    noise = jax.random.normal(key_option, (config.batch_size, config.size))
    model = as_model(state, dataset)
    gradient, losses = jax.grad(total_loss, has_aux=True)(state.params, networks, model, config, windows, noise)
    with jax.numpy_dtype_promotion("standard"):  # Optax raises a float to an integer power
        updates, optimizer = make_optimizer(config).update(gradient, state.optimizer)
    params: Any = optax.apply_updates(state.params, updates)
    return LearnState(params, optimizer, key, state.step + 1), losses


def steps(
    config: OptionsConfig, networks: Networks, num_envs: int, count: int, state: LearnState, dataset: Dataset
) -> tuple[LearnState, dict[str, Array], None]:
    """Take `count` gradient steps and return the mean losses."""
    one = partial(step, config, networks, dataset, num_envs)
    state, losses = jax.lax.scan(lambda s, _: one(s), state, None, count)
    return state, jax.tree.map(jnp.mean, losses), None


def as_model(state: LearnState, dataset: Dataset) -> OptionModel:
    """Return the option model learnt so far."""
    return OptionModel(state.params, dataset.state_scale, dataset.change_scale)


def learn(config: OptionsConfig, experience: Experience, key: Key[Array, ""]) -> tuple[OptionModel, dict[str, Array]]:
    """Learn an option model from experience [T, B, ...]; pure, so experiences and keys may be vmapped.

    Returns the model and the losses of every step, leading axis the step.
    """
    config = as_arrays(config)
    num_envs, state_size = experience.obs.shape[1:]
    networks = make_networks(config, state_size, experience.action.shape[-1])
    dataset = make_dataset(experience, config)
    one = partial(step, config, networks, dataset, num_envs)
    state, losses = jax.lax.scan(lambda s, _: one(s), init(config, networks, key), None, config.steps)
    return as_model(state, dataset), losses
