"""Gymnasium's environments behind our contract: every number is the one of Gymnasium's own loop."""

import sys
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box, Dict, Discrete
from tiny_runs import CONFIG, KilledError, assert_same_arrays, die, last_state, methods_of, tiny_steps, with_fields

from taic_jax.command_line import tell
from taic_jax.envs import AutoReset, RenderingError, TimeLimit, check_contract, make_env
from taic_jax.envs.adapters.episodes import Episodes, as_seed
from taic_jax.envs.adapters.gymnasium import GymnasiumEnv
from taic_jax.pipeline import run_pipeline
from taic_jax.run import main
from taic_jax.runtime.checkpoint import Checkpoints

LOW, HIGH = np.array([[0.0], [-2.0]], np.float32), np.array([[4.0], [2.0]], np.float32)


class Walk(gymnasium.Env):
    """A walk from a random place whose steps are the scaled actions; it ends beyond 5 and is cut when it goes back."""

    observation_space = Dict({"goal": Box(-9, 9, (1,)), "observation": Box(-9, 9, (2,)), "aim": Box(-9, 9, (1,))})
    action_space, metadata, resets = Box(LOW, HIGH), {"render_modes": ["rgb_array"], "render_fps": 4}, 0

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def observe(self):
        return {"aim": [7], "goal": [8], "observation": self.place}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        Walk.resets += 1
        self.place = self.np_random.uniform(size=2)
        return self.observe(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.place = self.place + 0.25 * action[:, 0]
        return (
            self.observe(),
            self.place[0],
            self.place[0] > 5,
            self.place[1] < -1,
            {"far": self.place[0] > 1, "no": []},
        )

    def render(self):
        return np.full((6, 3, 3), int(50 * self.place[0]), np.uint8)


class Unsteady(Walk):
    """Another walk in each instance: from its third tick on, or its first."""

    made = 0

    def __init__(self, quiet=2, **settings):
        super().__init__(**settings)
        Unsteady.made += 1
        self.quiet, self.number = quiet, Unsteady.made

    def reset(self, **settings):
        self.tick = 0
        return super().reset(**settings)

    def step(self, action):
        self.tick += 1
        self.place = self.place + self.number * (self.tick > self.quiet)
        return super().step(action)


def broken():
    raise OSError("no such\nfile")


def variant(**attributes):
    return lambda **settings: type("Variant", (Walk,), attributes)(**settings)


ENTRIES = {
    "Walk-v0": Walk, "Unsteady-v0": Unsteady, "Chance-v0": lambda: Unsteady(quiet=0), "Broken-v0": broken,
    "Choice-v0": variant(action_space=Discrete(3)), "Free-v0": variant(action_space=Box(-np.inf, 1, (2,))),
    "Number-v0": variant(observation_space=Discrete(4)), "Mixed-v0": variant(observation_space=Dict(a=Discrete(2))),
}  # fmt: skip


@pytest.fixture(autouse=True)
def registry(monkeypatch):
    for name, entry in ENTRIES.items():
        spec = EnvSpec(name, entry_point=entry, max_episode_steps=8, disable_env_checker=True)
        monkeypatch.setitem(gymnasium.registry, name, spec)
    monkeypatch.setitem(gymnasium.registry, "Endless-v0", EnvSpec("Endless-v0", entry_point=Walk))


def episodes(env, num_envs, ticks, key=0):
    """Return the first state, the states of all ticks and the actions [T, B, A]."""
    env, keys = AutoReset(env), jax.random.split(jax.random.key(key), num_envs)
    actions = jax.random.uniform(jax.random.key(1), (ticks, num_envs, env.action_size), minval=-1.0)
    first = jax.jit(jax.vmap(env.reset))(keys)
    step = jax.vmap(env.step)
    return first, jax.jit(lambda first: jax.lax.scan(lambda s, a: (step(s, a),) * 2, first, actions)[1])(first), actions


def flattened(obs):
    return np.concatenate([obs["observation"], obs["aim"], obs["goal"]]) if isinstance(obs, dict) else obs


@pytest.mark.parametrize(("name", "ticks"), [("Walk-v0", 30), ("Pendulum-v1", 205), ("Hopper-v5", 40)])
def test_the_numbers_are_gymnasiums_own_also_over_resets(name, ticks):
    """Hand by hand with an environment of Gymnasium's own, with its own time limit, for each of three rows."""
    first, after, actions = episodes(make_env(f"gymnasium:{name}"), 3, ticks)
    for row in range(3):
        env = gymnasium.make(name)
        space = env.action_space
        obs, _ = env.reset(seed=as_seed(np.asarray(first.physics.seed[row])))
        np.testing.assert_array_equal(first.obs[row], np.float32(flattened(obs)))
        for tick in range(ticks):
            state = jax.tree.map(lambda x, i=(tick, row): x[i], after)
            scaled = space.low + (space.high - space.low) * (actions[tick, row].reshape(space.shape) + 1) / 2
            obs, reward, terminated, truncated, info = env.step(np.asarray(scaled, np.float32))
            np.testing.assert_allclose(state.final_obs, np.float32(flattened(obs)), rtol=1e-4, atol=1e-4)
            np.testing.assert_allclose(state.reward, reward, rtol=1e-4, atol=1e-4)
            assert (state.terminated, state.truncated) == (terminated, truncated)
            for metric in state.metrics:
                np.testing.assert_allclose(state.metrics[metric], info[metric], rtol=1e-4, atol=1e-4)
            if terminated or truncated:
                obs, _ = env.reset(seed=as_seed(np.asarray(state.physics.seed)))
            np.testing.assert_allclose(state.obs, np.float32(flattened(obs)), rtol=1e-4, atol=1e-4)
    assert (after.terminated | after.truncated).any()


def test_sizes_parts_and_metrics():
    env = make_env("gymnasium:Walk-v0")
    sizes = env.observation_size, env.proprioceptive_size, env.action_size, env.episode_length, env.dt
    assert sizes == (4, 2, 2, 8, 0.25) and env.proprioception == "gymnasium:Walk-v0" and env.heading is None
    state = env.reset(jax.random.key(0))
    assert list(state.metrics) == ["far"] and len(env.views) == 1
    check_contract(env)


def test_a_state_can_be_stepped_again_with_and_without_its_environment():
    """As after a resume, and as where two programs go on from one state."""
    env = make_env("gymnasium:Walk-v0")
    _, after, _ = episodes(env, 3, 5)
    step, action = jax.jit(jax.vmap(env.step)), 0.5 * jnp.ones((3, 2))
    states = jax.tree.map(lambda x: x[2], after)
    one = step(states, action)
    assert (step(states, -action).physics.name != one.physics.name).any(axis=1).all()
    env.env._episodes._idle.clear()
    skip = jax.random.wrap_key_data(jnp.full((3, 2), 2**32 - 1, jnp.uint32))
    jax.block_until_ready(jax.vmap(env.restart)(skip.at[0].set(jax.random.key(5)), states.physics))
    for other in (
        step(states, action),
        jax.vmap(jax.vmap(env.step))(*jax.tree.map(lambda x: x[None], (states, action))),
    ):
        for a, b in zip(jax.tree.leaves(one.replace(key=None)), jax.tree.leaves(other.replace(key=None)), strict=True):
            np.testing.assert_array_equal(a, b.reshape(a.shape))


def test_rows_of_seeds_are_one_call_and_only_ended_episodes_are_reset(monkeypatch):
    """Two seeds of three environments: a call a tick, and a reset for each episode alone."""
    env, sizes, step = AutoReset(make_env("gymnasium:Walk-v0")), [], Episodes.step
    host = env.env.env._step
    counted = lambda sent, *more: (sizes.append(sent.shape[:-1]), step(env.env.env._episodes, sent, *more))  # noqa: E731
    monkeypatch.setattr(host, "_function", counted)
    keys = jax.random.split(jax.random.key(0), (2, 3))
    actions = jnp.broadcast_to(jnp.linspace(-1.0, 1.0, 6).reshape(2, 3, 1), (8, 2, 3, 2))
    step_all, Walk.resets = jax.vmap(jax.vmap(env.step)), 0
    run = jax.jit(
        lambda keys: jax.lax.scan(lambda s, a: (step_all(s, a),) * 2, jax.vmap(jax.vmap(env.reset))(keys), actions)[1]
    )
    ended = np.asarray((after := run(keys)).terminated | after.truncated)
    assert [np.prod(size) for size in sizes] == [6] * 8
    assert Walk.resets == 6 + ended.sum() and not ended.all(axis=(1, 2)).all()


def test_an_outer_time_limit_restarts_what_gymnasium_did_not_end():
    _, after, _ = episodes(TimeLimit(make_env("gymnasium:Walk-v0"), 2), 3, 5)
    assert after.truncated[1].all() and (after.obs[1] != 0).all() and (after.physics.tick[1] == 0).all()


def test_a_body_like_a_robot_of_ours_shares_its_slice(monkeypatch):
    ours, theirs = make_env("ant", model="gym"), make_env("gymnasium:Ant-v5")
    assert (theirs.proprioception, theirs.proprioceptive_size, theirs.observation_size) == ("ant", 27, 105)
    assert theirs.heading == ours.heading and len(theirs.views) == 4
    weak = EnvSpec("Weak-v0", gymnasium.registry["Ant-v5"].entry_point, kwargs={"frame_skip": 10}, max_episode_steps=9)
    monkeypatch.setitem(gymnasium.registry, "Weak-v0", weak)
    slow = make_env("gymnasium:Weak-v0")
    assert (slow.proprioception, slow.proprioceptive_size, slow.heading) == ("gymnasium:Weak-v0", 105, None)


def test_an_episode_that_does_not_repeat_is_refused(capsys):
    env = make_env("gymnasium:Unsteady-v0")
    step, state = jax.jit(env.step), env.reset(jax.random.key(0))
    for _ in range(4):
        state = step(state, jnp.zeros(2))
    env.env._episodes._idle.clear()
    assert tell(lambda: jax.block_until_ready(step(state, jnp.zeros(2)))) == 2
    problem = "tick 4 of an episode, repeated, has another observation: a run in it cannot be resumed"
    assert capsys.readouterr().err == f"taic_jax: error: gymnasium:Unsteady-v0: {problem}\n"


def test_a_killed_run_resumes_exactly(tmp_path, monkeypatch):
    """After the kill no environment is left, as in a new process."""
    config = with_fields(
        CONFIG, env__name="gymnasium:Walk-v0", collect__env="", evaluate__video_ticks=0, train__baselines=()
    )
    with tiny_steps():
        run_pipeline(config, tmp_path / "whole", quiet=True)
        with monkeypatch.context() as patch:
            die(patch, Checkpoints, "save", 7)
            with pytest.raises(KilledError):
                run_pipeline(config, tmp_path / "killed", quiet=True)
        GymnasiumEnv("Walk-v0")._episodes._idle.clear()
        run_pipeline(config, tmp_path / "killed", resume=True, quiet=True)
    assert methods_of(tmp_path / "whole") == methods_of(tmp_path / "killed")
    assert_same_arrays(*(last_state(tmp_path / folder, "train") for folder in ("whole", "killed")))


def test_pictures_are_gymnasiums_in_our_shape(monkeypatch):
    env = make_env("gymnasium:Walk-v0")
    _, after, _ = episodes(env, 1, 12)
    physics = jax.tree.map(lambda x: np.asarray(x[:, 0]), after.physics)
    frames = env.render(physics, height=6, width=9)
    assert frames.shape == (12, 6, 9, 3) and frames.dtype == np.uint8
    np.testing.assert_array_equal(frames[:, 3, 4, 0], (50 * after.obs[:, 0, 0]).astype(int) % 256)
    assert (frames[:, :, :2] == 0).all() and len(np.unique(frames[:, 3, 4])) > 5
    monkeypatch.setattr(Walk, "render", broken)
    with pytest.raises(RenderingError, match=r"^gymnasium:Walk-v0: cannot be drawn: TypeError: "):
        env.render(physics)


MISTAKES = {
    "HalfCheeta-v5": "unknown environment 'gymnasium:HalfCheeta-v5': did you mean 'gymnasium:HalfCheetah-v5'? valid: ",
    "HalfCheetah-v1": "'gymnasium:HalfCheetah-v1': did you mean 'gymnasium:HalfCheetah-v",
    "numpy:Hoper-v5": "'gymnasium:numpy:Hoper-v5': did you mean 'gymnasium:numpy:Hopper-v5'",
    "no_such:Maze-v0": "gymnasium:no_such:Maze-v0: cannot import no_such: ModuleNotFoundError: No module",
    "Choice-v0": "gymnasium:Choice-v0: actions: got Discrete(3), expected one vector of numbers with limits",
    "Free-v0": "gymnasium:Free-v0: actions: action 0 is in [-inf, 1.0], expected finite limits",
    "Number-v0": "gymnasium:Number-v0: observations: got Discrete(4), expected a box, or boxes by name",
    "Mixed-v0": "gymnasium:Mixed-v0: observations: got Dict('a': Discrete(2)), expected a box, or boxes by name",
    "Broken-v0": "gymnasium:Broken-v0: cannot be made: OSError: no such file",
    "Endless-v0": "gymnasium:Endless-v0: expected a time limit, max_episode_steps of its registration, got none",
    "Chance-v0": "gymnasium:Chance-v0: expected a seed and actions to repeat an episode, got another observation",
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_line_and_nothing_is_written(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["--env.name", f"gymnasium:{name}", "--collect.env", ""]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert MISTAKES[name] in line
    assert not list(Path().iterdir())


@pytest.mark.parametrize(("missing", "extra"), [("gymnasium", "gym"), ("gymnasium_robotics", "robotics")])
def test_a_missing_package_is_named_with_its_extra(missing, extra, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, missing, None)
    assert main(["--env.name", "gymnasium:gymnasium_robotics:AntMaze_UMaze-v5", "--dry-run"]) == 2
    assert capsys.readouterr().err.endswith(f"pip install 'taic-jax[{extra}]'\n")


@pytest.mark.parametrize(("name", "sizes"), [("PointMaze_UMaze-v3", (8, 4)), ("AntMaze_UMaze-v5", (109, 27))])
def test_mazes_of_gymnasium_robotics(name, sizes):
    pytest.importorskip("gymnasium_robotics")
    env = make_env(f"gymnasium:gymnasium_robotics:{name}")
    _, after, _ = episodes(env, 2, 3)
    assert (env.observation_size, env.proprioceptive_size) == sizes and "success" in after.metrics
    np.testing.assert_array_equal(after.obs[0, :, -2:], after.obs[2, :, -2:])  # the goal, which stays
    assert env.proprioception == ("ant" if name.startswith("Ant") else env.name)
