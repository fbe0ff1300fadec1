"""Our environments as Gymnasium's: its checker passes, and every number is the one of our own loop."""

import sys
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.seeding import np_random

from taic_jax.envs import AutoReset, Env, State, TimeLimit, UnknownNameError, make_env
from taic_jax.envs.adapters import to_gymnasium, to_gymnasium_vector
from taic_jax.envs.errors import AdapterError, MissingExtraError, RenderingError

RIGHT = np.array([1.0, 0.0], np.float32)


def first_key(seed: int):
    """Return the key that a seed stands for."""
    return jax.random.key(int(np_random(seed)[0].integers(2**31)))


@pytest.mark.parametrize("name", ["nav2d", "half_cheetah", "four_rooms"])
def test_gymnasiums_own_checker_passes(name):
    """It finds fault only with obs that has no limits."""
    env = to_gymnasium(make_env(name, "mujoco"), "rgb_array")
    env.reset(seed=0)
    try:
        drawn = env.render() is not None
    except RenderingError:
        drawn, env = False, to_gymnasium(make_env(name, "mujoco"))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        check_env(env, skip_render_check=not drawn)
    complaints = [str(warning.message) for warning in caught if "infinity" not in str(warning.message)]
    assert complaints == [] and len(caught) == 2


def test_one_environment_gives_our_own_numbers():
    """Through a whole episode under actions that partly are too large, as Python's own types."""
    env = TimeLimit(make_env("half_cheetah", "mujoco"), 4)
    theirs = to_gymnasium(env)
    obs, info = theirs.reset(seed=5)
    state, step = jax.jit(env.reset)(first_key(5)), jax.jit(env.step)
    np.testing.assert_array_equal(obs, state.obs)
    assert info == {name: float(value) for name, value in state.metrics.items()}
    for tick, action in enumerate(np.random.default_rng(0).uniform(-2, 2, (4, 6)), start=1):
        state = step(state, np.clip(action, -1, 1).astype(np.float32))
        obs, reward, terminated, truncated, info = theirs.step(action)
        np.testing.assert_array_equal(obs, state.obs)
        assert obs.dtype == np.float32 and obs.flags.writeable
        assert (reward, terminated, truncated) == (float(state.reward), False, tick == 4)
        assert type(reward) is float and type(terminated) is type(truncated) is bool
        assert info == {name: float(value) for name, value in state.metrics.items()}


def test_discrete_actions_are_indices():
    """One copy and three, by our own one-hot actions; Gymnasium draws them as Python's or NumPy's integers."""
    env = make_env("four_rooms")
    one, three = to_gymnasium(env), to_gymnasium_vector(env, 3)
    assert one.action_space == gymnasium.spaces.Discrete(4) == three.single_action_space
    assert three.action_space == gymnasium.spaces.MultiDiscrete([4, 4, 4])
    obs, _ = one.reset(seed=2)
    state, step = env.reset(first_key(2)), jax.jit(env.step)
    for action in (0, np.int64(3), np.array(1), one.action_space.sample()):
        state = step(state, jax.nn.one_hot(int(action), 4))
        obs, *_ = one.step(action)
        np.testing.assert_array_equal(obs, state.obs)
    start, _ = three.reset(seed=7)
    after, *_ = three.step(np.array([0, 1, 2]))
    state = jax.vmap(AutoReset(env).reset)(jax.random.split(first_key(7), 3))
    np.testing.assert_array_equal(start, state.obs)
    np.testing.assert_array_equal(after, jax.vmap(env.step)(state, jnp.eye(4)[:3]).obs)
    moves = {
        (4,): "four_rooms: action: got the shape (4,), expected ()",
        -1: "four_rooms: action: got -1, expected integers from 0 to 3",
        4: "four_rooms: action: got 4, expected integers from 0 to 3",
        1.0: "four_rooms: action: got 1.0, expected integers from 0 to 3",
    }
    for move, message in moves.items():
        with pytest.raises(AdapterError) as caught:
            one.step(np.zeros(move) if isinstance(move, tuple) else np.array(move))
        assert str(caught.value) == message
    with pytest.raises(AdapterError, match=r"action: got \[0 0 9\], expected integers from 0 to 3$"):
        three.step(np.array([0, 0, 9]))


class Episodes(Env):
    """A task that ends at once and observes how many episodes came before."""

    name, observation_size, action_size, proprioceptive_size, episode_length, dt = "a task", 1, 1, 1, 9, 0.25

    def reset(self, key):
        obs, no = jnp.zeros(1), jnp.zeros((), bool)
        return State(obs, obs, jnp.zeros(()), terminated=no, truncated=no, metrics={})

    def restart(self, key, ended):
        return self.reset(key).replace(physics=ended + 1.0, obs=ended + 1.0)

    def step(self, state, action):
        return state.replace(reward=action[0], terminated=jnp.ones((), bool))

    def render(self, physics, *, height=240, width=320):
        return np.full((len(physics), height, width, 3), physics[:, :, None, None], np.uint8)


def test_a_reset_without_a_seed_starts_the_next_episode():
    env = to_gymnasium(Episodes())
    assert [float(env.reset(seed=seed)[0][0]) for seed in (None, None, None, 3, None)] == [0, 1, 2, 0, 1]


def test_frames_show_the_present_state():
    env, envs = to_gymnasium(Episodes(), "rgb_array"), to_gymnasium_vector(Episodes(), 2, "rgb_array")
    env.reset(), env.reset()
    frame = env.render()
    assert frame.shape == (240, 320, 3) and frame.dtype == np.uint8 and (frame == 1).all()
    envs.reset()
    envs.step(np.zeros((2, 1)))
    assert [int(frame.max()) for frame in envs.render()] == [1, 1] and envs.render()[0].shape == frame.shape
    assert env.metadata == {"render_modes": ["rgb_array"], "render_fps": 4.0}
    assert to_gymnasium(Episodes()).render() is None and to_gymnasium_vector(Episodes(), 2).render() is None


