"""Option learning from windows: E, D, P and F jointly (§3.2-3.4, Algorithm 1)."""

import dataclasses
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Float, Int, Key

from taic_jax.config import OptionsConfig
from taic_jax.envs.base import Heading
from taic_jax.envs.views import Views
from taic_jax.nonfinite import earliest, first_nonfinite
from taic_jax.options.code_book import centres
from taic_jax.options.dataset import Dataset, Experience, Window, gather, make_dataset
from taic_jax.options.frame import make_frame
from taic_jax.options.losses import (
    adversarial_loss,
    end_loss,
    gradient_reversal,
    kl_loss,
    prediction_loss,
    reconstruction_loss,
)
from taic_jax.options.model import Networks, OptionModel, init_params, make_networks
from taic_jax.options.termination import prefix_errors, stop_index
from taic_jax.types import Scalar, as_arrays

DELTA_MEMORY = 100.0
"""Steps over which a quantile threshold is averaged."""
BOOK_WINDOWS = 4096
"""Windows whose codes give the code book."""
LossFn = Callable[..., tuple[Array, dict[str, Array]]]
"""(parameters, model, config, windows, ...) -> the sum to descend, and its terms."""


class LearnState(struct.PyTreeNode):
    """The whole state of learning, saved and restored as one tree; `delta` [] is the threshold in force."""

    params: dict
    optimizer: optax.OptState
    delta: Array
    key: Array
    step: Array
    networks: Networks = struct.field(pytree_node=False)


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
    delta = jnp.asarray(config.delta if config.delta_unit == "error" else jnp.inf, jnp.float32)
    return LearnState(params, make_optimizer(config).init(params), delta, key, jnp.zeros((), jnp.int32), networks)


def window_losses(
    model: OptionModel, config: OptionsConfig, window: Window, noise: Array, disturbance: Array | float = 0.0
) -> dict[str, Array]:
    """Return the losses of one window and its duration; `noise` [D] draws every o_i from q(o|a_0..a_i).

    `disturbance` [L, P] is added to the normalised states that D reads.

    E descends the sum L_recons + lambda_kl L_KL + lambda_pred L_pred - lambda_adv L_adv (and, if D emits an end signal,
    lambda_end times its loss), and F descends L_adv: the reversal in front of F changes the sign on its way into E and
    nowhere else. Under termination predict Algorithm 1 cuts the window further, and L_pred is the sum over the prefixes
    up to there; otherwise L_pred is of the whole window.
    """
    means, log_stds = model.encode(window.actions)
    last = jnp.sum(window.mask, dtype=jnp.int32) - 1
    mask = window.mask
    if config.termination == "predict":
        errors = prefix_errors(model, means + jnp.exp(log_stds) * noise[None], window.states)
        last = jnp.minimum(last, stop_index(errors, model.delta))
        mask = jnp.arange(len(errors)) <= last
        prediction = jnp.sum(jnp.where(mask, errors, 0.0))
    mean, log_std = means[last], log_stds[last]
    option = mean + jnp.exp(log_std) * noise
    states = model.see(window.states, window.states[:1])
    if config.termination != "predict":
        prediction = prediction_loss(model.predict(states[0], option), model.changes(window.states)[last])
    decoded, end_logit = model.decode(option, states[:-1] + disturbance)
    estimated = model.estimate(gradient_reversal(option, config.lambda_adv))
    losses = {
        "reconstruction_loss": reconstruction_loss(decoded, window.actions, mask, model.networks.discrete),
        "kl_loss": kl_loss(mean, log_std),
        "prediction_loss": prediction,
        "adversarial_loss": adversarial_loss(estimated, states[0], states[last + 1]),
        "duration": (last + 1).astype(jnp.float32),
    }
    return losses | ({"end_loss": end_loss(end_logit, mask)} if config.termination == "output" else {})


