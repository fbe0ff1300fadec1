"""Practice: its task by hand, D as SAC's actor, and a sled that learns to go where codes say."""

import dataclasses
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import assert_trees_equal, numbers, random_model
from scipy import special, stats
from sled import TURN, Sled, turned
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
from taic_jax.config import Config, ConfigError, OptionsConfig, PractiseConfig, SACConfig
from taic_jax.config.checks import validate
from taic_jax.envs import AutoReset, TimeLimit
from taic_jax.envs.views import one_view
from taic_jax.options.execution import IdentityExecutor, make_executor
from taic_jax.report.curves import pretraining
from taic_jax.report.runs import read_run
from taic_jax.rl import practise, sac
from taic_jax.rl.practise import Practising
from taic_jax.rl.refit import refit
from taic_jax.rl.rollout import rollout, start
from taic_jax.runtime.checkpoint import Checkpoints
from taic_jax.summary import plan
from taic_jax.trainer import make_trainer
from taic_jax.types import as_arrays

L, HOLD = 4, 3
OPTIONS = as_arrays(OptionsConfig(
    length=L, size=2, hidden_size=8, mlp_sizes=(16,), decoder_sizes=(16,), batch_size=64, decoder="closed",
    squash=True, frame="heading", way_weight=2, learning_rate=3e-3,
))  # fmt: skip
PRACTICE = PractiseConfig(
    ticks=30_000, hold=HOLD, speed=0.8, upright=0.7, refit_steps=300,
    sac=SACConfig(rollout_length=32, update_every=8, updates_per_decision=0.25, batch_size=64, warmup=0,
                  temperature=0.1, learning_rate=1e-3),
)  # fmt: skip
SHORT = dataclasses.replace(PRACTICE, ticks=160 * PRACTICE.sac.num_envs)
WEIGHTS = 0.7 * jnp.minimum(1.0, 0.5 + jnp.arange(120.0) / 160)[:, None]  # on being upright, tick by tick
SLED = TimeLimit(Sled(), 50)


@pytest.fixture(scope="module")
def model():
    """A model whose D acts within bounds, and whose P leads opposite codes opposite ways."""
    model = random_model(OPTIONS, 6, 2, Sled.heading)
    params = jax.tree.map(lambda x: 0.3 * x, model.params)
    params["predictor"] = jax.tree.map(lambda x: x if x.ndim == 2 else 0.0 * x, model.params["predictor"])
    return model.replace(params=params, change_scale=model.change_scale.replace(mean=jnp.zeros(8)))


@pytest.fixture(scope="module")
def task(model):
    return Practising(SLED, OPTIONS, SHORT, model)


@pytest.fixture(scope="module")
def walk(task):
    return walked(task)


def walked(task):
    """Return random actions of ticks [T, B], the first state and all later ones."""
    actions = jax.random.uniform(jax.random.key(1), (120, 8, 2), minval=-1.0)
    env = AutoReset(task)

    def tick(state, action):
        state = jax.vmap(env.step)(state, action)
        return state, state

    first = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 8))
    return actions, first, jax.jit(lambda state: jax.lax.scan(tick, state, actions)[1])(first)


def fresh(task):
    """Return fresh parameters of SAC on the task."""
    policy = sac.make_policy(IdentityExecutor(2), practise.settings(PRACTICE, OPTIONS))
    return policy, policy.init(jax.random.key(0), task.observation_size, 1.0)


def test_the_observation_is_the_input_of_d(task, model, walk):
    """SAC's mean actor does in the task what the executor does with the code."""
    policy, params = fresh(task)
    params, executor = practise.actor_of(model.params["decoder"], params), make_executor(OPTIONS, model)
    practice = walk[2].physics
    for t, b in ((0, 0), (5, 1), (50, 2), (77, 7)):
        carry = executor.start(practice.code[t, b], practice.first[t, b])
        for _ in range(int(practice.tick[t, b]) + 1):
            carry, action = executor.act(carry, practice.inner.obs[t, b], jnp.zeros(0))
        np.testing.assert_allclose(policy.mode(params, practice.obs[t, b]), action, atol=1e-5)
        np.testing.assert_array_equal(practice.obs[t, b], walk[2].obs[t, b])


def test_d_becomes_the_actor_and_the_actor_d(task, model):
    decoder = model.params["decoder"]
    params = practise.actor_of(decoder, fresh(task)[1])
    assert_trees_equal(practise.decoder_of(params.actor, decoder), decoder)
    other = jax.tree.map(lambda x: x + 1.0, params.actor)
    changed = practise.decoder_of(other, decoder)["params"]["mlp"]["Dense_1"]
    noise = jax.random.normal(jax.random.key(2), (500, 2))
    options, _ = fresh(task)[0].draw(params, jnp.zeros((500, task.observation_size)), 1.0, noise)
    assert np.arctanh(options).std(axis=0) == pytest.approx([practise.STD] * 2, rel=0.1)
    np.testing.assert_array_equal(changed["kernel"][:, :2], decoder["params"]["mlp"]["Dense_1"]["kernel"][:, :2] + 1.0)
    np.testing.assert_array_equal(changed["kernel"][:, 2:], decoder["params"]["mlp"]["Dense_1"]["kernel"][:, 2:])


def test_the_reward_is_of_the_speed_in_the_codes_direction(model, walk):
    actions, first, states = walk
    before = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b[:-1]]), first.physics, states.physics)
    directions = jax.vmap(jax.vmap(partial(practise.direction, model, practise.sector_of(model))))(before.code)
    np.testing.assert_allclose(directions, before.direction, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1.0, atol=1e-5)
    velocity = turned(actions, TURN * before.tick.astype(float))  # seen from where the option began
    along = jnp.sum(velocity * directions, axis=-1)
    across = jnp.abs(velocity[..., 0] * directions[..., 1] - velocity[..., 1] * directions[..., 0])
    expected = jnp.minimum(along, 0.8) - 0.5 * across + WEIGHTS - 0.1 * jnp.sum(actions**2, axis=-1)
    np.testing.assert_allclose(states.reward, expected, atol=1e-4)


def test_the_information_of_a_code_is_paid_at_an_options_end(model, walk):
    """From the likelihoods of 32 other codes; the sled's way is half a second of each action."""
    actions, _, states = walked(Practising(SLED, OPTIONS, dataclasses.replace(SHORT, reward="information"), model))
    paid = states.reward - (WEIGHTS - 0.1 * jnp.sum(actions**2, axis=-1))
    others, scale = jax.random.normal(jax.random.key(1), (32, 2)), model.change_scale
    practice, count = states.physics, 0
    for b in range(8):
        for t in range(L, 49):  # within the first episode
            if int(practice.tick[t - 1, b]) + 1 != L:
                assert abs(float(paid[t, b])) < 1e-4
                continue
            first = practice.inner.obs[t - L, b]
            ways = turned(0.5 * actions[t - L + 1 : t + 1, b], TURN * jnp.arange(float(L)))
            way = (ways.sum(axis=0) - scale.mean[-2:]) / scale.std[-2:]
            codes = jnp.vstack([practice.code[t - 1, b][None], others])
            ways = jnp.stack([model.predict(model.see(first, first), code)[-2:] for code in codes])
            nats = -0.5 * np.sum(np.square(np.asarray(ways - way[None], np.float64)), axis=1)
            expected = nats[0] - special.logsumexp(nats[1:]) + np.log(32)
            np.testing.assert_allclose(paid[t, b], L * expected, rtol=2e-3, atol=2e-3)
            count += 1
    assert count > 50


def test_a_change_of_ds_actions_costs_its_square(task, model, walk):
    changed = walked(Practising(SLED, OPTIONS, dataclasses.replace(SHORT, kl_weight=3.0), model))
    policy, params = fresh(task)
    params = practise.actor_of(model.params["decoder"], params)
    actions, first, states = walk
    obs = jnp.concatenate([first.obs[None], states.obs[:-1]])
    ended = np.concatenate([np.zeros((1, 8), bool), np.asarray(states.truncated)[:-1]])  # whose obs is the last one's
    change = jnp.sum(jnp.square(actions - jax.vmap(jax.vmap(partial(policy.mode, params)))(obs)), axis=-1)
    np.testing.assert_allclose(changed[2].reward[~ended], (states.reward - 1.5 * change)[~ended], rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("sides", [1, 4])
def test_directions_of_codes_spread_evenly_in_the_order_of_p(model, sides):
    codes = jax.random.normal(jax.random.key(5), (2000, 2))
    model = model.replace(views=one_view(6, 2, sides) if sides > 1 else None)
    ways = np.asarray(jax.vmap(lambda o: model.predict(jnp.zeros(6), o))(codes) * model.change_scale.std[None])[:, -2:]
    ways = ways + np.array([6.0, 2.0])  # all go roughly one way
    model = model.replace(change_scale=model.change_scale.replace(mean=jnp.zeros(8).at[-2:].set(jnp.array([6.0, 2.0]))))
    sector = practise.sector_of(model)
    got = jax.vmap(partial(practise.direction, model, sector))(codes)
    angles = np.arctan2(got[:, 1], got[:, 0]) - sector.middle
    angles = (angles + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(angles).max() <= np.pi / sides + 1e-4
    assert angles.std() == pytest.approx(np.pi / sides / np.sqrt(3), rel=0.15), "as of a uniform distribution"
    expected = np.arctan2(ways[:, 1], ways[:, 0])
    assert stats.spearmanr(angles, expected).statistic > 0.99


def test_codes_are_held_for_whole_options_and_end_with_episodes(walk):
    _, _, states = walk
    practice, done = states.physics, np.asarray(states.truncated)
    assert (done.sum(axis=0) == 2).all() and not np.asarray(states.terminated).any()
    changes = np.abs(np.diff(practice.code, axis=0)).max(axis=-1) > 0
    held = {b: np.diff(np.flatnonzero(changes[:, b])) for b in range(8)}
    lengths = {int(n) for b in held for n in held[b]}
    assert {L, 2 * L, HOLD * L} <= lengths and max(lengths) == HOLD * L
    assert changes[done[1:]].all(), "a new episode has a new code"
    np.testing.assert_array_equal(practice.tick[1:][changes], 0)
    share = states.obs[..., -1]
    np.testing.assert_allclose(share[~done], practice.tick[~done] / L, atol=1e-6)
    np.testing.assert_allclose(states.obs[..., 6:8], practice.code, atol=1e-6)


def test_a_sled_learns_to_go_where_its_codes_say_and_keeps_its_other_networks(model):
    trainer = make_trainer("practise", SLED, as_arrays(Config(options=OPTIONS, practise=PRACTICE)), model)
    state = jax.jit(trainer.init)(jax.random.key(0))
    step, first = jax.jit(trainer.step), None
    for _ in range(trainer.num_steps):
        state, metrics, _ = step(state)
        first = metrics if first is None else first
    assert metrics["mean/speed_along"] > 0.5 > 0.2 > first["mean/speed_along"]
    np.testing.assert_allclose(state.obs_statistics.mean, 0.0, atol=1e-3)
    np.testing.assert_allclose(state.obs_statistics.std, 1.0, atol=1e-3)
    practised = model.with_decoder(practise.decoder_of(state.learnt.policy.actor, model.params["decoder"]))
    refitted, losses = jax.jit(partial(refit, OPTIONS, PRACTICE, SLED))(practised, jax.random.key(3))
    assert_trees_equal(refitted.params["decoder"], practised.params["decoder"])
    assert read(refitted) > 0.6 > 0.4 > read(practised), "E reads the code from the actions, but not how long it is"
    assert np.mean(losses["prediction_loss"][-20:]) < 0.5 * np.mean(losses["prediction_loss"][:20])


def read(model):
    """Return the correlation of codes with E's means of the actions that they give."""
    env, executor = AutoReset(SLED), make_executor(OPTIONS, model)
    begin = start(env, executor, 64, jax.random.key(7))
    codes = jax.random.normal(jax.random.key(8), (64, 2))
    _, ticks = rollout(env, executor, lambda obs, noise: (codes, jnp.zeros(64)), begin, jax.random.key(9), L)
    means = jax.vmap(model.encode)(jnp.swapaxes(ticks.action, 0, 1))[0][:, -1]
    return np.corrcoef(np.ravel(means), np.ravel(codes))[0, 1]


VALID = {
    "options__decoder": "closed", "options__squash": True, "options__frame": "heading", "options__way_weight": 8,
    "practise__ticks": 16,
}  # fmt: skip
SAC = SACConfig(num_envs=2, rollout_length=8, update_every=4, capacity=32, batch_size=4, warmup=0)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"options__decoder": "open"}, "options.decoder: expected closed with practise.ticks, since an open-loop D"),
        ({"options__squash": False}, "options.squash: expected True with practise.ticks, since D is the actor of SAC"),
        ({"practise__sac__relabel": 4}, "practise.sac.relabel: expected 0, since a code is no goal"),
        ({"practise__sac__hidden_sizes": (8,)}, "practise.sac.hidden_sizes: expected (256, 256), unused: D's are"),
        ({"practise__sac__update_every": 3}, "practise.sac.update_every: expected a divisor"),
        ({"options__frame": "world"}, "options.frame: expected heading with practise.ticks, from which"),
        ({"options__way_weight": 0}, "options.way_weight: expected 16 with practise.ticks, so that P tells"),
        ({"practise__ticks": 15}, "practise.ticks: expected at least one iteration"),
    ],
)
def test_what_cannot_be_practised_is_refused(fields, message):
    config = with_fields(dataclasses.replace(CONFIG, practise=PractiseConfig(sac=SAC)), **VALID)
    validate(config)
    with pytest.raises(ConfigError) as error:
        validate(with_fields(config, **fields))
    assert message in str(error.value)


