"""What `check_contract` lets through and what it refuses, each breach by its field and in one line."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from taic_jax.envs import AutoReset, Env, State, TimeLimit, make_env
from taic_jax.envs.contract import check_contract
from taic_jax.envs.errors import ContractError


class Sound(Env):
    """A task that keeps the contract, but for what is changed: attributes, or fields of what a method returns."""

    name, observation_size, action_size, proprioceptive_size, episode_length, dt = "sound", 3, 2, 2, 9, 0.5

    def __init__(self, reset=None, step=None, restart=None, **attributes):
        self.changes = {"reset": reset or {}, "step": step or {}, "restart": restart or {}}
        vars(self).update(attributes)

    def reset(self, key):
        return self._state("reset", jax.random.uniform(key, (3,)))

    def restart(self, key, ended):
        return self._state("restart", jnp.zeros_like(ended))

    def step(self, state, action):
        return self._state("step", state.obs + jnp.concatenate([action, jnp.zeros(1)])).replace(tick=state.tick)

    def _state(self, method, obs):
        no, zero = jnp.zeros((), bool), jnp.zeros(())
        state = State(obs, obs, zero, terminated=no, truncated=no, metrics={"a": zero, "b": zero})
        return state.replace(**self.changes[method])

    def render(self, physics, *, height=240, width=320):
        raise NotImplementedError


class Bare(Env):
    """A task without the attributes."""

    name = "bare"
    reset = step = render = Sound.render


class Impure(Sound):
    def step(self, state, action):
        return state if state.reward > 0 else super().step(state, action)


ZERO, WEAK = jnp.zeros(()), jnp.asarray(0.0)  # the second is weakly typed
HALF = np.zeros((), np.float16)
LONG = {"obs": jnp.zeros(4)}
MANY = {"metrics": {"a": jnp.zeros(2)}}

BREACHES = {
    "sound: metrics: step returns {'a'}, reset returns {'a', 'b'}": Sound(step={"metrics": {"a": ZERO}}),
    "sound: metrics: restart returns {}, reset returns {'a', 'b'}": Sound(restart={"metrics": {}}),
    "sound: metrics: reset returns tuple, expected dict": Sound(reset={"metrics": (ZERO,)}),
    "sound: metrics['a']: reset returns float32[2], expected float32[]": Sound(reset=MANY, step=MANY),
    "sound: metrics['b']: step returns float32[] (weakly typed), reset returns float32[]": Sound(
        step={"metrics": {"a": ZERO, "b": WEAK}}
    ),
    "sound: physics: step returns int32[3], reset returns float32[3]": Sound(step={"physics": jnp.zeros(3, int)}),
    "sound: physics: step returns float32[2], reset returns float32[3]": Sound(step={"physics": jnp.zeros(2)}),
    "sound: physics: step returns nothing, reset returns float32[3]": Sound(step={"physics": (jnp.zeros(3),)}),
    "sound: physics: restart returns int32[3], reset returns float32[3]": Sound(restart={"physics": jnp.zeros(3, int)}),
    "sound: physics: step returns another kind of tree than reset": Sound(
        reset={"physics": (jnp.zeros(3),)}, step={"physics": [jnp.zeros(3)]}
    ),
    "sound: obs: reset returns float32[4], expected float32[3]": Sound(reset=LONG, step=LONG),
    "sound: obs: step returns float32[3,1], expected float32[3]": Sound(step={"obs": jnp.zeros((3, 1))}),
    "sound: obs: step returns int32[3], expected float32[3]": Sound(step={"obs": jnp.zeros(3, int)}),
    "sound: obs: step returns dict, expected float32[3]": Sound(step={"obs": {"state": jnp.zeros(3)}}),
    "sound: reward: step returns float16[], expected float32[]": Sound(step={"reward": HALF}),
    "sound: reward: step returns float32[1], expected float32[]": Sound(step={"reward": jnp.zeros(1)}),
    "sound: reward: step returns nothing, expected float32[]": Sound(step={"reward": None}),
    "sound: terminated: step returns float32[], expected bool[]": Sound(step={"terminated": ZERO}),
    "sound: truncated: reset returns int32[], expected bool[]": Sound(reset={"truncated": jnp.zeros((), int)}),
    "sound: proprioceptive_size: got 4, expected at most observation_size, 3": Sound(proprioceptive_size=4),
    "sound: proprioceptive_size: got 0, expected an integer of at least 1": Sound(proprioceptive_size=0),
    "sound: action_size: got 2.0, expected an integer of at least 1": Sound(action_size=2.0),
    "sound: action_size: got True, expected an integer of at least 1": Sound(action_size=True),
    "sound: episode_length: got 0, expected an integer of at least 1": Sound(episode_length=0),
    "sound: observation_size: got None, expected an integer of at least 1": Sound(observation_size=None),
    "sound: dt: got 0, expected a positive number of seconds": Sound(dt=0),
    "sound: dt: got 'fast', expected a positive number of seconds": Sound(dt="fast"),
    "sound: dt: got nan, expected a positive number of seconds": Sound(dt=float("nan")),
    "sound: discrete: got 1, expected True or False": Sound(discrete=1),
    "Sound: name: got '', expected a string": Sound(name=""),
    "bare: observation_size: is missing": Bare(),
}


@pytest.mark.parametrize("limited", [False, True], ids=["bare", "in TimeLimit"])
@pytest.mark.parametrize("message", BREACHES)
def test_a_breach_is_told_in_one_line(message, limited):
    env = BREACHES[message]
    with pytest.raises(ContractError) as caught:
        check_contract(TimeLimit(env, 5) if limited else env)
    assert str(caught.value) == message


def test_methods_must_be_callable_and_return_a_state(monkeypatch):
    monkeypatch.setattr(Sound, "render", 3)
    with pytest.raises(ContractError, match=r"^sound: render: got 3, expected a method$"):
        check_contract(Sound())
    monkeypatch.setattr(Sound, "render", Env.render)
    monkeypatch.setattr(Sound, "reset", lambda self, key: jnp.zeros(3))
    with pytest.raises(ContractError, match=r"^sound: reset: returns ShapeDtypeStruct, expected State$"):
        check_contract(Sound())


def test_the_time_limit_counts_as_the_episodes_length():
    with pytest.raises(ContractError, match=r"^sound: episode_length: got 0, expected an integer of at least 1$"):
        check_contract(TimeLimit(Sound(), 0))


def test_what_cannot_be_traced_is_told_with_its_line():
    with pytest.raises(ContractError) as caught:
        check_contract(Impure())
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("sound: step: cannot be traced by JAX: TracerBoolConversionError: ")
    source = Impure.step.__code__
    assert str(caught.value).endswith(f" (line {source.co_firstlineno + 1} of {source.co_filename})")


@pytest.mark.parametrize("name", ["nav2d", "nav2d_random", "four_rooms", "half_cheetah", "ant", "brax:fast"])
def test_our_own_and_braxs_tasks_keep_the_contract(name):
    env = make_env(name, "auto" if name.startswith("brax") else "mujoco")
    check_contract(env)
    check_contract(env.env)
    check_contract(AutoReset(env))


class Loud(Sound):
    def __init__(self, **changes):
        super().__init__(**changes)
        self.ran = []

    def _state(self, method, obs):
        jax.debug.callback(lambda: self.ran.append(method))
        return super()._state(method, obs)


def test_nothing_is_run():
    """Besides, numbers of NumPy are numbers too."""
    env = Loud(observation_size=np.int64(3), dt=np.float32(0.5))
    check_contract(env)
    jax.effects_barrier()
    assert env.ran == []
    env.reset(jax.random.key(0))
    jax.effects_barrier()
    assert env.ran == ["reset"]
