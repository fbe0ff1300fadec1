"""Robots that go where they should, and the contacts of the ant's body."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from taic_jax.envs import UnknownNameError, make_env
from taic_jax.envs.arenas import FENCE
from taic_jax.envs.headings import FAR, HOLD
from taic_jax.envs.orientation import heading, turned, unit

KEYS = jax.random.split(jax.random.key(0), 16)


@pytest.fixture(scope="module")
def walk():
    """States [T, B] of ants under random actions."""
    env = make_env("ant_headings", "mujoco")
    actions = jax.random.uniform(jax.random.key(1), (150, 16, 8), minval=-1.0)

    def tick(state, action):
        state = jax.vmap(env.step)(state, action)
        return state, state

    first = jax.jit(jax.vmap(env.reset))(KEYS)
    return env, actions, first, jax.jit(lambda state: jax.lax.scan(tick, state, actions)[1])(first)


def test_directions_are_near_the_x_axis_and_change_every_three_seconds(walk):
    _, _, first, states = walk
    directions = np.asarray(first.physics.directions)
    assert np.abs(directions).max() <= np.pi / 4 and directions.std() > np.pi / 8
    phase = first.physics.tick % HOLD
    assert len(set(phase.tolist())) > 4, "they turn at different times"
    seen, yaw = states.obs[..., 27:29], jax.vmap(jax.vmap(heading))(states.physics.qpos[..., 3:7])
    angle = jnp.arctan2(seen[..., 1], seen[..., 0]) + yaw
    changes = np.abs(np.diff(np.unwrap(angle, axis=0), axis=0)) > 1e-3
    where = np.arange(2, 151)[:, None] + np.asarray(phase)
    np.testing.assert_array_equal(changes, where % HOLD == 0)


def test_the_reward_is_of_the_speed_along_the_direction_by_hand(walk):
    _, actions, first, states = walk
    before = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b[:-1]]), first, states)
    velocity = (states.physics.qpos[..., :2] - before.physics.qpos[..., :2]) / 0.05
    tick = before.physics.tick
    angle = jnp.take_along_axis(before.physics.directions, tick[..., None] // HOLD, axis=-1)[..., 0]
    along = velocity[..., 0] * jnp.cos(angle) + velocity[..., 1] * jnp.sin(angle)
    across = velocity[..., 1] * jnp.cos(angle) - velocity[..., 0] * jnp.sin(angle)
    _, x, y, _ = jnp.moveaxis(states.physics.qpos[..., 3:7], -1, 0)
    upright = 1 - 2 * (x**2 + y**2)
    expected = along - 0.5 * jnp.abs(across) + upright - 0.1 * jnp.sum(actions**2, axis=-1)
    np.testing.assert_allclose(states.reward, expected, atol=1e-3)
    np.testing.assert_array_equal(states.terminated, upright < 0)
    assert states.terminated.any() and not states.terminated[0].any()


def test_direction_and_velocity_are_seen_from_the_heading(walk):
    env, _, first, _ = walk
    assert env.observation_size == 31 and env.proprioceptive_size == 27
    state = jax.tree.map(lambda x: x[0], first)
    for yaw in (0.0, 1.0, -2.5):
        qpos = state.physics.qpos.at[3:7].set(jnp.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]))
        qvel = state.physics.qvel.at[:2].set(3 * unit(jnp.float32(yaw)))
        obs = env.env._observe(state.physics.replace(qpos=qpos, qvel=qvel))
        direction = unit(state.physics.directions[state.physics.tick // HOLD])
        np.testing.assert_allclose(obs[27:29], turned(direction, jnp.float32(-yaw)), atol=1e-5)
        np.testing.assert_allclose(obs[29:], [3, 0], atol=1e-5)


def test_a_fence_goes_with_the_ant_in_half_of_the_episodes(walk):
    """Without one it is out of reach; torsos stay inside, whose legs keep them off the sides."""
    _, _, first, states = walk
    fenced, fence = np.asarray(first.physics.qpos[:, 15]) == 0.0, states.physics.qpos[..., 15:]
    assert 4 <= fenced.sum() <= 12
    aside = np.abs(states.physics.qpos[..., :2] - fence)
    assert aside[:, fenced].max() < FENCE < np.abs(states.physics.qpos[:, fenced, :2]).max() + 1.0
    assert np.abs(fence[-1, fenced]).max() > 0.2, "pushed"
    np.testing.assert_array_equal(fence[:, ~fenced], FAR)


def test_the_fence_hides_nothing(walk):
    env, _, first, _ = walk
    fenced = int(np.argmax(np.asarray(first.physics.qpos[:, 15]) == 0.0))
    (frame,) = env.render(jax.tree.map(lambda x: x[fenced : fenced + 1], first.physics), height=60, width=80)
    assert frame.std(axis=(0, 1)).min() > 15, "one colour: the camera stands outside the fence"


def test_the_cheetah_is_paid_for_going_forward_or_backward_as_it_is_told():
    """Its reward is half_cheetah's, with the sign of the speed that the observation's last entry has."""
    env, plain = make_env("half_cheetah_headings", "mujoco"), make_env("half_cheetah", "mujoco")
    assert (env.observation_size, env.proprioceptive_size, env.proprioception) == (18, 17, "half_cheetah")
    actions = jax.random.uniform(jax.random.key(1), (130, 16, 6), minval=-1.0)
    state, step = jax.jit(jax.vmap(env.reset))(KEYS), jax.jit(jax.vmap(env.step))
    judge, seen = jax.jit(jax.vmap(plain.env._judge)), []
    for action in actions:
        sign, before = np.asarray(state.obs[:, 17]), state.physics
        np.testing.assert_array_equal(state.obs[:, :17], jax.vmap(plain.env._observe)(before))
        state = step(state, action)
        speed = np.asarray(state.physics.qpos[:, 0] - before.qpos[:, 0]) / env.dt
        expected = judge(before, state.physics, action)[0] + (sign - 1) * speed
        np.testing.assert_allclose(state.reward, expected, atol=1e-4)
        seen.append(sign)
    changes = np.diff(seen, axis=0) != 0
    assert set(np.unique(seen)) == {-1.0, 1.0} and 8 < changes.sum() < 32, "two draws in 130 ticks, half of them new"


def test_the_body_on_open_ground_moves_as_in_the_arenas():
    """The same state and actions, on the floor: only feet differ, by more than 0.1 m after 20 ticks."""
    actions, places = jax.random.uniform(jax.random.key(2), (20, 8), minval=-1.0), {}
    low = jax.jit(make_env("ant", "mujoco", contacts="body").reset)(KEYS[0])
    for name, options in (("ant", {"contacts": "body"}), ("ant", {}), ("ant_maze", {}), ("ant_headings", {})):
        env = make_env(name, "mujoco", **options)
        state, step = jax.jit(env.reset)(KEYS[0]), jax.jit(env.step)
        qpos = low.physics.qpos.at[2].set(0.3).at[7:].set(0.0)  # the belly touches the ground
        qpos, qvel = state.physics.qpos.at[:15].set(qpos), state.physics.qvel.at[:14].set(low.physics.qvel)
        state = state.replace(physics=state.physics.replace(qpos=qpos, qvel=qvel))
        for action in actions:
            state = step(state, action)
        places[name, bool(options)] = np.asarray(state.physics.qpos[:3])
    body = places["ant", True]
    np.testing.assert_allclose(places["ant_maze", False], body, atol=2e-2)
    np.testing.assert_allclose(places["ant_headings", False], body, atol=2e-2)
    assert np.linalg.norm(places["ant", False] - body) > 0.1


def test_unknown_contacts_are_refused():
    with pytest.raises(UnknownNameError, match="contacts"):
        make_env("ant", "mujoco", contacts="feat")
