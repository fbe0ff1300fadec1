"""The choice of an option by its consequence: the way that it shall lead (eq. 8)."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from taic_jax.options.model import OptionModel

DRAWN, MENU = 256, 64


def menu(size: int) -> Float[np.ndarray, "64 D"]:
    """Return the codes among which the choice is: the quarter of some of the prior that is nearest to its mean.

    D has practised most there: codes further out overturn more ants.
    """
    codes = np.random.default_rng(0).standard_normal((DRAWN, size))
    return codes[np.argsort(np.linalg.norm(codes, axis=1))[:MENU]].astype(np.float32)


def leading(
    model: OptionModel, way: Float[Array, " 2"], state: Float[Array, " P"]
) -> tuple[Float[Array, " D"], Int[Array, ""]]:
    """Return the code and the view of the body that lead farthest along a way in the world's axes, and least aside.

    P predicts the ways of codes from this state in every view; the length of `way` does not matter.
    """
    frame: Any = model.networks.frame
    codes = jnp.asarray(menu(model.networks.encoder.option_size))

    def ways(seen: Float[Array, " P"]) -> Float[Array, "64 2"]:
        return jax.vmap(partial(model.way, model.see(seen, seen)))(codes)

    ahead = model.views.directions(frame.turned(way, state))[:, None]
    left = jnp.stack([-ahead[..., 1], ahead[..., 0]], axis=-1)
    along, aside = (jnp.sum(jax.vmap(ways)(model.views.all(state)) * axis, axis=-1) for axis in (ahead, left))
    gain = along - jnp.abs(aside)
    view = jnp.argmax(jnp.max(gain, axis=1)).astype(jnp.int32)
    return codes[jnp.argmax(gain[view])], view
