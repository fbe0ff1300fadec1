"""Fine-tuning D: it reaches D and nothing else, follows the reward, and is held near the D that was learnt."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import NO, Probe, assert_trees_equal, numbers
from sled import Sled
from tiny_runs import CONFIG, KilledError, assert_same_arrays, die, last_state, tiny_steps, with_fields

from taic_jax.artifacts.models import load_options
from taic_jax.config import FineTuneConfig, OptionsConfig, PPOConfig
from taic_jax.envs import Env, TimeLimit, make_env
from taic_jax.options.execution import OptionExecutor, make_executor
from taic_jax.options.model import OptionModel, Scale, init_params, make_networks
from taic_jax.pipeline import run_pipeline
from taic_jax.rl import fine_tune, ppo
from taic_jax.runtime.checkpoint import Checkpoints
from taic_jax.types import as_arrays

T, B, L = 16, 8, 3
OPTIONS = OptionsConfig(length=L, size=2, hidden_size=4, mlp_sizes=(4,), decoder_sizes=(8,))
PPO = as_arrays(
    PPOConfig(num_envs=B, rollout_length=T, epochs=4, minibatch_size=32, hidden_sizes=(4,), log_std_init=-1.0)
)
FINE = as_arrays(FineTuneConfig(epochs=4, minibatch_size=16, learning_rate=0.02, std=0.2, kl_weight=0.0))
ITERATIONS = 100
"""Over which step sizes decay."""


class Forward(Probe):
    """Endless walk: the reward is the action, which also moves x."""

    episode_length = 10_000

    def move(self, x: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        return 0.9 * x + 0.1 * action, action, NO, NO


FORWARD = Forward()


def make(decoder: str, env: Env = FORWARD, **fields: str) -> OptionExecutor:
    """Return the executor of a model as it is before it learns."""
    options = dataclasses.replace(OPTIONS, decoder=decoder, **fields)
    networks = make_networks(options, env.proprioceptive_size, env.action_size, heading=env.heading)
    params = init_params(networks, options, jax.random.key(3))
    scale = Scale(jnp.zeros(env.proprioceptive_size), jnp.ones(env.proprioceptive_size))
    return make_executor(options, OptionModel(params, scale, scale, jnp.ones(()), networks))


@partial(jax.jit, static_argnames=("count", "env"))
def tune(fine, executor: OptionExecutor, count: int, env: Env = FORWARD):
    """Return the state and D before and after `count` iterations of D, and the metrics."""
    state = ppo.init(PPO, env, executor, jax.random.key(0))
    before = state, fine_tune.init(PPO, executor)

    def one(carry, _):
        state, tuned, metrics = fine_tune.iterate(PPO, fine, env, executor, ITERATIONS, *carry)
        return (state, tuned), metrics

    after, metrics = jax.lax.scan(one, before, None, count)
    return before, after, jax.tree.map(lambda x: x[-1], metrics)


@pytest.mark.parametrize("decoder", ["open", "closed"])
def test_changes_d_and_nothing_else(decoder):
    executor = make(decoder)
    (state, tuned), (state_after, tuned_after), _ = tune(FINE, executor, 1)
    noisy = executor.replace(std=FINE.std)
    alone, *_ = jax.jit(lambda state: ppo.iterate(PPO, Forward(), noisy, ITERATIONS, state))(state)
    for name in ("params", "optimizer", "obs_statistics", "reward_scale", "iteration"):
        jax.tree.map(
            partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-5), getattr(alone, name), getattr(state_after, name)
        )
    changed = [np.abs(a - b).max() for a, b in zip(numbers(tuned.decoder), numbers(tuned_after.decoder), strict=True)]
    assert max(changed) > 1e-3
    # The end signal has no part in the actions' likelihood: the last column of D's head stays.
    head = "head" if decoder == "open" else "Dense_1"
    layers = [tree["params"] if decoder == "open" else tree["params"]["mlp"] for tree in
              (tuned.decoder, tuned_after.decoder)]  # fmt: skip
    np.testing.assert_array_equal(layers[0][head]["kernel"][:, -1], layers[1][head]["kernel"][:, -1])
    assert (layers[0][head]["kernel"][:, 0] != layers[1][head]["kernel"][:, 0]).any()


@pytest.mark.parametrize(("decoder", "frame", "env"), [
    ("open", "world", FORWARD), ("closed", "world", FORWARD), ("closed", "heading", TimeLimit(Sled(), 50)),
])  # fmt: skip
def test_likelihoods_are_of_the_actions_that_were_taken(decoder, frame, env):
    """The rows hold the actions that the executor emitted, before they were clipped."""
    executor = make(decoder, env, frame=frame)
    # After an iteration, whose last options go on in the next.
    state = tune(dataclasses.replace(FINE, learning_rate=jnp.zeros(())), executor, 1, env)[1][0]
    noisy = executor.replace(std=FINE.std)
    _, _, ticks, judgement = jax.jit(lambda state: ppo.iterate(PPO, env, noisy, ITERATIONS, state))(state)
    rows = fine_tune._rows(PPO, noisy, state.running.option, ticks, judgement)
    np.testing.assert_allclose(np.clip(rows.action, -1, 1), ticks.action.reshape(-1, env.action_size), atol=1e-5)
    assert rows.tick.min() == 0 and rows.tick.max() == L - 1
    # One standard deviation away the likelihood is exp(-1/2) of the highest.
    np.testing.assert_allclose(np.mean(rows.log_prob), -0.5 * env.action_size, atol=0.2)


def test_the_divergence_is_the_mean_over_rows_of_that_of_all_actions():
    """KL of normals with one deviation: half the squared distance of their means in deviations, summed over actions."""
    options, state = dataclasses.replace(OPTIONS, decoder="closed"), 3
    networks = make_networks(options, state, 2)
    learnt, tuned = (init_params(networks, options, jax.random.key(k)) for k in range(2))
    scale, keys = Scale(jnp.zeros(state), jnp.ones(state)), jax.random.split(jax.random.key(2), 2)
    executor = make_executor(options, OptionModel(learnt, scale, scale, jnp.ones(()), networks))
    option, obs = jax.random.normal(keys[0], (5, 2)), jax.random.normal(keys[1], (5, state))
    rows = fine_tune.Actions(option, obs, jnp.arange(5) % L, jnp.zeros((5, 2)), jnp.zeros(5), jnp.zeros(5))
    _, (_, kl) = fine_tune.decoder_loss(tuned["decoder"], executor, rows, PPO, FINE)
    models = executor.model, executor.model.with_decoder(tuned["decoder"])
    means = [[fine_tune.mean_action(m, L, option[i], obs[i], rows.tick[i]) for m in models] for i in range(5)]
    expected = np.mean([np.sum((a - b) ** 2) / (2 * 0.2**2) for a, b in np.array(means)])
    np.testing.assert_allclose(kl, expected, rtol=1e-5)


@pytest.mark.parametrize("decoder", ["open", "closed"])
def test_follows_the_reward(decoder):
    executor = make(decoder)
    (_, tuned), (_, tuned_after), metrics = tune(FINE, executor, 10)

    def action(model: OptionModel, option: jax.Array) -> jax.Array:
        return fine_tune.mean_action(model, L, option, jnp.zeros(1), jnp.zeros((), int))

    before, after = (
        np.mean(jax.vmap(partial(action, executor.model.with_decoder(d)))(
            jax.random.normal(jax.random.key(1), (64, 2))
        ))
        for d in (tuned.decoder, tuned_after.decoder)
    )  # fmt: skip
    assert after > before + 0.3 and metrics["decoder_kl"] > 1


def test_the_divergence_holds_d_back():
    free, held = (
        tune(dataclasses.replace(FINE, kl_weight=jnp.float32(weight)), make("open"), 4)[2]["decoder_kl"]
        for weight in (0.0, 10.0)
    )
    assert 0 < held < 0.1 * free


def test_without_a_step_size_nothing_moves():
    (_, tuned), (_, after), metrics = tune(dataclasses.replace(FINE, learning_rate=jnp.zeros(())), make("closed"), 2)
    assert_trees_equal(tuned.decoder, after.decoder)
    assert metrics["decoder_kl"] == 0.0


def test_options_fill_the_ticks_they_ran():
    option = jnp.arange(8.0).reshape(4, 2, 1)
    decision = jnp.array([[False, True], [True, False], [False, False], [True, True]])
    filled = fine_tune.fill_options(option, decision, jnp.array([[-1.0], [-2.0]]))
    np.testing.assert_array_equal(filled[..., 0], [[-1, 1], [2, 1], [2, 1], [6, 7]])


def test_a_run_fine_tunes_in_turns_and_goes_on_where_it_stopped(tmp_path, monkeypatch):
    config = with_fields(
        CONFIG,
        train__fine_tune=FineTuneConfig(epochs=1, minibatch_size=8, learning_rate=0.01),
        train__ticks=4 * 16,
        train__baselines=(),
    )
    with tiny_steps():
        whole = run_pipeline(config, tmp_path / "whole").summary
        die(monkeypatch, Checkpoints, "save", 3 + 2 + 2)  # after collect's and learn's, in the last step of train
        with pytest.raises(KilledError):
            run_pipeline(config, tmp_path / "torn")
        monkeypatch.undo()
        resumed = run_pipeline(config, tmp_path / "torn", resume=True).summary
    assert whole["ticks"] == 2 * (3 + 4) * 16
    assert whole["methods"] == resumed["methods"]
    assert_same_arrays(*(last_state(tmp_path / name, "train") for name in ("whole", "torn")))
    learnt, tuned = (
        load_options(tmp_path / "whole" / name, make_env("nav2d"), config.options, 2)
        for name in ("options", "agents/taic")
    )
    for name in learnt.params:
        same = [(a == b).all() for a, b in zip(numbers(learnt.params[name]), numbers(tuned.params[name]), strict=True)]
        assert all(same) == (name != "decoder")
