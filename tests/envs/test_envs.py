"""The contract of tasks and wrappers, held by every environment that has a name."""

import functools
import importlib.util
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from taic_jax import envs
from taic_jax.envs import AutoReset, Env, State, TimeLimit, make_env
from taic_jax.envs.errors import BackendError
from taic_jax.envs.physics import mjx
from taic_jax.envs.third_party import third_party

SEEDS, ENVS, TICKS, LIMIT = 2, 3, 100, 30


def nested(function):
    """Map over seeds, then over environments."""
    return jax.vmap(jax.vmap(function))


def signature(tree):
    """Return shape, dtype and weak type of every leaf: on which hangs whether a program recompiles."""
    return jax.tree.map(lambda leaf: (leaf.shape, leaf.dtype, leaf.aval.weak_type), tree)


@functools.cache
def random_run(name: str):
    """Act at random for 100 ticks with episodes of at most 30; return env, first, last and all states."""
    env = AutoReset(TimeLimit(make_env(name), LIMIT))

    def tick(state, key):
        action = jax.random.uniform(key, (SEEDS, ENVS, env.action_size), minval=-1.0)
        state = nested(env.step)(state, action)
        return state, state

    @jax.jit
    def episodes(keys_reset, keys):
        first = nested(env.reset)(keys_reset)
        return first, *jax.lax.scan(tick, first, keys)

    first, last, states = episodes(
        jax.random.split(jax.random.key(0), (SEEDS, ENVS)), jax.random.split(jax.random.key(1), TICKS)
    )
    return env, first, last, jax.tree.map(np.asarray, states.replace(key=None))


@pytest.mark.parametrize("name", [*envs.environment_names(), "brax:fast"])
class TestEveryName:
    """One random run each: jitted, vmapped over seeds and environments, with automatic resets."""

    def test_state_has_the_promised_shapes_and_dtypes(self, name):
        env, first, _, _ = random_run(name)
        assert first.obs.shape == (SEEDS, ENVS, env.observation_size)
        assert 0 < env.proprioceptive_size <= env.observation_size
        assert env.name == name and env.dt > 0 and env.episode_length == LIMIT
        assert make_env(name).episode_length in (200, 1000)
        for leaf in (first.obs, first.reward, *first.metrics.values()):
            assert leaf.dtype == jnp.float32
        assert first.terminated.dtype == first.truncated.dtype == bool and first.tick.dtype == jnp.int32
        assert not first.terminated.any() and not first.truncated.any()

    def test_step_keeps_what_reset_made(self, name):
        _, first, last, _ = random_run(name)
        assert signature(first) == signature(last)

    def test_nothing_is_nan(self, name):
        *_, states = random_run(name)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(states))

    def test_episodes_end_in_time_and_count_from_zero(self, name):
        *_, states = random_run(name)
        ended = states.terminated | states.truncated
        assert states.truncated.any() and (states.tick[ended] == 0).all()
        tick = np.concatenate([np.zeros_like(states.tick[:1]), states.tick])
        np.testing.assert_array_equal(tick[1:][~ended], (tick[:-1] + 1)[~ended])
        assert states.tick.max() == LIMIT - 1

    def test_final_obs_is_obs_where_nothing_ended(self, name):
        *_, states = random_run(name)
        ended = states.terminated | states.truncated
        np.testing.assert_array_equal(states.final_obs[~ended], states.obs[~ended])

    def test_episodes_start_anew(self, name):
        if name in ("nav2d", "brax:fast"):
            pytest.skip("this task always starts in one place")
        _, first, _, states = random_run(name)
        starts = states.obs[states.terminated | states.truncated]
        starts = np.concatenate([starts, np.asarray(first.obs).reshape(-1, starts.shape[-1])])
        assert len(starts) >= 4 * SEEDS * ENVS
        assert len(np.unique(starts, axis=0)) == len(starts)


