"""The wrappers: time limit, automatic reset, and what any wrapper hands on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from taic_jax.envs import AutoReset, Env, State, TimeLimit, Wrapper

SEEDS, ENVS = 2, 3


def nested(function):
    """Map over seeds, then over environments."""
    return jax.vmap(jax.vmap(function))


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


class Lazy(Clock):
    """A task that sets `terminated` and `truncated` only when it ends; `TimeLimit` clears them before."""

    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(terminated=state.terminated | after.terminated, truncated=state.truncated)


def test_an_end_does_not_last_into_the_next_episode():
    states = run(AutoReset(TimeLimit(Lazy(99), 3)), 7)
    assert [bool(state.truncated) for state in states] == [False, False, False, True, False, False, True, False]


class Trained(Clock):
    """A task whose evaluation neither starts late nor ends."""

    def reset(self, key):
        state = super().reset(key)
        return state.replace(physics=state.physics + 1.0, obs=state.obs + 1.0)

    @property
    def evaluated(self):
        return Clock(99)


class Labelled(Wrapper):
    """A wrapper with a second argument."""

    def __init__(self, env, label):
        super().__init__(env)
        self.label = label


def test_evaluation_sees_every_wrapper_with_its_settings():
    trained = AutoReset(Labelled(TimeLimit(Trained(1), 3), "mine"))
    env = trained.evaluated
    assert (type(env), type(env.env), env.label, env.episode_length) == (AutoReset, Labelled, "mine", 3)
    states = run(env, 4)
    assert [float(state.obs[0]) for state in states] == [0.0, 1.0, 2.0, 0.0, 1.0]
    assert [bool(state.truncated) for state in states] == [False, False, False, True, False]
    assert run(trained, 1)[1].terminated and float(run(trained, 1)[1].obs[0]) == 1.0, "the first is as it was"
