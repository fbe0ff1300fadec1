"""Gymnax's environments behind our contract; skipped where gymnax is not installed, but for its absence."""

import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from taic_jax.envs import AutoReset, MissingExtraError, UnknownNameError, check_contract, make_env
from taic_jax.envs.errors import AdapterError
from taic_jax.envs.third_party import third_party


@pytest.fixture
def gymnax():
    """Give the package."""
    with third_party():
        return pytest.importorskip("gymnax")


@pytest.mark.parametrize(
    ("name", "sizes", "clock", "choose"),
    [
        ("CartPole-v1", (4, 2, True), (500, 0.02), lambda a: jnp.argmax(a)),
        ("Pendulum-v1", (3, 1, False), (200, 0.05), lambda a: 2.0 * a),  # torques in [-2, 2]
    ],
)
def test_the_adapter_is_gymnaxs_own_step(gymnax, name, sizes, clock, choose):
    """Tick by tick until gymnax's step ends the episode by itself: the pole falls, or its own time limit is reached."""
    env = make_env(f"gymnax:{name}")
    theirs, params = gymnax.make(name)
    actions = jax.random.uniform(jax.random.key(1), (210, env.action_size), minval=-1.0)

    key = jax.random.split(jax.random.key(0))[0]  # of the start; nothing else is random in these two

    def tick(state, action):
        _, state, reward, terminated, truncated, info = theirs.step(key, state, choose(action), params)
        return state, (info["final_observation"], reward, terminated, truncated)

    step, start = jax.jit(lambda state, action: (env.step(state, action),) * 2), env.reset(jax.random.key(0))
    ours = jax.lax.scan(step, start, actions)[1]
    with third_party():
        start = jax.tree.map(jnp.asarray, theirs.reset(key, params)[1])
        obs, reward, terminated, truncated = jax.lax.scan(tick, start, actions)[1]
    end = int(np.argmax(terminated | truncated)) + 1
    assert 10 < end <= 200
    early = min(end, 50)  # later the pendulum has made more of what two programs round apart
    np.testing.assert_allclose(ours.obs[:early], obs[:early], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(ours.reward[:early], reward[:early], rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(ours.terminated[:end], terminated[:end])
    np.testing.assert_array_equal(ours.truncated[:end], truncated[:end])
    assert (env.observation_size, env.action_size, env.discrete) == sizes
    assert (env.episode_length, env.dt) == clock and env.proprioceptive_size == env.observation_size
    assert env.name == f"gymnax:{name}"


@pytest.mark.parametrize("name", ["Catch-bsuite", "FrozenLake-misc", "Breakout-MinAtar", "PointRobot-misc"])
def test_shapes_of_any_rank_keep_the_contract(gymnax, name):
    """Observations of one number, of a table, and of a table in channels, as vectors; make_env checks the contract."""
    env = make_env(f"gymnax:{name}")
    check_contract(AutoReset(env))
    theirs, params = gymnax.make(name)
    with third_party():
        expected = np.ravel(theirs.reset_env(jax.random.split(jax.random.key(3))[0], params)[0])
    np.testing.assert_array_equal(env.reset(jax.random.key(3)).obs, expected.astype(np.float32))


def test_every_tick_has_a_key_of_its_own(gymnax):
    """The reward of a bandit's arm is drawn each tick."""
    env = make_env("gymnax:BernoulliBandit-misc")
    actions = jnp.zeros((60, 2)).at[:, 0].set(1.0)
    rewards = jax.jit(
        jax.vmap(lambda key: jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, env.reset(key), actions)[1].reward)
    )(jax.random.split(jax.random.key(0), 8))
    assert (np.ptp(rewards, axis=1) > 0).any() and len(np.unique(rewards, axis=0)) > 4


def test_the_picture_is_the_observation_in_grey(gymnax):
    env = make_env("gymnax:Catch-bsuite")
    physics = jax.tree.map(lambda leaf: np.asarray(leaf)[None], env.reset(jax.random.key(0)).physics)
    frames = env.render(physics, height=20, width=10)
    assert frames.shape == (1, 20, 10, 3) and frames.dtype == np.uint8
    cells = env.reset(jax.random.key(0)).obs.reshape(10, 5)  # 1 at ball and paddle
    np.testing.assert_array_equal(frames[0, ::2, ::2, 0] > 200, cells == 1)
    np.testing.assert_array_equal(frames[0, 1::2, 1::2, 2], frames[0, ::2, ::2, 0])
    assert (frames[0, ::2, ::2, 0][cells == 0] == 127).all() and cells.sum() == 2
    pole = make_env("gymnax:CartPole-v1")
    physics = jax.tree.map(lambda leaf: np.asarray(leaf)[None], pole.reset(jax.random.key(0)).physics)
    assert pole.render(physics).shape == (1, 240, 320, 3)


def test_a_wrong_name_gets_the_nearest(gymnax):
    with pytest.raises(
        UnknownNameError, match="unknown environment 'gymnax:CartPol-v1': did you mean 'gymnax:CartPole"
    ):
        make_env("gymnax:CartPol-v1")


@pytest.mark.parametrize(
    ("space", "says"),
    [
        (SimpleNamespace(spaces=()), "gymnax:own: actions: got .*, expected one vector of numbers with limits"),
        (SimpleNamespace(low=-np.inf, high=1.0), r"gymnax:own: actions: action 0 is in \[-inf, 1.0\], expected finite"),
    ],
)
def test_actions_without_a_form_of_ours_are_refused(gymnax, monkeypatch, space, says):
    made = SimpleNamespace(action_space=lambda params: space)
    monkeypatch.setattr(gymnax, "make", lambda name: (made, None))
    monkeypatch.setattr(gymnax, "registered_envs", ["own"])
    with pytest.raises(AdapterError, match=says):
        make_env("gymnax:own")


def test_data_that_cannot_be_read_is_told_in_one_line(gymnax, monkeypatch):
    def make(name):
        raise OSError("no network")

    monkeypatch.setattr(gymnax, "make", make)
    with pytest.raises(AdapterError, match=r"^gymnax:MNISTBandit-bsuite: cannot be made: no network$"):
        make_env("gymnax:MNISTBandit-bsuite")


def test_without_gymnax_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnax", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'taic-jax\[gymnax\]'$"):
        make_env("gymnax:CartPole-v1")
