"""Termination rules: where they end an option, by hand, and what the executor does with each."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from probes import Counting, assert_trees_equal, draw, random_model

from taic_jax.config import OptionsConfig
from taic_jax.envs import AutoReset
from taic_jax.options import losses
from taic_jax.options.execution import OptionExecutor, make_executor
from taic_jax.options.model import OptionModel, Scale
from taic_jax.options.termination import Fixed, Output, Predict, prefix_errors, stop_index
from taic_jax.rl.rollout import rollout, start

LENGTH, STATE_SIZE, ACTION_SIZE, OBS_SIZE = 4, 3, 2, 7
CONFIG = OptionsConfig(
    length=LENGTH, size=2, hidden_size=4, mlp_sizes=(4,), decoder_sizes=(4,), termination="predict",
)  # fmt: skip


DELTA = 2.0
"""Of the rollout below: some options surprise P at their first tick, some later, some not before their episode ends."""


@partial(jax.jit, static_argnums=0)
def encode(encoder: Any, params: dict, actions: jax.Array) -> jax.Array:
    """Return E's mean of every prefix."""
    return encoder.apply(params, actions)[0]


@pytest.mark.parametrize(
    ("errors", "delta", "index"),
    [
        ([0.1, 0.2, 0.9, 0.1], 0.5, 2),
        ([0.1, 0.9, 0.2, 0.8], 0.5, 1),  # later ones do not count
        ([0.9, 0.1, 0.1, 0.1], 0.5, 0),
        ([0.1, 0.5, 0.5, 0.9], 0.5, 1),  # an error that equals delta reaches it
        ([0.1, 0.2, 0.3, 0.4], 0.5, 3),  # none does
        ([0.1, 0.2, 0.3, 0.9], 0.5, 3),
    ],
)
def test_stop_index_by_hand(errors, delta, index):
    got = stop_index(jnp.array(errors), jnp.float32(delta))
    assert got == index and got.dtype == jnp.int32


def test_prefix_errors_by_hand():
    """P whose weights are zero predicts its bias, here 0.5: the error is that of the normalised change from s_0."""
    config = dataclasses.replace(CONFIG, mlp_sizes=(1,))
    model = random_model(config, state_size=1, action_size=1)
    params = jax.tree.map(jnp.zeros_like, model.params)
    params["predictor"]["params"]["MLP_0"]["Dense_1"]["bias"] = jnp.array([0.5])
    change = Scale(jnp.array([1.0]), jnp.array([2.0]))
    errors = prefix_errors(
        model.replace(params=params, change_scale=change), jnp.zeros((2, 2)), jnp.array([[3.0], [5.0], [8.0]])
    )
    # Changes 2 and 5, normalised 0.5 and 2.
    np.testing.assert_allclose(errors, [0.0, 2.25])


act = jax.jit(lambda executor, carry, obs: executor.act(carry, obs, jnp.zeros(executor.noise_size)))
ended = jax.jit(lambda executor, carry, obs, noise: executor.ended(carry, obs, noise))


def drive(executor: OptionExecutor, option: jax.Array, obs: jax.Array, noise: jax.Array | None = None):
    """Run one option through given observations [L + 1, S]; return the actions, the carries and when beta was yes."""
    carry, actions, carries, ends = executor.start(option, obs[0]), [], [], []
    noise = jnp.zeros((len(obs) - 1, 0)) if noise is None else noise
    for i in range(len(obs) - 1):
        carry, action = act(executor, carry, obs[i])
        actions.append(action)
        carries.append(carry)
        ends.append(bool(ended(executor, carry, obs[i + 1], noise[i])))
    return jnp.stack(actions), carries, np.array(ends)


@pytest.fixture(scope="module")
def driven() -> tuple[OptionExecutor, jax.Array, jax.Array]:
    """Return an executor under termination predict, an option some of whose actions are clipped, and observations."""
    model = random_model(CONFIG, STATE_SIZE, ACTION_SIZE)
    obs = draw(np.random.default_rng(4), LENGTH + 1, OBS_SIZE)
    return make_executor(CONFIG, model), jnp.array([-1.0, 1.0]), obs


