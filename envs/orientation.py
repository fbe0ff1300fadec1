"""Orientation of a free body from its quaternion (w, x, y, z), and horizontal vectors."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float


def heading(quaternion: Float[Array, " 4"]) -> Float[Array, ""]:
    """Return the yaw in rad of the body's x axis, projected on the ground."""
    w, x, y, z = quaternion
    return jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))


def unit(angle: Float[Array, ""]) -> Float[Array, " 2"]:
    """Return the vector of length 1 in this direction in rad."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def turned(vectors: Float[Array, "*batch 2"], angle: Float[Array, ""]) -> Float[Array, "*batch 2"]:
    """Return horizontal vectors turned to the left by an angle in rad."""
    c, s = unit(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return jnp.stack([c * x - s * y, s * x + c * y], axis=-1)


def upright(quaternion: Float[Array, " 4"]) -> Float[Array, ""]:
    """Return the upward part of the body's own z axis: 1 if it is level, and negative on its back."""
    _, x, y, _ = quaternion
    return 1 - 2 * (x**2 + y**2)


def upside_down(quaternion: Float[Array, " 4"]) -> Bool[Array, ""]:
    """Return whether the body's own z axis points down."""
    return upright(quaternion) < 0


def wrapped(angle: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Return the same angle in [-pi, pi)."""
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi
