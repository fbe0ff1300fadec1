"""Refreshing options: from the policy's own options, which hardly change where they are in use, in turns with it."""

import dataclasses
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import NO, Probe, assert_trees_equal, draw, numbers, random_model
from tiny_runs import (
    CONFIG,
    KilledError,
    assert_same_arrays,
    die,
    last_state,
    methods_of,
    rows_of,
    tiny_steps,
    with_fields,
)

import taic_jax as taic
from taic_jax.artifacts.models import load_options
from taic_jax.config import Config, ConfigError, OptionsConfig, PPOConfig
from taic_jax.config.checks import validate
from taic_jax.options.dataset import Window, gather
from taic_jax.options.execution import make_executor
from taic_jax.options.learning import window_losses
from taic_jax.rl import ppo, refresh
from taic_jax.rl.rollout import Rollout
from taic_jax.runtime.checkpoint import Checkpoints
from taic_jax.summary import plan
from taic_jax.trainer import OptionTrainer, RefreshTrainer, make_trainer
from taic_jax.types import as_arrays

T, B, L, ITERATIONS = 16, 8, 4, 100
OPTIONS = OptionsConfig(
    length=L, size=2, hidden_size=4, mlp_sizes=(4,), decoder_sizes=(8,), batch_size=32, refresh_every=2,
    refresh_steps=60, learning_rate=0.01, termination="output",
)  # fmt: skip
PPO = as_arrays(PPOConfig(num_envs=B, rollout_length=T, epochs=1, minibatch_size=32, hidden_sizes=(4,)))


class Walk(Probe):
    """Endless walk of one number, which the action moves."""

    episode_length = 10_000

    def move(self, x, action):
        return 0.9 * x + 0.1 * action, action, NO, NO


def learner(options: OptionsConfig) -> tuple:
    """Return the executor of a random model, an untrained policy over it, and the state of its further learning."""
    executor = make_executor(options, random_model(options, 1, 1))
    policy = ppo.init(PPO, Walk(), executor, jax.random.key(0))
    return executor, policy, refresh.init(options, executor.model, jax.random.key(1))


@jax.jit
def refreshed(options: OptionsConfig) -> tuple:
    """Return a model, the same refreshed by the ticks of one iteration, those ticks and the metrics."""
    executor, policy, learnt = learner(options)
    ticks = ppo.iterate(PPO, Walk(), executor, ITERATIONS, policy)[2]
    after, metrics = refresh.refresh(options, executor.model, ticks, learnt)
    return executor.model, refresh.refreshed_executor(executor, after).model, ticks, metrics


def own(ticks: Rollout, model) -> tuple[Window, jax.Array]:
    """Return the windows and codes of all whole options."""
    options = refresh.own_options(ticks, model)
    which = jnp.arange(int(options.windows.count))
    return gather(options.windows, which, options.duration[which], L), options.code[which]


def test_windows_are_the_options_of_the_policy_from_decision_to_end():
    """Of options that began earlier, end with an episode, or are cut by the rollout, none is a window."""
    table = {  # duration and end of the running option at each tick
        0: [(2, 1), (1, 0), (2, 0), (3, 1), (1, 0), (2, 1), (1, 0), (2, 1)],
        1: [(1, 0), (2, 1), (1, 1), (1, 0), (2, 0), (3, 1), (1, 0), (2, 0)],
    }
    duration, ended = (jnp.array([[table[b][t][i] for b in range(2)] for t in range(8)]) for i in range(2))
    rng, never = np.random.default_rng(0), jnp.zeros((8, 2), bool)
    ticks = Rollout(
        obs=draw(rng, 8, 2, 3), option=draw(rng, 8, 2, 2), log_prob=None, decision=duration == 1,
        action=draw(rng, 8, 2, 1), reward=draw(rng, 8, 2), ended=ended == 1, duration=duration,
        terminated=never.at[5, 0].set(True), truncated=never, final_obs=None, episode_return=None, extras=None,
    )  # fmt: skip
    model = random_model(OPTIONS, 2, 1)  # reads two entries of the observation
    windows, codes = jax.device_get(own(ticks, model))
    ticks = jax.device_get(ticks)
    expected = {(0, 1, 3), (1, 0, 2), (1, 2, 1), (1, 3, 3)}
    found = set()
    for states, actions, mask, code in zip(windows.states, windows.actions, windows.mask, codes, strict=True):
        ((start, env),) = np.argwhere((ticks.obs[..., :2] == states[0]).all(-1))
        count = int(mask.sum())
        found.add((int(env), int(start), count))
        assert mask[:count].all()
        np.testing.assert_array_equal(states[: count + 1], ticks.obs[start : start + count + 1, env, :2])
        np.testing.assert_array_equal(actions[:count], ticks.action[start : start + count, env])
        np.testing.assert_array_equal(code, ticks.option[start, env])
    assert found == expected and len(codes) == 4


@pytest.mark.parametrize("decoder", ["open", "closed"])
def test_the_weight_holds_the_actions_of_codes_in_use(decoder):
    changes = []
    for weight in (0.0, 1e4):
        options = as_arrays(dataclasses.replace(OPTIONS, decoder=decoder, refresh_weight=weight))
        before, after, ticks, metrics = refreshed(options)
        windows, codes = own(ticks, before)
        states = before.state_scale(windows.states[:, :-1])
        old, new = (jax.vmap(model.decode)(codes, states)[0] for model in (before, after))
        changes.append(np.mean((old - new)[windows.mask] ** 2))
        if weight == 0.0:  # measured before the last step, on some windows, and as a mean over options, not ticks
            assert 0.5 < metrics["refresh_change"] / changes[0] < 2
    assert changes[1] < 0.02 * changes[0] and changes[0] > 0.1


@pytest.mark.parametrize("termination", ["fixed", "output", "predict"])
def test_a_refresh_lowers_the_loss_on_the_policys_own_options(termination):
    options = as_arrays(dataclasses.replace(OPTIONS, termination=termination, refresh_weight=0.0))
    before, after, ticks, metrics = refreshed(options)
    windows, _ = own(ticks, before)
    noise = jnp.zeros(2)
    was, now = (
        np.mean(jax.vmap(lambda w, m=m: window_losses(m, options, w, noise)["reconstruction_loss"])(windows))
        for m in (before, after)
    )
    assert now < 0.7 * was and metrics["nonfinite"] == -1
    assert set(metrics) >= {"refresh_kl_loss", "refresh_prediction_loss", "refresh_adversarial_loss"}
    assert_trees_equal((before.state_scale, before.change_scale, before.delta), (
        after.state_scale, after.change_scale, after.delta))  # fmt: skip


def test_algorithm_1_reads_no_tick_after_the_end_of_an_own_option():
    options = dataclasses.replace(OPTIONS, termination="predict")
    model = random_model(options, 3, 1).replace(delta=jnp.float32(jnp.inf))
    rng, mask = np.random.default_rng(0), jnp.arange(L) < 2
    window, noise = Window(draw(rng, L + 1, 3), draw(rng, L, 1), mask), draw(rng, 2)
    other = window.replace(states=window.states.at[3:].add(1.0), actions=window.actions.at[2:].add(1.0))
    losses = [window_losses(model, as_arrays(options), w, noise) for w in (window, other)]
    assert losses[0]["duration"] == 2
    assert_trees_equal(*losses)


def test_without_a_whole_option_nothing_changes():
    options = as_arrays(dataclasses.replace(OPTIONS, refresh_steps=2))
    executor, policy, learnt = learner(options)
    ticks = jax.jit(partial(ppo.iterate, PPO, Walk(), executor, ITERATIONS))(policy)[2]
    none = ticks.replace(ended=jnp.zeros_like(ticks.ended))
    for rollout, same in ((none, True), (ticks, False)):
        after, metrics = jax.jit(partial(refresh.refresh, options, executor.model))(rollout, learnt)
        assert np.isnan(metrics["refresh_kl_loss"]) == same
        for was, now in ((learnt.key, after.key), (learnt.params, after.params)):
            assert all(np.array_equal(a, b) for a, b in zip(numbers(was), numbers(now), strict=True)) == same


