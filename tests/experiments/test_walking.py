"""How flat policies walk: measures by hand, a policy whose speed is known, and what cannot be measured."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_navigate import Skater
from tiny_runs import CONFIG, with_fields
from written_runs import write_run

from taic_jax.config import PPOConfig
from taic_jax.experiments.evidence import walking
from taic_jax.options.execution import IdentityExecutor
from taic_jax.rl import ppo
from taic_jax.types import as_arrays


def test_measures_by_hand():
    """Of two ants one leaves its healthy state twice and overturns at last; it goes at 2 m/s, the other at 4."""
    unhealthy, over = np.zeros((2, 10, 2))
    unhealthy[2:4, 0] = unhealthy[6:, 0] = over[7:, 0] = 1.0
    place = 0.05 * np.arange(10.0)[:, None, None] * np.array([[[2.0, 9.0], [4.0, 9.0]]])
    place[7:, 0] = 100.0  # where it lies does not count
    told = walking.measures_of({"unhealthy": unhealthy, "upside_down": over, "place": place}, dt=0.05)
    speed = (6 * 2 + 9 * 4) / 15
    assert told == pytest.approx({"speed": speed, "unhealthy_per_1000": 100.0, "overturned_per_1000": 50.0})


def test_a_policy_walks_with_its_noise_and_without(monkeypatch):
    monkeypatch.setattr(walking, "EPISODES", 4)
    config, env, executor = as_arrays(PPOConfig(num_envs=2, hidden_sizes=(4,))), Skater(), IdentityExecutor(2)
    state = ppo.init(config, env, executor, jax.random.key(0))
    actor = jax.tree.map(jnp.zeros_like, state.params.actor)
    actor["params"]["Dense_1"]["bias"] = jnp.array([0.5, 0.0])  # three times as many m/s
    agent = ppo.as_agent(config, executor, state.replace(params=state.params.replace(actor=actor)))
    ticks = jax.device_get(walking.walk(env, agent, jax.random.key(1)))
    noisy, mean = ({name: x[i] for name, x in ticks.items()} for i in range(2))
    assert walking.measures_of(mean, env.dt) == pytest.approx(
        {"speed": 1.5, "unhealthy_per_1000": 0, "overturned_per_1000": 0}, rel=1e-3
    )
    assert np.abs(np.diff(mean["place"], n=2, axis=0)).max() < 1e-3 < np.abs(np.diff(noisy["place"], n=2, axis=0)).max()


def test_a_robot_that_cannot_fall_on_its_back_is_refused(tmp_path, capsys):
    run = write_run(tmp_path / "run", with_fields(CONFIG, env__name="half_cheetah"))
    assert walking.main([str(run), "--out", str(tmp_path / "out.csv")]) == 2
    assert "a robot that can fall on its back, as ant, got half_cheetah" in capsys.readouterr().err
    assert not (tmp_path / "out.csv").exists()