RUN = with_fields(
    dataclasses.replace(CONFIG, practise=PractiseConfig(refit_steps=3, sac=SAC)),
    **VALID | {"practise__ticks": 40, "options__decoder_sizes": (4,)},
    env__name=f"{Path(__file__).parents[1] / 'sled.py'}:Sled",
)  # fmt: skip


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """Return the folder of a whole run."""
    folder = tmp_path_factory.mktemp("practised")
    with tiny_steps():
        taic.run_pipeline(RUN, folder, quiet=True)
    return folder


def test_a_run_practises_between_learn_and_train(finished):
    rows = rows_of(finished)
    stages = list(dict.fromkeys(row["stage"] for row in rows if row["stage"] != "evaluate"))
    assert stages == ["collect", "learn", "practise", "train"]
    practised = [row for row in rows if row["stage"] == "practise"]
    assert [row["ticks"] for row in practised] == [16, 32] and "practise/mean/speed_along" in practised[0]
    env, learnt = taic.load(finished).env, last_state(finished, "learn")
    model = load_options(finished / "options", env, RUN.options, 2)
    for name in ("decoder", "encoder", "predictor", "estimator"):
        for leaf in numbers(model.params[name]):
            assert leaf.ndim < 3 or not any(np.array_equal(leaf, x) for x in learnt.values()), name
    assert_trees_equal(taic.load(finished).options.rows.params, model.params)
    lines = plan(RUN, env, env).splitlines()
    assert "practise sled: 32 ticks x 2 seeds in 2 iterations" in lines
    assert any(line.startswith("memory   replay of practise") for line in lines)
    assert pretraining(read_run(finished), "train") == (80, [])


def test_a_run_that_was_killed_in_practice_ends_as_a_whole_one(finished, tmp_path, monkeypatch):
    with tiny_steps():
        with pytest.raises(KilledError):
            die(monkeypatch, Checkpoints, "save", 3 + 2 + 2)  # in the last step of practice
            taic.run_pipeline(RUN, tmp_path, quiet=True)
        monkeypatch.undo()
        assert rows_of(tmp_path)[-1]["stage"] == "practise"
        taic.run_pipeline(RUN, tmp_path, resume=True, quiet=True)
    assert_same_arrays(*(last_state(folder, "train") for folder in (finished, tmp_path)))
    assert rows_of(finished) == rows_of(tmp_path) and methods_of(finished) == methods_of(tmp_path)
