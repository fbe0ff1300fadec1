"""Brax's and Playground's environments behind our contract, and ours behind Brax's."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

# First, because it chooses how MuJoCo draws.
from taic_jax.envs import AutoReset, RenderingError, TimeLimit, UnknownNameError, Wrapper, make_env

# isort: split
import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from brax import envs as brax_envs
from ml_collections import ConfigDict

from taic_jax.envs.adapters import BraxEnv, PlaygroundEnv, to_brax
from taic_jax.envs.adapters.admission import require_task, require_vector_actions
from taic_jax.envs.adapters.foreign import ForeignPhysics
from taic_jax.envs.contract import check_contract
from taic_jax.envs.errors import AdapterError, MissingExtraError
from taic_jax.envs.third_party import third_party

ROOT = Path(__file__).parents[2]


def test_adapter_is_braxs_own_step():
    """Ten ticks of the inverted pendulum, which falls on the way; both in one program, to compile once."""
    env = make_env("brax:inverted_pendulum")
    with third_party():
        theirs = brax_envs.get_environment("inverted_pendulum", backend="spring")
    actions = jnp.array([-1.0, *[1.0] * 9])[:, None]

    def our_episode(key):
        return jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, env.reset(key), actions)[1]

    def their_episode(key):
        with third_party():
            return jax.lax.scan(lambda s, a: (theirs.step(s, a),) * 2, theirs.reset(key), actions)[1]

    ours, expected = jax.jit(lambda key: (our_episode(key), their_episode(key)))(jax.random.key(0))
    np.testing.assert_array_equal(ours.obs, expected.obs)
    np.testing.assert_array_equal(ours.reward, expected.reward)
    np.testing.assert_array_equal(ours.terminated, expected.done.astype(bool))
    np.testing.assert_array_equal(ours.physics.simulation.q, expected.pipeline_state.q)
    assert ours.terminated.any() and not ours.truncated.any()
    assert env.episode_length == 1000 and env.dt == 0.02


def test_step_keeps_what_reset_made():
    """Brax's pendulum itself does not: its step makes a weakly typed number, which would compile twice."""
    env = make_env("brax:inverted_pendulum").env
    state = jax.eval_shape(env.reset, jax.random.key(0)).replace(tick=jax.ShapeDtypeStruct((), jnp.int32))
    after = jax.eval_shape(env.step, state, jax.ShapeDtypeStruct((1,), jnp.float32))
    assert jax.tree.structure(after) == jax.tree.structure(state)
    for one, other in zip(jax.tree.leaves(state), jax.tree.leaves(after), strict=True):
        assert (one.shape, one.dtype, one.weak_type) == (other.shape, other.dtype, other.weak_type)


def test_time_limit_is_ours():
    env = AutoReset(TimeLimit(make_env("brax:fast"), 3))
    step, state = jax.jit(env.step), env.reset(jax.random.key(0))
    for tick in range(1, 7):
        state = step(state, jnp.ones(1))
        assert bool(state.truncated) == (tick % 3 == 0) and not state.terminated


def task_of(name: str, limit: int):
    """Return one of our tasks with a short time limit."""
    return TimeLimit(make_env(name, "mujoco"), limit)


@pytest.mark.parametrize(("name", "limit", "ticks"), [("nav2d", 45, 50), ("half_cheetah", 6, 6)])
def test_braxs_wrappers_give_our_rewards(name, limit, ticks):
    """Tick by tick. nav2d, where all starts are one, goes on past the goal, which one copy reaches, and the limit."""
    env = task_of(name, limit)
    ours, exported = AutoReset(env), to_brax(env)
    with third_party():
        theirs = brax_envs.training.wrap(exported, episode_length=exported.episode_length)
    actions = jax.random.uniform(jax.random.key(1), (ticks, 2, env.action_size), minval=-1.0)
    actions = actions.at[:, 0].set(jnp.zeros(env.action_size).at[0].set(1.5))  # too large: it is clipped
    keys = jax.random.split(jax.random.key(0), 2)

    @jax.jit
    def our_episodes():
        step, clipped = jax.vmap(ours.step), jnp.clip(actions, -1.0, 1.0)
        return jax.lax.scan(lambda s, a: (step(s, a),) * 2, jax.vmap(ours.reset)(keys), clipped)[1]

    @jax.jit
    def their_episodes(raw_keys):
        return jax.lax.scan(lambda s, a: (theirs.step(s, a),) * 2, theirs.reset(raw_keys), actions)[1]

    expected = our_episodes()
    with third_party():
        given = their_episodes(jax.random.key_data(jax.vmap(jax.random.split)(keys)[:, 1]))
    close = {"rtol": 1e-5, "atol": 1e-6}  # two programs, which may round apart
    np.testing.assert_allclose(given.reward, expected.reward, **close)
    np.testing.assert_array_equal(given.done.astype(bool), expected.terminated | expected.truncated)
    np.testing.assert_array_equal(given.info["truncation"].astype(bool), expected.truncated & ~expected.terminated)
    going = ~np.asarray(expected.terminated | expected.truncated)
    np.testing.assert_allclose(given.obs[going], expected.obs[going], **close)
    for metric, values in expected.metrics.items():
        np.testing.assert_allclose(given.metrics[metric], values, **close)
    assert expected.truncated.any() and (name == "half_cheetah" or expected.terminated.any())


