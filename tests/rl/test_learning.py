"""Learning options of variable length: an end signal that says what is known, and a threshold that is a quantile."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import draw

from taic_jax.config import OptionsConfig
from taic_jax.options import learning
from taic_jax.options.dataset import (
    HELD_OUT_EVERY,
    STRETCH,
    Dataset,
    Experience,
    ShortExperienceError,
    gather,
    make_dataset,
)
from taic_jax.options.execution import make_executor
from taic_jax.options.learning import learn
from taic_jax.options.model import make_networks
from taic_jax.options.termination import prefix_errors
from taic_jax.types import as_arrays

T, B, LENGTH, SHORTEST = 160, 4, 4, 2
OUTPUT = OptionsConfig(
    length=LENGTH, size=2, hidden_size=12, mlp_sizes=(4,), steps=300, batch_size=32, learning_rate=0.03,
    lambda_kl=1e-3, lambda_pred=0.0, lambda_adv=0.0, lambda_end=1.0, select="random",
    termination="output", shortest=SHORTEST, end_signal="threshold",
)  # fmt: skip
PREDICT = dataclasses.replace(OUTPUT, length=2, hidden_size=4, steps=2, lambda_pred=1.0, termination="predict")


def make_experience(num_ticks: int = T, scale: np.ndarray | float = 1.0) -> Experience:
    """Return experience of random states, whose changes are times `scale` [T], under one constant action."""
    rng = np.random.default_rng(0)
    obs = draw(rng, num_ticks, B, 2) * jnp.broadcast_to(jnp.float32(scale), (num_ticks,))[:, None, None]
    action, done = jnp.full((num_ticks, B, 1), 0.5), jnp.zeros((num_ticks, B), bool)
    return Experience(obs, action, draw(rng, num_ticks, B), done)


select, init = jax.jit(make_dataset), jax.jit(learning.init, static_argnums=1)


def start(config: OptionsConfig, experience: Experience) -> tuple[OptionsConfig, Dataset, learning.LearnState]:
    """Return the config's arrays, the windows, and the state before the first step."""
    config = as_arrays(config)
    return config, select(experience, config), init(config, make_networks(config, 2, 1), jax.random.key(0))


learn_output = jax.jit(partial(learn, OUTPUT))


@pytest.fixture(scope="module")
def learnt():
    return jax.device_get(learn_output(make_experience(), jax.random.key(0)))


def test_the_end_signal_says_how_long_the_window_was(learnt):
    """All actions are the same, so the code can tell a window's length by counting alone."""
    model, losses = learnt
    executor = make_executor(OUTPUT, model)
    means, _ = model.encode(jnp.full((LENGTH, 1), 0.5))
    act = jax.jit(executor.act)
    for ticks in range(SHORTEST, LENGTH + 1):
        carry, ends = executor.start(means[ticks - 1], jnp.zeros(2)), []
        for _ in range(LENGTH):
            carry, _ = act(carry, jnp.zeros(2), jnp.zeros(1))
            ends.append(bool(executor.ended(carry, jnp.zeros(2), jnp.zeros(0))))
        assert ends.index(True) + 1 == ticks
    assert losses["end_loss"][-20:].mean() < 0.1 < 0.5 < losses["end_loss"][0]


def test_windows_take_between_shortest_and_length_ticks(learnt):
    _, losses = learnt
    assert losses["duration"].min() >= SHORTEST and losses["duration"].max() <= LENGTH
    np.testing.assert_allclose(losses["duration"].mean(), (SHORTEST + LENGTH) / 2, atol=0.05)
    config, dataset, _ = start(OUTPUT, make_experience())
    windows = jax.jit(learning._draw)(config, dataset, jax.random.key(0), jnp.int32(0), dataset.count)
    ticks = windows.mask.sum(axis=1)
    assert set(ticks.tolist()) == {2, 3, 4}
    np.testing.assert_array_equal(windows.mask, np.arange(LENGTH) < np.asarray(ticks)[:, None])  # no gaps