class Clock(Env):
    """A task that ends after `lifetime` ticks and starts at a random phase."""

    name, observation_size, action_size, proprioceptive_size, episode_length, dt = "clock", 2, 1, 2, 99, 1.0

    def __init__(self, lifetime: int):
        self.lifetime = lifetime

    def reset(self, key):
        obs = jnp.stack([jnp.zeros(()), jax.random.uniform(key)])
        no = jnp.zeros((), bool)
        return State(obs, obs, jnp.zeros(()), terminated=no, truncated=no, metrics={"age": obs[0]})

    def step(self, state, action):
        obs = state.obs + jnp.array([1.0, 0.0])
        return state.replace(
            physics=obs,
            obs=obs,
            reward=obs[0] + action[0],
            terminated=obs[0] >= self.lifetime,
            truncated=jnp.zeros((), bool),
            metrics={"age": obs[0]},
        )

    def render(self, physics, *, height=240, width=320):
        raise NotImplementedError


def run(env: Env, ticks: int) -> list[State]:
    """Return the states after reset and after each tick without action."""
    step, states = jax.jit(env.step), [jax.jit(env.reset)(jax.random.key(0))]
    for _ in range(ticks):
        states.append(step(states[-1], jnp.zeros(1)))
    return states


@pytest.mark.parametrize(
    ("lifetime", "limit", "terminated", "truncated"),
    [(3, 5, True, False), (5, 3, False, True), (3, 3, True, True), (5, 5, False, False)],
)
def test_time_limit_tells_truncated_from_terminated(lifetime, limit, terminated, truncated):
    *before, last = run(TimeLimit(Clock(lifetime), limit), 3)
    assert (bool(last.terminated), bool(last.truncated)) == (terminated, truncated)
    assert not any(state.terminated or state.truncated for state in before)
    assert int(last.tick) == 3


def test_auto_reset_keeps_the_finished_tick_and_starts_from_a_fresh_key():
    states = run(AutoReset(TimeLimit(Clock(3), 10)), 6)
    for end in (states[3], states[6]):
        assert end.terminated and not end.truncated
        assert end.reward == 3.0 and end.metrics["age"] == 3.0 and end.final_obs[0] == 3.0
        assert end.obs[0] == end.physics[0] == 0.0 and end.tick == 0
    assert states[2].tick == 2 and states[4].tick == 1 and not states[4].terminated
    phases = [float(state.obs[1]) for state in states]
    assert phases[0] == phases[2] == float(states[3].final_obs[1]), "the phase stays for an episode"
    assert len({phases[0], phases[3], phases[6]}) == 3, "and is drawn anew for the next"


def test_auto_reset_resets_only_what_ended():
    env = AutoReset(TimeLimit(Clock(100), 4))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 3))
    state = state.replace(tick=jnp.array([3, 0, 3]), obs=state.obs.at[:, 0].set(50.0))
    after = jax.jit(jax.vmap(env.step))(state, jnp.zeros((3, 1)))
    np.testing.assert_array_equal(after.truncated, [True, False, True])
    np.testing.assert_array_equal(after.obs[:, 0], [0.0, 51.0, 0.0])
    np.testing.assert_array_equal(after.final_obs[:, 0], [51.0] * 3)
    assert after.obs[1, 1] == state.obs[1, 1]
    assert after.obs[0, 1] != state.obs[0, 1] and after.obs[2, 1] != state.obs[2, 1]


def test_auto_reset_computes_no_reset_while_nothing_ends():
    """The reset stays behind a condition on the whole batch, however deep the vmap."""
    env = AutoReset(TimeLimit(Clock(3), 10))
    state = jax.eval_shape(nested(env.reset), jax.random.split(jax.random.key(0), (SEEDS, ENVS)))
    program = jax.jit(nested(env.step)).lower(state, jnp.zeros((SEEDS, ENVS, 1))).as_text()
    assert "stablehlo.case" in program or "stablehlo.if" in program