def test_a_brax_state_keeps_what_braxs_wrappers_add():
    """Its evaluation writes `reward` among the metrics; steps are repeated in a scan, which forbids to lose it."""
    with third_party():
        wrapped = brax_envs.training.wrap(to_brax(make_env("nav2d")), episode_length=9, action_repeat=2)
        wrapped = brax_envs.training.EvalWrapper(wrapped)
        state = jax.eval_shape(wrapped.reset, jax.ShapeDtypeStruct((3, 2), jnp.uint32))
        after = jax.eval_shape(wrapped.step, state, jax.ShapeDtypeStruct((3, 2), jnp.float32))
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, state)
    assert set(after.metrics) == {"distance_to_goal", "success", "reward"}


def test_brax_is_told_sizes_and_the_time_limit():
    env = to_brax(task_of("half_cheetah", 7))
    assert isinstance(env, brax_envs.Env) and env.unwrapped is env and env.backend == "taic_jax"
    assert (env.observation_size, env.action_size, env.episode_length, env.dt) == (17, 6, 7, 0.05)
    with third_party():
        typed, raw = env.reset(jax.random.key(3)), env.reset(jax.random.PRNGKey(3))
    np.testing.assert_array_equal(typed.obs, raw.obs)


class Outer(Wrapper):
    """A wrapper that is not ours."""


DISCRETE = SimpleNamespace(name="dice", action_space=gymnasium.spaces.Discrete(6))
ENDLESS = SimpleNamespace(action_space=gymnasium.spaces.Box(-np.inf, np.inf, (2,)))
REFUSALS = {
    "to_brax: nav2d is in AutoReset, expected the environment inside it": lambda: to_brax(AutoReset(make_env("nav2d"))),
    "to_brax: nav2d has its TimeLimit inside Outer, expected it outside": lambda: to_brax(Outer(make_env("nav2d"))),
    "to_brax: actions: got Discrete(6), expected one vector of numbers with limits": lambda: require_task(
        "to_brax", DISCRETE
    ),
    "to_brax: got types.SimpleNamespace, expected a taic_jax.envs.Env, as make_env returns": lambda: require_task(
        "to_brax", SimpleNamespace()
    ),
    "here: actions: action 0 is in [-inf, inf], expected finite limits": lambda: require_vector_actions(
        "here", ENDLESS
    ),
    "brax:parts: obs: got the shapes {'a': (2,)}, expected one vector [S]": lambda: BraxEnv("parts"),
    "brax:swimmer: the pipeline 'spring' does not fit: Unsupported backend: spring.": lambda: BraxEnv("swimmer"),
    "brax:dice: actions: got Discrete(6), expected one vector of numbers with limits": lambda: BraxEnv("dice"),
    "brax:free: actions: action 1 is in [-inf, 1.0], expected finite limits": lambda: BraxEnv("free"),
}


@pytest.mark.parametrize("message", REFUSALS)
def test_what_does_not_fit_is_told_in_one_line(message, monkeypatch):
    actuator = SimpleNamespace(ctrl_range=jnp.array([[-1.0, 1.0], [-jnp.inf, 1.0]]))
    free = SimpleNamespace(sys=SimpleNamespace(actuator=actuator))
    monkeypatch.setitem(brax_envs._envs, "dice", lambda backend: DISCRETE)
    monkeypatch.setitem(brax_envs._envs, "free", lambda backend: free)
    start = brax_envs.State(None, {"a": jnp.zeros(2)}, jnp.zeros(()), jnp.zeros(()))
    monkeypatch.setitem(brax_envs._envs, "parts", lambda backend: SimpleNamespace(reset=lambda key: start))
    with pytest.raises(AdapterError) as caught:
        REFUSALS[message]()
    assert str(caught.value) == message


def test_no_adapter_is_imported_before_it_is_used():
    """Brax and MJX take seconds to import, and the other two may not be installed."""
    code = """
import sys
import taic_jax.envs
taic_jax.envs.make_env("nav2d")
print([name for name in ("brax", "gymnasium", "mujoco_playground", "mujoco.mjx") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "[]\n", done.stdout + done.stderr


@pytest.fixture
def playground():
    """Give Playground's registry."""
    with third_party():
        return pytest.importorskip("mujoco_playground").registry