def test_a_step_is_so_many_iterations_over_the_options_learnt_so_far_and_then_a_refresh_by_their_ticks():
    options = as_arrays(dataclasses.replace(OPTIONS, refresh_steps=2))
    executor, policy, learnt = learner(options)
    learnt = learnt.replace(params=jax.tree.map(lambda x: 0.5 * x, learnt.params))  # by earlier refreshes
    acting = refresh.refreshed_executor(executor, learnt)
    step = jax.jit(partial(ppo.iterate, PPO, Walk(), acting, ITERATIONS))
    first, early, ticks_early, _ = step(policy)
    second, late, ticks_late, _ = step(first)
    ticks = jax.tree.map(lambda *x: jnp.concatenate(x), ticks_early, ticks_late)
    expected, losses = jax.jit(partial(refresh.refresh, options, acting.model))(ticks, learnt)
    iterate = jax.jit(partial(refresh.iterate, options, PPO, Walk(), executor, ITERATIONS))
    policy, after, metrics = iterate(policy, learnt)
    assert_trees_equal((policy, after), (second, expected), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(metrics["refresh_change"], losses["refresh_change"], rtol=1e-2)
    np.testing.assert_allclose(metrics["decisions"], (early["decisions"] + late["decisions"]) / 2)


REFRESHED = with_fields(
    CONFIG, options__refresh_every=2, options__refresh_steps=2, train__ticks=5 * 16, train__baselines=(),
    evaluate__video_ticks=0,
)  # fmt: skip


def test_frozen_options_are_trained_as_before():
    env, model = taic.make_env("nav2d"), random_model(CONFIG.options, 6, 2)
    assert type(make_trainer("train", env, REFRESHED, model)) is RefreshTrainer
    frozen = with_fields(REFRESHED, options__refresh_every=0, options__refresh_weight=9.0)
    assert type(make_trainer("train", env, frozen, model)) is OptionTrainer


@pytest.fixture(scope="module", params=["ppo", "sac"])
def finished(request, tmp_path_factory) -> tuple[Config, Path]:
    """Return a config and the folder of its run, which nothing interrupted."""
    config, folder = with_fields(REFRESHED, train__learner=request.param), tmp_path_factory.mktemp("runs") / "whole"
    with tiny_steps():
        taic.run_pipeline(config, folder, quiet=True)
    return config, folder


def test_an_interrupted_run_ends_as_if_it_had_not_been(finished, tmp_path, monkeypatch):
    config, whole = finished
    with tiny_steps():
        die(monkeypatch, Checkpoints, "save", 3 + 2 + 2)  # after collect's and learn's, in the last step of train
        with pytest.raises(KilledError):
            taic.run_pipeline(config, tmp_path, quiet=True)
        monkeypatch.undo()
    with tiny_steps():
        taic.run_pipeline(config, tmp_path, resume=True, quiet=True)
    assert_same_arrays(*(last_state(folder, "train") for folder in (whole, tmp_path)))
    assert rows_of(whole) == rows_of(tmp_path) and methods_of(whole) == methods_of(tmp_path)


def test_the_agents_act_with_the_refreshed_options_and_the_artifact_stays_as_it_was_learnt(finished):
    config, whole = finished
    rows = [row for row in rows_of(whole) if row["stage"] == "train"]
    assert [row["ticks"] for row in rows] == [32, 64] and all("train/refresh_change" in row for row in rows)
    env, last = taic.make_env("nav2d"), last_state(whole, "train")
    learnt, refreshed = (load_options(whole / name, env, config.options, 2) for name in ("options", "agents/taic"))
    assert_trees_equal(refreshed, taic.load(whole).agents["taic"].rows.executor.model)
    for name in learnt.params:
        for was, now in zip(numbers(learnt.params[name]), numbers(refreshed.params[name]), strict=True):
            assert any(np.array_equal(now, x) for x in last.values())
            assert now.ndim < 3 or not np.array_equal(was, now)
    assert_trees_equal((learnt.state_scale, learnt.delta), (refreshed.state_scale, refreshed.delta))


def test_weights_are_swept_in_one_program(finished, tmp_path):
    config, whole = finished
    points = [config, with_fields(config, options__refresh_weight=1e4)]
    taic.run_pipeline(config, tmp_path, points=points, quiet=True)
    swept, alone = last_state(tmp_path, "train"), last_state(whole, "train")
    (name,) = (x for x in alone if "1.params" in x and "decoder" in x and "first" in x and x.endswith("kernel"))
    np.testing.assert_allclose(swept[name][:2], alone[name], rtol=1e-2, atol=1e-4)
    assert np.abs(swept[name][:2] - swept[name][2:]).max() > 1e-3


def test_the_plan_counts_whole_refreshes_and_the_impossible_is_refused():
    env = taic.make_env("nav2d")
    assert "train    nav2d: 64 ticks x 2 seeds in 4 iterations" in plan(REFRESHED, env, env)
    refused = {
        "options.refresh_every: expected 0 with train.fine_tune.epochs, which changes D too, got 2; the nearest valid "
        "value is 0": {"train__fine_tune__epochs": 1, "train__fine_tune__minibatch_size": 8},
        "train.ticks: expected at least one refresh, train.ppo.num_envs * train.ppo.rollout_length * "
        "options.refresh_every = 96, got 80; the nearest valid value is 96": {"options__refresh_every": 6},
    }
    for message, fields in refused.items():
        with pytest.raises(ConfigError) as error:
            validate(with_fields(REFRESHED, **fields))
        assert str(error.value) == message
    validate(with_fields(REFRESHED, options__source="RUN"))