def test_following_tick_by_tick_is_the_batched_pass(driven):
    executor, option, obs = driven
    assert isinstance(executor.termination, Predict) and executor.noise_size == 0
    actions, carries, _ = drive(executor, option, obs)
    assert np.any(np.abs(actions) == 1.0) and np.any(np.abs(actions) < 1.0)
    model = executor.model
    means, _ = model.encode(actions)
    errors = prefix_errors(model, means, obs[:, :STATE_SIZE])
    for i in range(LENGTH):
        np.testing.assert_allclose(carries[i].memory.option, means[i], rtol=1e-5, atol=1e-6)
    for delta in [*(errors * 0.999), *(errors * 1.001), jnp.float32(1e-9), jnp.float32(jnp.inf)]:
        _, _, ends = drive(executor.replace(model=model.replace(delta=delta)), option, obs)
        np.testing.assert_array_equal(ends, errors >= delta)
        assert (np.argmax(ends) if any(ends) else LENGTH - 1) == stop_index(errors, delta)


def test_entries_beyond_the_slice_change_nothing(driven):
    executor, option, obs = driven
    executor = executor.replace(model=executor.model.replace(delta=jnp.float32(1.0)))
    result = drive(executor, option, obs)
    assert_trees_equal(result, drive(executor, option, obs.at[:, STATE_SIZE:].set(99.0)))
    assert_trees_equal(result, drive(executor, option, obs[:, :STATE_SIZE]))


