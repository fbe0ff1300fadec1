"""A code book: centres of codes, the discrete options of a policy over them."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

ROUNDS = 50


def centres(codes: Float[Array, "N D"], count: int, key: Key[Array, ""]) -> Float[Array, "M D"]:
    """Return `count` centres of codes by k-means, begun at codes that are far from each other (k-means++)."""
    key_first, key_next = jax.random.split(key)
    first = codes[jax.random.randint(key_first, (), 0, len(codes))]

    def spread(nearest: Array, key: Array) -> tuple[Array, Array]:
        chosen = codes[jax.random.categorical(key, jnp.log(nearest))]
        return jnp.minimum(nearest, _squares(codes, chosen[None])[:, 0]), chosen

    _, others = jax.lax.scan(spread, _squares(codes, first[None])[:, 0], jax.random.split(key_next, count - 1))
    return jax.lax.fori_loop(0, ROUNDS, lambda _, book: _means(codes, book), jnp.vstack([first[None], others]))


def _means(codes: Float[Array, "N D"], book: Float[Array, "M D"]) -> Float[Array, "M D"]:
    """Return the mean of the codes nearest to each centre; a centre without any stays."""
    owner = jax.nn.one_hot(jnp.argmin(_squares(codes, book), axis=1), len(book))
    count = jnp.sum(owner, axis=0)[:, None]
    return jnp.where(count > 0.0, owner.T @ codes / jnp.maximum(count, 1.0), book)


def _squares(codes: Float[Array, "N D"], book: Float[Array, "M D"]) -> Float[Array, "N M"]:
    """Return the squared distances."""
    return jnp.sum(jnp.square(codes[:, None] - book[None]), axis=-1)
