"""The gate: codes whose ways are known, a navigator that they lead through an arena, and its measures by hand."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from probes import NO, Probe, Repeat

from taic_jax.analysis.option_space import execute
from taic_jax.envs import State
from taic_jax.envs.arenas import FALL, MAZE, PUSH
from taic_jax.envs.base import Heading, PhysicsState
from taic_jax.envs.navigation import inside
from taic_jax.experiments.evidence import navigate, ways
from taic_jax.experiments.evidence.navigate import Compass
from taic_jax.options.frame import Frame
from taic_jax.rl.rollout import Rollout

TURNED = 2.5  # rad, yaw of the skaters
HEADING = Heading(quaternion=1, velocity=5, dt=0.05)


class Skater(Probe):
    """A body that faces `TURNED` and moves as its action says: in the world, or seen from its heading."""

    observation_size, proprioceptive_size, action_size = 9, 7, 2
    dt, heading, episode_length = 0.05, HEADING, 1000
    arena = MAZE

    def __init__(self, seen_from_heading: bool = False, walls: Any = ()):
        self.turns, self.walls = seen_from_heading, jnp.array(walls, jnp.float32).reshape(-1, 4)

    def reset(self, key):
        qpos = jnp.zeros(7).at[3].set(np.cos(TURNED / 2)).at[6].set(np.sin(TURNED / 2))
        return self._state(PhysicsState(qpos, jnp.zeros(6), jnp.zeros(6)))

    def step(self, state, action):
        c, s = np.cos(TURNED), np.sin(TURNED)
        velocity = 3 * jnp.stack(
            [c * action[0] - s * action[1], s * action[0] + c * action[1]] if self.turns else action
        )
        place = state.physics.qpos[:2] + self.dt * velocity
        stops = inside(place, self.walls, np.ones(len(self.walls), bool))
        qpos = jnp.where(stops, state.physics.qpos, state.physics.qpos.at[:2].set(place))
        after = self._state(state.physics.replace(qpos=qpos, qvel=state.physics.qvel.at[:2].set(velocity)))
        return state.replace(physics=after.physics, obs=after.obs, metrics=after.metrics)

    def _state(self, physics):
        obs = jnp.concatenate([jnp.zeros(1), physics.qpos[3:7], physics.qvel[:2], physics.qpos[:2]])
        distance = jnp.linalg.norm(physics.qpos[:2] - jnp.array(self.arena.goal))
        metrics = {"distance": distance, "closest_approach": distance, "upside_down": jnp.zeros(())}
        return State(physics, obs, jnp.zeros(()), terminated=NO, truncated=NO, metrics=metrics)


@pytest.mark.parametrize("turns", [False, True])
def test_codes_that_are_velocities_are_measured_as_such(turns):
    frame = Frame(HEADING, turns, 0)
    compass = navigate.measure_codes(Skater(turns), Repeat(20, option_size=2), frame, jax.random.key(0))
    np.testing.assert_allclose(compass.velocity, 3 * np.clip(compass.codes, -1, 1), atol=0.05)
    np.testing.assert_allclose(compass.agreement, 1.0, atol=1e-3)
    assert not np.asarray(compass.overturned).any()
    measures = navigate.measures_of_codes(compass)
    assert measures["widest_gap"] < 30 and measures["agreement"] == pytest.approx(1, abs=1e-3)
    assert measures["speed"] == pytest.approx(
        np.median(np.linalg.norm(3 * np.clip(compass.codes, -1, 1), axis=1)), abs=0.1
    )


def test_the_widest_gap_is_between_fast_and_safe_codes():
    """Safe at 20, 110 and 170 degrees; one at 270 is slow, one at 300 overturns every second ant."""
    angle, speed = np.radians([20, 110, 170, 270, 300]), np.array([2.0, 2, 2, 0.5, 2])
    velocity = speed[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    compass = Compass(velocity, velocity, np.ones(5), np.array([0, 0, 0, 0, 0.5]))
    assert navigate.measures_of_codes(compass)["widest_gap"] == pytest.approx(210)
    assert navigate.measures_of_codes(compass._replace(velocity=0.1 * velocity))["widest_gap"] == 360


@pytest.mark.parametrize("many", [False, True])
def test_the_way_of_an_option_is_seen_from_the_heading_at_its_start(many):
    codes = jax.random.normal(jax.random.key(0), (20, 2))
    effects = execute(Skater(True), Repeat(20, option_size=2), codes, jax.random.key(1), many)
    expected = 3 * 0.05 * np.clip(codes, -1, 1)
    if many:  # the first tick goes on as the option before
        last = effects.way - 19 * expected
        assert np.abs(last).max() <= 3 * 0.05 * np.sqrt(2) + 1e-4 and np.abs(last).min(axis=1).max() > 0.01
    else:
        np.testing.assert_allclose(effects.way, 19 * expected, atol=1e-4)


@pytest.mark.parametrize("turns", [False, True])
def test_a_skater_is_led_through_the_maze(turns, monkeypatch):
    monkeypatch.setattr(navigate, "EPISODES", 3)
    monkeypatch.setattr(navigate, "CODES", 32)
    env, frame, executor = Skater(turns, MAZE.solids), Frame(HEADING, turns, 0), Repeat(20, option_size=2)
    compass = navigate.measure_codes(env, executor, frame, jax.random.key(0))
    measures = navigate.measures_of(navigate.navigate(env, executor, compass, frame, jax.random.key(1)), env.dt)
    assert measures["success"] == measures["ever"] == 1 and measures["speed"] > 1
    lost = navigate.navigate(env, executor, compass, Frame(HEADING, not turns, 0), jax.random.key(1))
    assert navigate.measures_of(lost, env.dt)["success"] == 0, "a compass read in the wrong frame leads astray"


def test_options_that_are_ways_are_given_the_way(monkeypatch):
    monkeypatch.setattr(navigate, "EPISODES", 1)
    env = Skater(walls=MAZE.solids)
    run = navigate.navigate(env, Repeat(20, option_size=2), None, None, jax.random.key(1))
    places = np.concatenate([[[0.0, 0.0]], run.extras[1][:-1, 0]])
    expected = navigate.way_of(MAZE, jnp.asarray(places, jnp.float32))
    np.testing.assert_allclose(run.option[::20, 0], expected[::20], atol=1e-5)
    assert navigate.measures_of(run, env.dt)["success"] == 1


def test_risky_codes_are_avoided(monkeypatch):
    """Of two codes straight ahead the faster one overturns every fourth ant."""
    monkeypatch.setattr(navigate, "EPISODES", 2)
    velocity = jnp.array([[1.0, 0.0], [1.5, 0.0]])
    compass = Compass(jnp.array([[0.3, 0.0], [0.5, 0.0]]), velocity, jnp.ones(2), jnp.array([0.0, 0.25]))
    run = navigate.navigate(Skater(), Repeat(20, option_size=2), compass, Frame(HEADING, False, 0), jax.random.key(0))
    np.testing.assert_allclose(run.extras[1][10, :, 0], 11 * 0.05 * 3 * 0.3, rtol=1e-4)


def test_measures_of_navigated_episodes_by_hand():
    """Of two ants one arrives and overturns at the end, after it had overturned and recovered."""
    distance = np.tile([[9.0, 9.0]], (41, 1))
    distance[-1] = 4.0, 8.0
    over = np.zeros((41, 2))
    over[5:8, 0] = over[-1, 0] = 1.0
    place = np.stack([np.linspace(0, 8, 41), np.zeros(41)], axis=-1)[:, None].repeat(2, axis=1)
    metrics = {"distance": distance, "closest_approach": distance - 4.0, "upside_down": over}
    nothing = dict.fromkeys(Rollout.__dataclass_fields__)
    told = navigate.measures_of(Rollout(**nothing | {"extras": (metrics, place)}), dt=0.05)
    assert told == pytest.approx(
        {
            "success": 0.5, "ever": 1.0, "final_distance": 6.0, "speed": 4.0,
            "overturned_per_1000": 1000 * 2 / 82, "overturned": 0.5,
        }
    )  # fmt: skip


@pytest.mark.parametrize(("arena", "stand", "walk"), [(MAZE, 16, 12), (PUSH, 19, 14.96), (FALL, 27, 15)])
def test_reference_levels(arena, stand, walk):
    """Who goes straight stops at the maze's wall, at the block, or at the chasm."""
    assert navigate.straight(arena, 0.0, 50.0) == pytest.approx(stand)
    assert navigate.straight(arena, 1.0, 50.0) == pytest.approx(walk, abs=0.1)