def take_noise(obs: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Take the noise as option."""
    return noise, noise[:, 0]


def test_in_a_rollout_every_option_ends_where_algorithm_1_stops():
    """Also an environment's second option: nothing of the one before is remembered."""
    model = random_model(CONFIG, state_size=1, action_size=1)
    scales = Scale(jnp.full(1, 5.0), jnp.full(1, 5.0)), Scale(jnp.full(1, -2.0), jnp.ones(1))
    model = OptionModel(model.params, *scales, jnp.float32(DELTA), model.networks)
    env, executor = AutoReset(Counting(7, spread=5)), make_executor(CONFIG, model)
    running = start(env, executor, 4, jax.random.key(0))
    ticks = jax.jit(lambda running: rollout(env, executor, take_noise, running, jax.random.key(1), 24)[1])(running)
    seen = set()
    for b in range(4):
        lasts = np.flatnonzero(ticks.ended[:, b])
        for first, last in zip([0, *(lasts[:-1] + 1)], lasts, strict=True):
            states = jnp.concatenate([ticks.obs[first : last + 1, b], ticks.final_obs[last, b][None]])
            actions = jnp.pad(ticks.action[first : last + 1, b], ((0, LENGTH - (last + 1 - first)), (0, 0)))
            means = encode(model.networks.encoder, model.params["encoder"], actions)[: last + 1 - first]
            surprised = np.asarray(prefix_errors(model, means, states) >= DELTA)
            assert not surprised[:-1].any()
            assert surprised[-1] or len(surprised) == LENGTH or ticks.terminated[last, b]
            seen.add((len(surprised), bool(surprised[-1])))
    assert {(1, True), (3, True), (LENGTH, True), (2, False)} <= seen


def test_end_loss_by_hand():
    logits = jnp.array([0.0, 2.0, -1.0, 50.0])
    loss = losses.end_loss(logits, jnp.array([True, True, True, False]))
    # No, no, yes: -ln 1/2, -ln(1 - sigmoid(2)), -ln sigmoid(-1).
    expected = [np.log(2.0), np.log1p(np.exp(2.0)), np.log1p(np.exp(1.0))]
    np.testing.assert_allclose(loss, np.mean(expected), rtol=1e-5)
    of_optax = optax.sigmoid_binary_cross_entropy(logits[:3], jnp.array([0.0, 0.0, 1.0]))
    np.testing.assert_allclose(loss, np.mean(of_optax), rtol=1e-6)
    whole = losses.end_loss(logits, jnp.ones(4, bool))
    np.testing.assert_allclose(whole, np.mean([expected[0], expected[1], np.log1p(np.exp(-1.0)), 0.0]), rtol=1e-5)


def test_masked_ticks_have_no_end_loss():
    logits, mask = draw(np.random.default_rng(5), 4), jnp.array([True, True, False, False])
    value_and_grad = jax.value_and_grad(losses.end_loss)
    value, gradient = value_and_grad(logits, mask)
    other, other_gradient = value_and_grad(logits.at[2:].set(jnp.array([7.0, -7.0])), mask)
    assert value == other and not gradient[2:].any() and gradient[:2].all()
    np.testing.assert_array_equal(gradient, other_gradient)


def make_output(end_signal: Any) -> tuple[OptionExecutor, jax.Array]:
    """Return an executor under termination output, and the end logits [L] of one option."""
    config = dataclasses.replace(CONFIG, termination="output", end_signal=end_signal)
    model = random_model(config, STATE_SIZE, ACTION_SIZE)
    _, logits = model.decode(jnp.array([0.5, -1.0]), jnp.zeros((LENGTH, STATE_SIZE)))
    return make_executor(config, model), logits


def test_a_thresholded_signal_ends_where_it_is_above_one_half():
    executor, logits = make_output("threshold")
    assert executor.termination == Output(0) and executor.noise_size == 0
    shift = jnp.sort(logits)[1:3].mean()  # so that two are above zero and two below
    bias = executor.model.params["decoder"]["params"]["head"]["bias"]
    params = jax.tree.map(lambda x: x, executor.model.params)
    params["decoder"]["params"]["head"]["bias"] = bias.at[-1].add(-shift)
    executor = executor.replace(model=executor.model.replace(params=params))
    _, _, ends = drive(executor, jnp.array([0.5, -1.0]), jnp.zeros((LENGTH + 1, STATE_SIZE)))
    np.testing.assert_array_equal(ends, logits > shift)
    assert sum(ends) == 2


def test_a_sampled_signal_ends_as_often_as_its_probability():
    executor, logits = make_output("sampled")
    assert executor.termination == Output(1) and executor.noise_size == 1
    obs, count = jnp.zeros((LENGTH + 1, STATE_SIZE)), 20_000
    _, carries, _ = drive(executor, jnp.array([0.5, -1.0]), obs, jnp.zeros((LENGTH, 1)))
    noise = jax.random.normal(jax.random.key(0), (count, 1))
    for i in range(LENGTH):
        np.testing.assert_allclose(carries[i].memory, logits[i], rtol=1e-5, atol=1e-6)
    for logit in (-3.0, -0.5, 0.0, 1.0):
        carry = carries[0].replace(memory=jnp.float32(logit))
        yes = jax.vmap(executor.ended, (None, None, 0))(carry, obs[0], noise)
        probability = 1.0 / (1.0 + np.exp(-logit))
        bound = 4 * np.sqrt(probability * (1 - probability) / count)
        np.testing.assert_allclose(np.mean(yes), probability, atol=bound)


def test_a_fixed_option_takes_no_noise():
    executor = make_executor(
        dataclasses.replace(CONFIG, termination="fixed"), random_model(CONFIG, STATE_SIZE, ACTION_SIZE)
    )
    assert executor.termination == Fixed() and executor.noise_size == 0


@pytest.mark.parametrize(("unit", "delta"), [("quantile", 1.0), ("error", 0.7)])
def test_delta_is_the_models_as_a_quantile_and_the_configs_as_an_error(unit, delta):
    config = dataclasses.replace(CONFIG, delta_unit=unit, delta=0.7)
    model = random_model(config, STATE_SIZE, ACTION_SIZE)
    executor = make_executor(config, model.replace(delta=jnp.ones(())))
    np.testing.assert_allclose(executor.model.delta, delta)
