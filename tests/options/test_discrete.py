"""Discrete options and discrete actions: the code book, the executor, the loss, and options of known sequences."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import draw, random_model
from scipy import stats

from taic_jax.config import OptionsConfig
from taic_jax.options.code_book import centres
from taic_jax.options.dataset import Experience
from taic_jax.options.execution import make_executor
from taic_jax.options.learning import learn
from taic_jax.options.losses import reconstruction_loss

A, P = 3, 2
CONFIG = OptionsConfig(
    length=3, size=2, hidden_size=16, mlp_sizes=(16,), steps=300, batch_size=64, learning_rate=0.02,
    lambda_kl=1e-3, lambda_adv=0.0, select="random",
)  # fmt: skip


def test_the_centres_are_those_of_clouds_and_every_cloud_has_one():
    rng = np.random.default_rng(0)
    places = np.array([[0, 0], [5, 0], [0, 5], [5, 5], [10, 0]], np.float32)
    codes = jnp.asarray((places[:, None] + 0.1 * rng.normal(size=(5, 50, 2))).reshape(-1, 2), jnp.float32)
    for key in jax.random.split(jax.random.key(0), 5):
        book = np.asarray(centres(codes, 5, key))
        expected = np.asarray(codes).reshape(5, 50, 2).mean(axis=1)
        np.testing.assert_allclose(book[np.lexsort(book.round().T)], expected[np.lexsort(places.T)], atol=1e-4)


def test_more_centres_than_different_codes_are_finite():
    codes = jnp.array([[0.0], [1.0], [1.0], [0.0]])
    assert set(np.asarray(centres(codes, 4, jax.random.key(0)))[:, 0]) == {0.0, 1.0}


def test_a_one_hot_option_runs_its_code_of_the_book():
    model = random_model(CONFIG, P, A).replace(book=draw(np.random.default_rng(0), 5, CONFIG.size))
    book, plain = (make_executor(dataclasses.replace(CONFIG, codes=codes), model) for codes in (5, 0))
    assert (book.option_size, book.discrete, plain.option_size, plain.discrete) == (5, True, 2, False)
    obs = jnp.ones(P)
    for i in range(5):
        one, other = book.start(jax.nn.one_hot(i, 5), obs), plain.start(model.book[i], obs)
        for _ in range(3):
            (one, action), (other, expected) = book.act(one, obs, jnp.zeros(0)), plain.act(other, obs, jnp.zeros(0))
            np.testing.assert_allclose(action, expected, rtol=1e-5)


@pytest.mark.parametrize("sampled", [False, True])
def test_discrete_actions_are_one_hot_greedy_or_drawn_by_their_logits(sampled):
    model = random_model(CONFIG, P, A)
    model = model.replace(networks=model.networks._replace(discrete=True))
    executor = make_executor(dataclasses.replace(CONFIG, sample_actions=sampled), model)
    assert executor.noise_size == (A if sampled else 0)
    option, obs = jnp.array([0.5, -1.0]), jnp.ones(P)
    logits = np.asarray(model.decode(option, obs[None])[0][0], float)
    noise = jax.random.normal(jax.random.key(0), (5000, executor.noise_size))
    actions = jax.vmap(lambda noise: executor.act(executor.start(option, obs), obs, noise)[1])(noise)
    assert set(np.unique(actions)) == {0.0, 1.0} and (actions.sum(axis=1) == 1.0).all()
    probs = np.exp(logits) / np.exp(logits).sum() if sampled else np.eye(A)[logits.argmax()]
    assert actions[:, probs == 0].sum() == 0
    assert not sampled or stats.chisquare(actions.sum(axis=0), probs * 5000).pvalue > 0.01


def test_the_reconstruction_loss_of_discrete_actions_is_the_cross_entropy():
    rng = np.random.default_rng(0)
    logits, chosen, mask = draw(rng, 4, A), jnp.array([0, 2, 1, 1]), jnp.array([True, True, True, False])
    expected = optax.softmax_cross_entropy_with_integer_labels(logits, chosen)[:3].mean()
    np.testing.assert_allclose(reconstruction_loss(logits, jax.nn.one_hot(chosen, A), mask, True), expected, rtol=1e-5)


def test_options_of_discrete_actions_and_their_book_hold_every_sequence():
    """Of 3 actions the first 2 are used; the windows of two ticks are their 4 sequences, and a book of 4 codes."""
    sequences = np.array([*itertools.product(range(2), repeat=2)])
    actions = sequences[np.random.default_rng(0).integers(0, 4, (64, 40))].transpose(0, 2, 1).reshape(-1, 40)
    moves = np.cumsum(np.eye(A, P)[actions], axis=0)  # each action moves its own coordinate
    state = np.concatenate([np.zeros((1, 40, P)), moves[:-1]])
    columns = (jnp.asarray(x, jnp.float32) for x in (state, np.eye(A)[actions], np.zeros(actions.shape)))
    rows = Experience(*columns, jnp.zeros(actions.shape, bool))
    config = dataclasses.replace(CONFIG, length=2, codes=4)
    model, losses = jax.jit(lambda key: learn(config, rows, key, discrete=True))(jax.random.key(0))
    assert losses["reconstruction_loss"][-1] < 0.1
    decoded = jax.vmap(lambda code: model.decode(code, jnp.zeros((2, P)))[0])(model.book)
    assert {tuple(x) for x in np.argmax(decoded, axis=-1).tolist()} == {tuple(x) for x in sequences.tolist()}
