"""A run's evaluations and experience, on a task that tells exploring from not exploring and trained from untrained."""

from pathlib import Path

import numpy as np
import pytest
from tiny_runs import CONFIG, PPO, with_fields

from taic_jax.artifacts.experience import read_experience
from taic_jax.pipeline import run_pipeline

TICKS = 5
PAID = f"""
from probes import NO, Probe


class Paid(Probe):
    name = "paid"
    episode_length = {TICKS}

    def move(self, x, action):
        return x + 1.0, action - action**2, NO, NO
"""
T, B, ITERATIONS = 15, 8, 6


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> tuple[Path, dict]:
    """Return the folder and the methods of a run whose flat policy learns to act by 1/2, as a mean of N(., 1)."""
    folder = tmp_path_factory.mktemp("paid")
    fields = {"num_envs": B, "rollout_length": T, "minibatch_size": B * T, "epochs": 4, "learning_rate": 0.1,
              "log_std_init": 0.0}  # fmt: skip
    ppo = with_fields(PPO, **fields)
    config = with_fields(
        CONFIG, env__name="paid.py:Paid", collect__ppo=ppo, train__ppo=ppo, collect__ticks=ITERATIONS * T * B,
        train__ticks=ITERATIONS * T * B, collect__capacity=0, options__steps=0, evaluate__episodes=100,
        evaluate__video_ticks=0, seeds=1,
    )  # fmt: skip
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        Path("paid.py").write_text(PAID)
        return folder / "run", run_pipeline(config, folder / "run").summary["methods"]


def test_evaluations_are_of_the_policy_as_it_explores_and_of_its_mean_before_and_after_training(finished):
    """Untrained, the mean action 0 earns nothing; clipped noise of standard deviation 1 loses 0.516 a tick."""
    flat = finished[1]["flat"]
    exploring, mean = flat["return"], flat["return_mean_option"]
    np.testing.assert_allclose(mean["first_per_seed"], 0.0, atol=0.3)
    np.testing.assert_allclose(exploring["first_per_seed"], -0.516 * TICKS, atol=0.7)
    # Trained, the mean earns up to 1/4 a tick, and exploring still costs.
    assert mean["first_per_seed"][0] + 0.3 < mean["per_seed"][0] <= TICKS / 4
    assert exploring["first_per_seed"][0] < exploring["per_seed"][0] < mean["per_seed"][0] - 0.2
    assert flat["metrics"]["return"]["per_seed"] == mean["per_seed"]
    assert flat["metrics"]["length"]["per_seed"] == [TICKS]


def test_experience_holds_the_actions_as_they_were_done_and_every_end_of_an_episode(finished):
    """All episodes are cut by the time limit, and noise of standard deviation 1 is clipped in a third of the ticks."""
    experience = read_experience(finished[0] / "experience", 0)
    tick = np.arange(ITERATIONS * T)[:, None]
    np.testing.assert_array_equal(experience.done, np.broadcast_to(tick % TICKS == TICKS - 1, experience.done.shape))
    np.testing.assert_array_equal(experience.obs[..., 0], np.broadcast_to(tick % TICKS, experience.done.shape))
    action = experience.action[..., 0]
    np.testing.assert_allclose(experience.reward, action - action**2, atol=1e-6)
    assert np.abs(action).max() == 1.0 and 0.1 < np.mean(np.abs(action) == 1.0) < 0.6
