"""Semi-Markov advantages against a double loop, against RLax, and by hand."""

import jax
import numpy as np
import pytest
import rlax

from taic_jax.rl.returns import Judgement, semi_markov_advantages


@jax.jit
def advantages_of(*, ended, gamma, lambda_, **judgement):
    """Return the advantages of ticks by name."""
    return semi_markov_advantages(Judgement(**judgement), ended, gamma, lambda_)


def make_ticks(seed: int, T: int = 12, B: int = 3, ends: float = 0.4, episode_ends: float = 0.15) -> dict:
    """Return random ticks with random ends of options and of episodes."""
    rng = np.random.default_rng(seed)
    terminated, truncated = rng.random((2, T, B)) < episode_ends
    return {
        "reward": rng.normal(size=(T, B)).astype(np.float32),
        "ended": (rng.random((T, B)) < ends) | terminated | truncated,
        "terminated": terminated,
        "truncated": truncated,
        "value": rng.normal(size=(T, B)).astype(np.float32),
        "final_value": rng.normal(size=(T, B)).astype(np.float32),
        "last_value": rng.normal(size=B).astype(np.float32),
        "gamma": np.float32(rng.uniform(0.5, 1.0)),
        "lambda_": np.float32(rng.uniform(0.0, 1.0)),
    }


def advantages_by_loop(ticks: dict, b: int) -> dict[int, float]:
    """Return A_t of every decision t of environment b, as equations 11 to 13 say."""
    reward, ended, value = (ticks[name][:, b] for name in ("reward", "ended", "value"))
    terminated, truncated = ticks["terminated"][:, b], ticks["truncated"][:, b]
    gamma, lambda_, T = float(ticks["gamma"]), float(ticks["lambda_"]), len(ticks["reward"])
    decisions = [0] + [t for t in range(1, T) if ended[t - 1]]
    advantages: dict[int, float] = {}
    for t in reversed(decisions):
        r, k = 0.0, 0
        while True:
            r += gamma**k * reward[t + k]
            k += 1
            if ended[t + k - 1] or t + k == T:
                break
        end = t + k - 1
        bootstrap = value[t + k] if t + k < T else ticks["last_value"][b]
        if truncated[end]:
            bootstrap = ticks["final_value"][end, b]
        if terminated[end]:
            bootstrap = 0.0
        carries_on = not (terminated[end] or truncated[end])
        following = advantages.get(t + k, 0.0) if carries_on else 0.0
        advantages[t] = r + gamma**k * bootstrap - value[t] + gamma**k * lambda_ * following
    return advantages


@pytest.mark.parametrize("seed", range(20))
def test_equals_a_double_loop_over_decisions(seed):
    ticks = make_ticks(seed)
    got = np.asarray(advantages_of(**ticks))
    for b in range(got.shape[1]):
        for t, expected in advantages_by_loop(ticks, b).items():
            np.testing.assert_allclose(got[t, b], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_one_tick_options_are_gae(seed):
    ticks = make_ticks(seed, ends=1.0)
    ticks["truncated"] = np.zeros_like(ticks["truncated"])
    got = advantages_of(**ticks)
    for b in range(got.shape[1]):
        value = np.append(ticks["value"][:, b], ticks["last_value"][b])
        discount = ticks["gamma"] * ~ticks["terminated"][:, b]
        expected = rlax.truncated_generalized_advantage_estimation(
            ticks["reward"][:, b], discount.astype(np.float32), ticks["lambda_"], value
        )
        np.testing.assert_allclose(got[:, b], expected, rtol=1e-5, atol=1e-5)


def one_environment(**changes: list) -> dict:
    """Return four ticks of one environment: options of 2 ticks, gamma = lambda = 1/2."""
    ticks = {
        "reward": [1.0, 2.0, 4.0, 8.0],
        "ended": [False, True, False, True],
        "terminated": [False] * 4,
        "truncated": [False] * 4,
        "value": [10.0, 0.0, 20.0, 0.0],
        "final_value": [0.0, 100.0, 0.0, 200.0],
    } | changes
    arrays = {
        name: np.asarray(column, bool if isinstance(column[0], bool) else np.float32)[:, None]
        for name, column in ticks.items()
    }
    half = np.float32(0.5)
    return arrays | {"last_value": np.asarray([40.0], np.float32), "gamma": half, "lambda_": half}


# Second decision: delta = 4 + 8/2 + 40/4 - 20 = -2 = A. First: delta = 1 + 2/2 + 20/4 - 10 = -3,
# A = -3 + (1/4)(1/2)(-2) = -3.25.
CASES = {
    "two decisions": ({}, -3.25, -2.0),
    # The end of the rollout cuts the second option, which bootstraps from where it stands.
    "cut by the end of the rollout": ({"ended": [False, True, False, False]}, -3.25, -2.0),
    # First: 1 + 2/2 + 0 - 10 = -8: no bootstrap, and nothing from the next episode.
    "terminated": ({"terminated": [False, True, False, False]}, -8.0, -2.0),
    # First: 1 + 2/2 + 100/4 - 10 = 17: from the observation before the reset.
    "truncated": ({"truncated": [False, True, False, False]}, 17.0, -2.0),
    "both": ({"terminated": [False, True, False, False], "truncated": [False, True, False, False]}, -8.0, -2.0),
    # Second: 4 + 8/2 + 200/4 - 20 = 38. First: -3 + 38/8 = 1.75.
    "truncated at the end of the rollout": ({"truncated": [False, False, False, True]}, 1.75, 38.0),
}


@pytest.mark.parametrize("case", CASES)
def test_by_hand(case):
    changes, first, second = CASES[case]
    got = np.asarray(advantages_of(**one_environment(**changes)))[:, 0]
    np.testing.assert_allclose(got[[0, 2]], [first, second], rtol=1e-6)
