"""Every environment that has a name keeps the contract of tasks and wrappers; options and mistakes."""

import dataclasses
import functools
import importlib.util
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from taic_jax import envs
from taic_jax.config import EnvConfig
from taic_jax.envs import AutoReset, TimeLimit, make_env
from taic_jax.envs.errors import BackendError
from taic_jax.envs.physics import BACKENDS, mjx
from taic_jax.envs.robots import BODIES, ROBOTS
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
        if name in ("nav2d", "brax:fast", "four_rooms"):
            pytest.skip("this task starts in one place, or in one of few")
        _, first, _, states = random_run(name)
        starts = states.obs[states.terminated | states.truncated]
        starts = np.concatenate([starts, np.asarray(first.obs).reshape(-1, starts.shape[-1])])
        assert len(starts) >= 4 * SEEDS * ENVS
        assert len(np.unique(starts, axis=0)) == len(starts)


@pytest.mark.parametrize(
    ("given", "hint"),
    [
        ({"name": "half_cheeta"}, "unknown environment 'half_cheeta': did you mean 'half_cheetah'?"),
        ({"name": "four_room"}, "unknown environment 'four_room': did you mean 'four_rooms'?"),
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
            {"name": "ant_headings", "goal": "uniform"},
            "env.goal: ant_headings has no such option, got 'uniform'; its options: body",
        ),
        ({"name": "ant_turn", "body": "hiro"}, "env.body: ant_turn has no such option, got 'hiro'; its options: none"),
        (
            {"name": "ant", "boddy": "gym"},
            "env.boddy: ant has no such option, got 'gym'; its options: model, body, contacts",
        ),
    ],
)
def test_an_option_of_another_task_is_refused(given, says):
    with pytest.raises(envs.EnvOptionError) as error:
        make_env(**given)
    assert str(error.value) == says
    assert set(given) - {"name"} <= {"model", "goal", "body", "boddy"} - set(envs.environment_options(given["name"]))


def test_the_config_has_the_options_of_make_env_with_their_defaults():
    own = {"name": "nav2d", "backend": "auto", "num_threads": 0}
    assert dataclasses.asdict(EnvConfig()) == own | envs.DEFAULTS
    choices = {name: get_args(kind) for name, kind in get_type_hints(EnvConfig).items()}
    assert (choices["backend"], choices["model"], choices["body"]) == (BACKENDS, tuple(ROBOTS), BODIES)


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


def test_the_folder_cannot_be_imported_under_its_own_name():
    root = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", "import envs"], cwd=root, capture_output=True, text=True)
    assert done.returncode != 0 and "import it by that name" in done.stderr