@pytest.mark.parametrize("arena", [MAZE, PUSH, FALL])
def test_ways_lead_from_the_start_to_the_goal_and_round_it(arena):
    """Options do not stop: at the goal they go on without a sharp turn, clear of the walls."""
    place, seen, places, ways = jnp.zeros((1, 2)), [], [], []
    for _ in range(400):
        seen.append(tuple(np.asarray(navigate.next_place(arena, place)[0]).tolist()))
        ways.append(navigate.way_of(arena, place)[0])
        np.testing.assert_allclose(np.linalg.norm(ways[-1]), 1.0, atol=1e-5)
        place = place + 0.25 * ways[-1][None]
        places.append(place[0])
    assert list(dict.fromkeys(seen)) == [to for _, to in arena.ways]
    rounds, turns = np.array(places[-100:]), np.sum(np.array(ways[-100:-1]) * np.array(ways[-99:]), axis=1)
    assert np.linalg.norm(rounds - np.array(arena.goal[:2]), axis=1).max() < 4.0
    assert turns.min() > np.cos(np.radians(20)) and np.ptp(rounds, axis=0).min() > 2.0
    low, high = np.array(arena.room).reshape(2, 2)
    assert (rounds > low + 1.0).all() and (rounds < high - 1.0).all()


def test_the_picture_has_all_panels(tmp_path):
    rng = np.random.default_rng(0)
    compass = Compass(rng.normal(size=(8, 2)), rng.normal(size=(8, 2)), np.ones(8), np.linspace(0, 0.2, 8))
    places = {"ant_maze": (MAZE, rng.normal(size=(5, 3, 2)), 0.5), "ant_push": (PUSH, rng.normal(size=(5, 3, 2)), 1.0)}
    ways.draw_navigation(compass, places, tmp_path / "ways.png")
    picture = Image.open(tmp_path / "ways.png").convert("RGB")
    assert picture.width > 2.5 * picture.height and len(np.unique(np.asarray(picture).reshape(-1, 3), axis=0)) > 20