@jax.jit
def measure(config: OptionsConfig, dataset: Dataset, state: learning.LearnState, key: jax.Array) -> jax.Array:
    return learning._measure_delta(config, dataset, state, key)


@jax.jit
def errors_of(config: OptionsConfig, dataset: Dataset, state: learning.LearnState) -> jax.Array:
    """Return P's error on every prefix of every window, in the order of `dataset.starts`."""
    model = learning.as_model(state, dataset)
    which = jnp.arange(len(dataset.starts))
    windows = gather(dataset, which, jnp.full(len(which), config.length), config.length)
    means, _ = jax.vmap(model.encode)(windows.actions)
    return jax.vmap(partial(prefix_errors, model))(means, windows.states)


def wild_where_held_out() -> Experience:
    tick = np.arange(480)
    wild = tick // (STRETCH * PREDICT.length) % HELD_OUT_EVERY == HELD_OUT_EVERY - 1
    return make_experience(480, np.where(wild, 100.0, 1.0))


@pytest.mark.parametrize("quantile", [0.2, 0.5, 0.9])
def test_delta_is_the_quantile_of_held_out_errors(quantile):
    """Held-out stretches move a hundred times as far as others, so that errors on those would be told apart."""
    config, dataset, state = start(dataclasses.replace(PREDICT, delta=quantile, batch_size=512), wild_where_held_out())
    assert state.delta == np.inf
    delta = measure(config, dataset, state, jax.random.key(1))
    learnt_from, held_out, _ = np.split(errors_of(config, dataset, state), np.cumsum([dataset.count, dataset.held_out]))
    assert len(held_out) > 100
    np.testing.assert_allclose(np.mean(held_out < delta), quantile, atol=0.05)
    assert np.mean(learnt_from < delta) > quantile + 0.09


def test_delta_is_averaged_over_the_latest_steps():
    config, dataset, state = start(dataclasses.replace(PREDICT, batch_size=512), wild_where_held_out())
    quantile = measure(config, dataset, state, jax.random.key(1))
    later = measure(config, dataset, state.replace(step=jnp.int32(7), delta=jnp.float32(50.0)), jax.random.key(1))
    np.testing.assert_allclose(later, 50.0 + (quantile - 50.0) / 100.0, rtol=1e-5)
    assert abs(quantile - 50.0) > 1.0


def test_the_model_carries_the_delta_in_force():
    quantile = jax.jit(partial(learn, PREDICT))
    model, losses = quantile(make_experience(), jax.random.key(0))
    assert np.isfinite(losses["delta"]).all() and losses["delta"][0] != losses["delta"][1] == model.delta
    config = dataclasses.replace(PREDICT, delta=1.75, delta_unit="error")
    model, losses = jax.jit(partial(learn, config))(make_experience(20), jax.random.key(0))  # far too short to hold out
    assert (np.asarray(losses["delta"]) == 1.75).all() and model.delta == 1.75


def test_a_quantile_needs_a_stretch_to_hold_out():
    needed = 10 * 8 * PREDICT.length
    config, key = as_arrays(PREDICT), jax.random.key(0)
    message = (
        f"options.delta_unit: quantile needs {needed} ticks of each environment, to hold every tenth stretch of "
        f"8 windows out; got {needed - 1}; error needs none"
    )
    short = make_experience(needed - 1)
    for experience in (short, [make_experience(30), short]):
        with pytest.raises(ShortExperienceError) as error:
            learn(config, experience, key)
        assert str(error.value) == message
    assert select([short, make_experience(needed)], config).held_out > 0
    for changes in ({"termination": "fixed"}, {"termination": "output"}, {"delta_unit": "error"}):
        jax.eval_shape(make_dataset, short, as_arrays(dataclasses.replace(PREDICT, **changes)))
