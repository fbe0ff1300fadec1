"""Guard against batched LAPACK: two such calls at once can wait for each other for ever in XLA's CPU runtime."""

import re
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import pytest

from taic_jax.config import OptionsConfig
from taic_jax.networks import Policy
from taic_jax.options.model import init_params, make_networks

LINEAR_ALGEBRA = {
    "cholesky", "eig", "eigh", "geqrf", "hessenberg", "householder_product", "lu", "ormqr", "qr", "schur", "svd",
    "triangular_solve", "tridiagonal", "tridiagonal_solve",
}  # fmt: skip


def init(key: jax.Array) -> tuple:
    """Initialise every network there is."""
    key_policy, key_options = jax.random.split(key)
    config = OptionsConfig(length=2, hidden_size=16, mlp_sizes=(16,))
    policy = Policy(config.size, (16,)).init(key_policy, 5, jnp.zeros(()))
    return policy, init_params(make_networks(config, 5, 3), config, key_options)


@pytest.mark.timeout(60)
def test_initialising_many_seeds_at_once_returns():
    many = jax.jit(jax.vmap(init))
    for seed in range(20):
        jax.block_until_ready(many(jax.random.split(jax.random.key(seed), 8)))


def primitives_of(function: Callable, *args: Any) -> set[str]:
    """Return the names of all primitives in a program and in the programs inside it."""
    return set(re.findall(r" = (\w+)", str(jax.make_jaxpr(function)(*args))))


def test_initialising_uses_no_linear_algebra():
    primitives = primitives_of(jax.vmap(init), jax.random.split(jax.random.key(0), 8))
    assert "erf_inv" in primitives  # of the initialisers, which are inner programs
    assert not primitives & LINEAR_ALGEBRA


def test_an_orthogonal_initialiser_would_be_caught():
    orthogonal = partial(jax.nn.initializers.orthogonal(), shape=(3, 3))
    assert primitives_of(orthogonal, jax.random.key(0)) & LINEAR_ALGEBRA
