"""Whether codes steer: a task on which an option is the way it leads, ways whose measures are known, and real ants."""

import csv

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import NO, YES, Probe, Repeat
from tiny_runs import CONFIG, with_fields
from written_runs import write_options, write_run

from taic_jax.envs import State
from taic_jax.envs.base import PhysicsState
from taic_jax.experiments.evidence import navigate, steering


class Sliding(Probe):
    """A body on its back that each action moves over the ground, and that falls at every tick."""

    observation_size = proprioceptive_size = action_size = 2
    dt = 0.05

    def reset(self, key: jax.Array) -> State:
        place = jnp.zeros(7).at[:2].set(jax.random.normal(key, (2,))).at[4].set(1.0)
        physics = PhysicsState(place, jnp.zeros(6), jnp.zeros(6))
        return State(physics, place[:2], jnp.zeros(()), terminated=NO, truncated=NO, metrics={})

    def step(self, state: State, action: jax.Array) -> State:
        place = state.physics.qpos.at[:2].add(action)
        return state.replace(physics=state.physics.replace(qpos=place), obs=place[:2], terminated=YES)


def test_codes_that_are_ways_are_measured_as_such():
    ways = jax.device_get(steering.walk(Sliding(), Repeat(50, option_size=2), jax.random.key(0)))
    assert ways["before"].shape == (steering.CODES, steering.STARTS, 2)
    np.testing.assert_allclose(ways["same"], ways["before"], atol=1e-3)
    assert (np.abs(ways["before"]).max(axis=-1) > 0.1).all() and np.abs(ways["before"]).max() <= 60 + 1e-3
    told = steering.measure(ways)
    assert told["turned_when_kept"] == 0 and told["upside_down"] == 1 and told["agreement"] == pytest.approx(1)
    # Three of four directions are further than 45 degrees from another, and as many from ahead.
    assert 0.6 < told["turned_when_changed"] < 0.9 and 0.1 < told["ahead"] < 0.4


def test_measures_of_ways_that_are_known():
    """Of two codes from two starts: the one goes 2 m ahead, the other 1 m to the left and 1 m to the right."""
    before = np.array([[[2.0, 0.0], [2.0, 0.0]], [[0.0, 1.0], [0.0, -1.0]]])
    same, changed = np.array([[0.0, 1.0], [1.0, 0.9]]), np.array([[-1.0, 0.0], [0.0, -1.0]])
    ways = {"before": before, "same": np.stack([same, same]), "changed": np.stack([changed, changed])}
    told = steering.measure(ways | {"over": np.array([[True, False], [False, False]])})
    assert told == pytest.approx(
        {
            "distance": 1.5,
            "ahead": 0.5,
            "turned_when_kept": 0.5,  # by 90 and 42 degrees, then 0 and 132
            "turned_when_changed": 0.75,  # by 180 and 90, then 90 and 0
            "agreement": 0.5,
            "upside_down": 0.25,
        }
    )


def test_options_of_real_ants_are_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(steering, "CODES", 3)
    monkeypatch.setattr(steering, "SECONDS", 0.3)
    config = with_fields(CONFIG, env__name="ant")
    run, out = write_run(tmp_path / "ant" / "tiny", config), tmp_path / "steering.csv"
    write_options(run, config, experience=False)
    assert steering.main([str(run), "--out", str(out)]) == 0
    with out.open() as file:
        rows = {row["measure"]: row for row in csv.DictReader(file)}
    assert {(row["run"], row["seeds"], row["length"]) for row in rows.values()} == {("ant/tiny", "2", "2")}
    # In 0.3 s under actions at random it gets somewhere, but not far.
    assert all(0.001 < float(x) < 1 for x in rows["distance"]["per_seed"].split())
    assert float(rows["upside_down"]["iqm"]) < 0.2


def test_ants_are_led_through_all_arenas(tmp_path, monkeypatch):
    for name, value in {"CODES": 3, "STARTS": 2, "SECONDS": 0.3, "WARM_UP": 0.1, "EPISODES": 2}.items():
        monkeypatch.setattr(navigate, name, value)
    config = with_fields(CONFIG, env__name="ant")
    run, out, picture = write_run(tmp_path / "run", config), tmp_path / "ways.csv", tmp_path / "ways.png"
    write_options(run, config, experience=False)
    assert steering.main([str(run), "--out", str(out), "--navigate", "--picture", str(picture)]) == 0
    with out.open() as file:
        rows = {(row["run"], row["measure"]): row for row in csv.DictReader(file)}
    measured = {name.partition("/")[0] for run, name in rows if run.endswith("/run")}
    assert measured == {"codes", "ant_maze", "ant_push", "ant_fall"} and picture.stat().st_size > 5000
    stand, went = (float(rows[x, "ant_maze/final_distance"]["iqm"]) for x in ("stand", f"{tmp_path.name}/run"))
    assert stand == 16 and abs(went - 16) < 4  # actions at random lead nowhere
    assert all(len(row["per_seed"].split()) == 2 for (run, _), row in rows.items() if run.endswith("/run"))


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("half_cheetah", True, "expected options of a robot that walks in every direction, as ant, got half_cheetah"),
        ("nav2d", True, "expected options of a robot that walks in every direction, as ant, got nav2d"),
        ("ant", False, "expected a run that got this far, or its option model; got none"),
    ],
)
def test_what_cannot_be_steered_is_refused(task, options, message, tmp_path, capsys):
    config = with_fields(CONFIG, env__name=task)
    run = write_run(tmp_path / "run", config)
    if options:
        write_options(run, config, experience=False)
    assert steering.main([str(run), "--out", str(tmp_path / "steering.csv")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "steering.csv").exists()


def test_no_run_is_refused(tmp_path, capsys):
    assert steering.main(["--out", str(tmp_path / "steering.csv")]) == 2
    assert "expected the folder of at least one run, got none" in capsys.readouterr().err
    assert not (tmp_path / "steering.csv").exists()