def test_the_vector_gives_the_numbers_of_our_own_loop():
    """Bit for bit, in a task whose starts are random, past the ends of several episodes."""
    env = AutoReset(TimeLimit(make_env("nav2d_random"), 3))
    theirs = to_gymnasium_vector(env.env, 4)
    obs, _ = theirs.reset(seed=7)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(first_key(7), 4))
    np.testing.assert_array_equal(obs, state.obs)
    step, ends = jax.jit(jax.vmap(env.step)), 0
    for action in np.random.default_rng(0).uniform(-1, 1, (8, 4, 2)).astype(np.float32):
        state = step(state, action)
        obs, reward, terminated, truncated, infos = theirs.step(action)
        assert obs in theirs.observation_space and reward.dtype == np.float32
        for ours, given in ((state.obs, obs), (state.reward, reward), (state.terminated, terminated)):
            np.testing.assert_array_equal(ours, given)
        np.testing.assert_array_equal(state.truncated, truncated)
        ended = np.asarray(state.terminated | state.truncated)
        metrics = infos["final_info"] if ended.all() else infos
        np.testing.assert_array_equal(metrics["distance_to_goal"], state.metrics["distance_to_goal"])
        assert ("final_obs" in infos) == ended.any()
        for index in np.flatnonzero(ended):
            np.testing.assert_array_equal(infos["final_obs"][index], state.final_obs[index])
            assert (infos["final_obs"][index] != obs[index]).any()
            ends += 1
    assert ends >= 8


def test_infos_are_those_of_gymnasiums_own_vector():
    """One of two copies reaches the goal and starts anew in that tick; of its start no metrics are kept."""
    env = TimeLimit(make_env("nav2d"), 60)
    same = gymnasium.vector.AutoresetMode.SAME_STEP
    theirs = gymnasium.vector.SyncVectorEnv([lambda: to_gymnasium(env)] * 2, autoreset_mode=same)
    ours = to_gymnasium_vector(env, 2)
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    for name in ("observation_space", "action_space", "single_observation_space", "single_action_space"):
        assert getattr(ours, name) == getattr(theirs, name)
    (obs, infos), (obs_theirs, infos_theirs) = ours.reset(seed=0), theirs.reset(seed=0)
    np.testing.assert_array_equal(obs, obs_theirs)
    np.testing.assert_equal(infos, infos_theirs)
    actions = np.stack([RIGHT, np.zeros(2, np.float32)])
    for _ in range(38):
        *outputs, infos = ours.step(actions)
        *outputs_theirs, infos_theirs = theirs.step(actions)
        for one, other in zip(outputs, outputs_theirs, strict=True):
            np.testing.assert_array_equal(one, other)
    assert outputs[2].tolist() == [True, False], "the goal is reached"
    assert infos["final_obs"][0].dtype == np.float32 and infos["final_info"]["success"].tolist() == [1.0, 0.0]
    for name in ("distance_to_goal", "success"):
        assert infos[f"_{name}"].tolist() == [False, True] and infos_theirs[f"_{name}"].all()
        assert infos[name][0] == 0.0 and infos[name][1] == np.float32(infos_theirs[name][1])
        for both in (infos, infos_theirs):
            del both[name], both[f"_{name}"]
    final, final_theirs = infos.pop("final_obs"), infos_theirs.pop("final_obs")
    np.testing.assert_array_equal(final[0], final_theirs[0])
    assert final.dtype == final_theirs.dtype and final[1] is final_theirs[1] is None
    np.testing.assert_equal(infos, infos_theirs)


MISUSES = {
    r"a task: action: got the shape \(2,\), expected \(1,\)": lambda env: env.step(np.zeros(2)),
    "unknown render mode 'rgb': did you mean 'rgb_array'": lambda env: to_gymnasium(Episodes(), "rgb"),
    "to_gymnasium_vector: num_envs: got 0, expected an integer of at least 1": lambda env: to_gymnasium_vector(
        Episodes(), 0
    ),
    "to_gymnasium_vector: a task is in AutoReset, expected the environment inside": lambda env: to_gymnasium_vector(
        AutoReset(Episodes()), 2
    ),
    "a task: reset_mask: got one, expected none": lambda env: to_gymnasium_vector(Episodes(), 2).reset(
        options={"reset_mask": np.ones(2, bool)}
    ),
}


@pytest.mark.parametrize("message", MISUSES)
def test_a_misuse_is_told_in_one_line(message):
    env = to_gymnasium(Episodes())
    env.reset()
    with pytest.raises((AdapterError, UnknownNameError), match=message) as caught:
        MISUSES[message](env)
    assert "\n" not in str(caught.value)


def test_a_step_needs_a_reset_before():
    for env, action in (
        (to_gymnasium(Episodes()), np.zeros(1)),
        (to_gymnasium_vector(Episodes(), 1), np.zeros((1, 1))),
    ):
        with pytest.raises(gymnasium.error.ResetNeeded, match="expected reset before"):
            env.step(action)


def test_without_gymnasium_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "taic_jax.envs.adapters.gymnasium_export", raising=False)
    for leave in (lambda: to_gymnasium(Episodes()), lambda: to_gymnasium_vector(Episodes(), 2)):
        with pytest.raises(MissingExtraError, match=r"gymnasium is not installed: pip install 'taic-jax\[gym\]'"):
            leave()