def five_ticks(key):
    """Return the observations of five ticks with episodes of two."""
    env = AutoReset(TimeLimit(Clock(2), 10))

    def tick(state, _):
        state = env.step(state, jnp.zeros(1))
        return state, state.obs

    return jax.lax.scan(tick, env.reset(key), length=5)[1]


def test_auto_reset_is_the_same_under_vmap_and_alone():
    keys = jax.random.split(jax.random.key(0), 3)
    batched, alone = jax.jit(jax.vmap(five_ticks))(keys), jax.jit(five_ticks)
    np.testing.assert_array_equal(batched, np.stack([alone(key) for key in keys]))


@pytest.mark.parametrize(
    ("given", "hint"),
    [
        ({"name": "half_cheeta"}, "unknown environment 'half_cheeta': did you mean 'half_cheetah'?"),
        ({"name": "brax:reecher"}, "unknown environment 'brax:reecher': did you mean 'brax:reacher'?"),
        ({"name": "ant", "backend": "mujocco"}, "unknown backend 'mujocco': did you mean 'mujoco'?"),
        ({"name": "nav2d", "backend": "mjxx"}, "unknown backend 'mjxx': did you mean 'mjx'?"),
        ({"name": "hopper", "model": "gymn"}, "unknown model 'gymn': did you mean 'gym'?"),
        ({"name": "brax:ant", "pipeline": "sprint"}, "unknown pipeline 'sprint': did you mean 'spring'?"),
    ],
)
def test_a_wrong_name_gets_one_line_with_the_nearest(given, hint):
    with pytest.raises(envs.UnknownNameError) as error:
        make_env(**given)
    assert str(error.value).startswith(hint) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        (
            {"name": "nav2d", "model": "gym"},
            "env.model: nav2d has no such option, got 'gym'; its options: change_after",
        ),
        (
            {"name": "ant_push", "goal": "uniform"},
            "env.goal: ant_push has no such option, got 'uniform'; its options: body",
        ),
        ({"name": "ant_turn", "body": "hiro"}, "env.body: ant_turn has no such option, got 'hiro'; its options: none"),
    ],
)
def test_an_option_of_another_task_is_refused(given, says):
    with pytest.raises(envs.EnvOptionError) as error:
        make_env(**given)
    assert str(error.value) == says
    assert set(given) - {"name"} <= {"model", "goal", "body"} - set(envs.environment_options(given["name"]))


def test_warp_says_what_it_needs(monkeypatch):
    find_spec = importlib.util.find_spec
    installed = {"warp": None}
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: installed.get(name, find_spec("numpy")))
    with pytest.raises(envs.MissingExtraError, match=r"pip install 'taic-jax\[warp\]'"):
        mjx._require_warp()
    installed["warp"] = find_spec("numpy")
    with pytest.raises(BackendError, match=r"env.backend: warp needs an NVIDIA GPU, and JAX runs on cpu; .* mjx$"):
        mjx._require_warp()
    monkeypatch.undo()
    with pytest.raises((envs.MissingExtraError, BackendError)):
        make_env("ant", "warp")


def test_what_mjx_writes_is_dropped(capsys):
    with third_party():
        sys.stdout.write("Warp greets\n")
    print("ours")
    assert capsys.readouterr().out == "ours\n"


def test_gyms_models_need_gymnasium(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(envs.MissingExtraError, match=r"gymnasium is not installed: pip install 'taic-jax\[gym\]'"):
        make_env("hopper", model="gym")


class Lazy(Clock):
    """A task that sets `terminated` and `truncated` only when it ends; `TimeLimit` clears them before."""

    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(terminated=state.terminated | after.terminated, truncated=state.truncated)


def test_an_end_does_not_last_into_the_next_episode():
    states = run(AutoReset(TimeLimit(Lazy(99), 3)), 7)
    assert [bool(state.truncated) for state in states] == [False, False, False, True, False, False, True, False]


def test_the_folder_cannot_be_imported_under_its_own_name():
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", "import envs"], cwd=root, capture_output=True, text=True)
    assert done.returncode != 0 and "import it by that name" in done.stderr