def test_playground_adapter_is_playgrounds_own_step(playground):
    env = PlaygroundEnv("PendulumSwingup")
    with third_party():
        theirs = playground.load("PendulumSwingup", config_overrides={"impl": "jax"})
    actions = jnp.array([[-1.0], [0.5], [1.0]])

    @jax.jit
    def our_episode(key):
        return jax.lax.scan(lambda s, a: (env.step(s, a),) * 2, env.reset(key), actions)[1]

    @jax.jit
    def their_episode(key):
        start = theirs.reset(key)
        return jax.lax.scan(lambda s, a: (s := theirs.step(s, a), s), start, actions)[1]

    ours = our_episode(jax.random.key(0))
    with third_party():
        expected = their_episode(jax.random.PRNGKey(0))
    np.testing.assert_array_equal(ours.obs, expected.obs)
    np.testing.assert_array_equal(ours.reward, expected.reward)
    np.testing.assert_array_equal(ours.terminated, expected.done.astype(bool))
    np.testing.assert_array_equal(ours.physics.simulation.qpos, expected.data.qpos)
    assert (env.name, env.action_size, env.episode_length, env.dt) == ("playground:PendulumSwingup", 1, 1000, 0.02)
    assert env.observation_size == env.proprioceptive_size == 3
    check_contract(env)


BODIES = """<mujoco><worldbody>
  <body name="target" mocap="true" pos="0 0 0.5"><geom size="0.2" rgba="1 0 0 1"/></body>
  <body><joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1"/></body>
</worldbody><actuator>{}</actuator></mujoco>"""
LIMITED, FREE = '<motor joint="slide" ctrlrange="-1 1"/>', '<motor joint="slide"/>'


def register(monkeypatch, playground, actuator: str):
    """Register an environment with observations in parts, whose every step adds 1 to each entry of them."""

    def reset(rng):
        obs = {"state": jnp.zeros(2), "privileged_state": jnp.zeros(5)}
        return playground.mjx_env.State(jnp.zeros(3), obs, jnp.zeros(()), jnp.zeros(()), {}, {"rng": rng})

    def step(state, action):
        state.info["rng"] = jax.random.split(state.info["rng"])[0]
        return state.replace(obs={name: part + 1.0 for name, part in state.obs.items()}, reward=action[0])

    model = mujoco.MjModel.from_xml_string(BODIES.format(actuator))
    made = SimpleNamespace(mj_model=model, action_size=1, dt=0.5, reset=reset, step=step)
    suite = playground.dm_control_suite
    monkeypatch.setitem(suite._envs, "Parts", lambda config, config_overrides: made)
    monkeypatch.setitem(suite._cfgs, "Parts", lambda: ConfigDict({"episode_length": 8}))


def test_of_an_observation_in_parts_the_state_is_taken(monkeypatch, playground):
    register(monkeypatch, playground, LIMITED)
    env = PlaygroundEnv("Parts")
    assert (env.observation_size, env.episode_length) == (2, 8)
    check_contract(env)
    state = env.reset(jax.random.key(0))
    for tick in range(1, 3):
        state = env.step(state, jnp.ones(1))
        np.testing.assert_array_equal(state.obs, [tick] * 2)
        np.testing.assert_array_equal(state.physics.unobserved["privileged_state"], [tick] * 5)
    assert state.physics.info["rng"].dtype == jnp.uint32


def test_playground_actions_need_limits(monkeypatch, playground):
    register(monkeypatch, playground, FREE)
    with pytest.raises(
        AdapterError, match=r"^playground:Parts: actions: action 0 is in \[-inf, inf\], expected finite"
    ):
        PlaygroundEnv("Parts")


def test_pictures_show_where_playgrounds_targets_are(monkeypatch, playground):
    register(monkeypatch, playground, LIMITED)
    places = np.zeros((3, 1, 3))
    places[2] = [[0.3, 0.0, 0.0]]
    data = SimpleNamespace(qpos=np.zeros((3, 1)), mocap_pos=places)
    try:
        frames = PlaygroundEnv("Parts").render(ForeignPhysics(data, {}, {}), height=60, width=80)
    except RenderingError as error:
        pytest.skip(str(error))
    assert frames.shape == (3, 60, 80, 3) and frames.dtype == np.uint8
    assert (frames[0] == frames[1]).all() and (frames[1] != frames[2]).any()


def test_playground_never_downloads_its_robots(monkeypatch, playground, tmp_path):
    monkeypatch.setattr(subprocess, "Popen", None)
    monkeypatch.setattr(playground.mjx_env, "MENAGERIE_PATH", tmp_path / "menagerie")
    for name in ("Go1JoystickFlatTerrain", "PandaPickCube"):
        with pytest.raises(AdapterError, match=f"^playground:{name}: needs the robots of .*mujoco_menagerie, expected"):
            PlaygroundEnv(name)
    with pytest.raises(UnknownNameError, match="'playground:CheetaRun': did you mean 'playground:CheetahRun'"):
        PlaygroundEnv("CheetaRun")


def test_without_playground_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_playground", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'taic-jax\[playground\]'$"):
        PlaygroundEnv("CheetahRun")