def total_loss(
    params: dict, model: OptionModel, config: OptionsConfig, windows: Window, *noise: Array
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Return the weighted sum and the mean of each loss over N windows; `noise` is for codes, then for states."""
    one = partial(window_losses, model.replace(params=params), config)
    losses = jax.tree.map(jnp.mean, jax.vmap(one)(windows, *noise))
    total = (
        losses["reconstruction_loss"]
        + config.lambda_kl * losses["kl_loss"]
        + config.lambda_pred * losses["prediction_loss"]
        + losses["adversarial_loss"]
        + config.lambda_end * losses.get("end_loss", 0.0)
    )
    return total, losses


def step(config: OptionsConfig, dataset: Dataset, state: LearnState) -> tuple[LearnState, dict[str, Array]]:
    """Take one gradient step on a batch of windows drawn at random from the selection."""
    key, key_windows, key_option, key_delta = jax.random.split(state.key, 4)
    if config.termination == "predict" and config.delta_unit == "quantile":
        state = state.replace(delta=_measure_delta(config, dataset, state, key_delta))
    windows = _draw(config, dataset, key_windows, jnp.zeros((), jnp.int32), dataset.count)
    noise, model = draw_noise(config, windows, key_option), as_model(state, dataset)
    state, losses = descend(total_loss, config, model, state.replace(key=key), windows, *noise)
    return state, losses | ({"delta": state.delta} if config.termination == "predict" else {})


def draw_noise(config: OptionsConfig, windows: Window, key: Key[Array, ""]) -> list[Array]:
    """Return the noise of `total_loss`: [N, D] for codes and, for a closed-loop D, [N, L, P] on states."""
    noise = [jax.random.normal(key, (len(windows.mask), config.size))]
    if config.decoder == "closed":
        key_states = jax.random.fold_in(key, 1)  # separate, so that an open-loop decoder draws the same
        noise.append(config.state_noise * jax.random.normal(key_states, windows.states[:, :-1].shape))
    return noise


def descend(
    loss: LossFn, config: OptionsConfig, model: OptionModel, state: LearnState, windows: Window, *args: Array
) -> tuple[LearnState, dict[str, Array]]:
    """Take one gradient step on the loss of N windows; return the next state, the terms and the code `nonfinite`.

    Scales and delta are those of `model`, parameters those of `state`; `args` go to the loss after the windows.
    """
    gradient, losses = jax.grad(loss, has_aux=True)(state.params, model, config, windows, *args)
    with jax.numpy_dtype_promotion("standard"):  # Optax raises a float to an integer power
        updates, optimizer = make_optimizer(config).update(gradient, state.optimizer)
    params: Any = optax.apply_updates(state.params, updates)
    nonfinite = first_nonfinite(
        window=(windows.states, windows.actions), loss=list(losses.values()), gradient=(params, optimizer)
    )
    state = state.replace(params=params, optimizer=optimizer, step=state.step + 1)
    return state, losses | {"nonfinite": nonfinite}


def _draw(
    config: OptionsConfig, dataset: Dataset, key: Key[Array, ""], first: Int[Array, ""], count: Int[Array, ""]
) -> Window:
    """Draw a batch among the windows first..first + count; under termination output their length is drawn too."""
    key_which, key_ticks = jax.random.split(key)
    which = first + jax.random.randint(key_which, (config.batch_size,), 0, count)
    shortest = config.shortest if config.termination == "output" else config.length
    ticks = jax.random.randint(key_ticks, (config.batch_size,), shortest, config.length + 1)
    view = None
    if len(dataset.views) > 1:
        view = jax.random.randint(jax.random.fold_in(key_which, 1), (config.batch_size,), 0, len(dataset.views))
    return gather(dataset, which, ticks, config.length, view)


def _measure_delta(config: OptionsConfig, dataset: Dataset, state: LearnState, key: Key[Array, ""]) -> Float[Array, ""]:
    """Return the quantile `config.delta` of P's errors on held-out windows, averaged over the latest steps.

    Without held-out windows it is NaN, which no error reaches.
    """
    windows = _draw(config, dataset, key, dataset.count, dataset.held_out)
    model = as_model(state, dataset)
    measured = jax.vmap(lambda window: prefix_errors(model, model.encode(window.actions)[0], window.states))(windows)
    quantile = jnp.where(dataset.held_out > 0, jnp.quantile(measured, config.delta), jnp.nan)
    return jnp.where(state.step == 0, quantile, state.delta + (quantile - state.delta) / DELTA_MEMORY)


def steps(
    config: OptionsConfig, count: int, state: LearnState, dataset: Dataset
) -> tuple[LearnState, dict[str, Array], None]:
    """Take `count` gradient steps and return the mean losses, and the earliest of the codes `nonfinite`."""
    state, losses = jax.lax.scan(lambda s, _: step(config, dataset, s), state, None, count)
    nonfinite = earliest(losses.pop("nonfinite"))
    return state, jax.tree.map(jnp.mean, losses) | {"nonfinite": nonfinite}, None


def as_model(state: LearnState, dataset: Dataset) -> OptionModel:
    """Return the option model learnt so far."""
    return OptionModel(state.params, dataset.state_scale, dataset.change_scale, state.delta, state.networks)


def code_book(config: OptionsConfig, state: LearnState, dataset: Dataset) -> Float[Array, "M D"]:
    """Return the book of discrete options: the centres of the codes of windows."""
    model = as_model(state, dataset)
    key_windows, key_centres = jax.random.split(state.key)
    many = dataclasses.replace(config, batch_size=BOOK_WINDOWS)
    windows = _draw(many, dataset, key_windows, jnp.zeros((), jnp.int32), dataset.count)
    last = jnp.sum(windows.mask, axis=1, dtype=jnp.int32) - 1
    codes = jax.vmap(lambda actions, last: model.encode(actions)[0][last])(windows.actions, last)
    return centres(codes, config.codes, key_centres)


def learn(
    config: OptionsConfig,
    experience: Experience | Sequence[Experience],
    key: Key[Array, ""],
    views: Views | None = None,
    discrete: bool = False,
    heading: Heading | None = None,
) -> tuple[OptionModel, dict[str, Array]]:
    """Learn an option model from experience [T, B, ...]; pure, so experiences and keys may be vmapped.

    Several experiences, of tasks that share the body, are merged. Returns the model and the losses of every step,
    leading axis the step. With `config.views` all, windows have all `views` of the body (`Env.views`). With
    `discrete` actions are one-hot (`Env.discrete`). `heading` is that of the body (`Env.heading`), for the config's
    frame and way.

    Raises:
      ShortExperienceError: delta is a quantile, and no experience is long enough to hold a part out.
      ValueError: `config.views` is all, and `views` is missing; or the frame needs a heading.
    """
    if (config.views == "all" or config.choose == "way") and views is None:
        raise ValueError(
            "options.views: all and options.choose: way need the views of the body, as in learn(..., views=env.views); "
            "got none"
        )
    config = as_arrays(config)
    dataset = make_dataset(experience, config, views, make_frame(config, heading))
    rows = dataset.experience
    networks = make_networks(config, rows.obs.shape[-1], rows.action.shape[-1], discrete, heading)
    state, losses = jax.lax.scan(lambda s, _: step(config, dataset, s), init(config, networks, key), None, config.steps)
    model = as_model(state, dataset).replace(views=views if config.choose == "way" else None)
    return model.replace(book=code_book(config, state, dataset)) if config.codes else model, losses
