"""The losses of option learning, each of one window: the caller vmaps and averages."""

from typing import Any

import distrax
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from taic_jax.types import Scalar


def reconstruction_loss(
    decoded: Float[Array, "L A"], actions: Float[Array, "L A"], mask: Bool[Array, " L"], discrete: bool = False
) -> Float[Array, ""]:
    """Return L_Recons (eq. 3): the mean squared error over the window's own actions.

    For discrete actions it is the cross-entropy of the logits `decoded`, in nats.
    """
    squares = jnp.mean(jnp.square(decoded - actions), axis=-1)
    errors = optax.softmax_cross_entropy(decoded, actions) if discrete else squares
    return jnp.sum(jnp.where(mask, errors, 0.0)) / jnp.sum(mask, dtype=jnp.float32)


def kl_loss(mean: Float[Array, " D"], log_std: Float[Array, " D"]) -> Float[Array, ""]:
    """Return L_KL (eq. 2): KL(q(o|a) || N(0, I)) in nats."""
    posterior = distrax.MultivariateNormalDiag(mean, jnp.exp(log_std))
    prior = distrax.MultivariateNormalDiag(jnp.zeros_like(mean), jnp.ones_like(mean))
    kl: Any = posterior.kl_divergence(prior)
    return kl


def prediction_loss(predicted: Float[Array, " C"], change: Float[Array, " C"]) -> Float[Array, ""]:
    """Return L_pred (eq. 8): the mean squared error of the normalised state change."""
    return jnp.mean(jnp.square(predicted - change))


def adversarial_loss(
    estimated: Float[Array, "2 P"], start: Float[Array, " P"], end: Float[Array, " P"]
) -> Float[Array, ""]:
    """Return L_adv (eq. 9): F's mean squared error on normalised start and end state."""
    return jnp.mean(jnp.square(estimated - jnp.stack([start, end])))


def end_loss(end_logit: Float[Array, " L"], mask: Bool[Array, " L"]) -> Float[Array, ""]:
    """Return the cross-entropy of the end signal c_t (§3.4.2): yes at the window's last action, no before it."""
    is_last = mask & ~jnp.append(mask[1:], False)
    errors = optax.sigmoid_binary_cross_entropy(end_logit, is_last.astype(jnp.float32))
    return jnp.sum(jnp.where(mask, errors, 0.0)) / jnp.sum(mask, dtype=jnp.float32)


@jax.custom_vjp
def gradient_reversal(x: Array, scale: Scalar) -> Array:
    """Return x; its gradient is multiplied by -scale on the way back (figure 2)."""
    return x


def _reversal_forward(x: Array, scale: Array) -> tuple[Array, Array]:
    return x, scale


def _reversal_backward(scale: Array, gradient: Array) -> tuple[Array, Array]:
    return -scale * gradient, jnp.zeros_like(scale)


gradient_reversal.defvjp(_reversal_forward, _reversal_backward)
