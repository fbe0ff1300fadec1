"""Statistics over seeds, against numbers worked out by hand and by scipy."""

import math

import numpy as np
import pytest
from scipy import stats

from taic_jax.analysis.statistics import (
    bootstrap_interval,
    exact_interval,
    holm,
    iqm,
    probability_of_improvement,
    stratified_interval,
    summarize,
)  # fmt: skip


def test_iqm_drops_the_lowest_and_highest_quarter():
    # Of 8 sorted values the lowest 2 and the highest 2 go: (3 + 4 + 5 + 6) / 4 = 4.5.
    assert iqm([8.0, -100.0, 3.0, 4.0, 5.0, 6.0, 1000.0, 2.0]) == 4.5
    # Fewer than 4 values leave nothing to drop.
    assert iqm([1.0, 2.0, 6.0]) == 3.0


def test_iqm_works_along_an_axis():
    values = np.arange(24.0).reshape(2, 3, 4)
    np.testing.assert_allclose(iqm(values, axis=-1), values[..., 1:3].mean(-1))
    np.testing.assert_allclose(iqm(values, axis=0), values.mean(0))


def test_iqm_does_not_hide_a_diverged_seed():
    # Sorting puts NaN last, where trimming would drop it.
    assert math.isnan(iqm([1.0, 2.0, 3.0, math.nan]))


def test_interval_golden_numbers():
    values = [1396.0, 1278.0, 1514.0, 1450.0, 1322.0]
    assert bootstrap_interval(values) == bootstrap_interval(values)
    np.testing.assert_allclose(bootstrap_interval(values), (3922 / 3, 4478 / 3), rtol=1e-12)
    assert bootstrap_interval(values, seed=1) != bootstrap_interval(values)


def test_interval_agrees_with_scipy():
    values = np.random.default_rng(0).normal(size=40)
    peer = stats.bootstrap((values,), iqm, n_resamples=20_000, method="percentile", rng=1).confidence_interval
    np.testing.assert_allclose(bootstrap_interval(values), peer, atol=0.03)


def test_interval_narrows_with_less_confidence():
    values = np.arange(20.0)
    low, high = bootstrap_interval(values)
    low_half, high_half = bootstrap_interval(values, confidence=0.5)
    assert low < low_half < iqm(values) < high_half < high


def test_interval_of_two_seeds_spans_them():
    assert bootstrap_interval([1.0, 3.0]) == (1.0, 3.0)


def test_interval_of_one_seed_is_unknown():
    assert all(math.isnan(bound) for bound in bootstrap_interval([3.0]))


def test_summary_is_json():
    summary = summarize(np.array([1.0, 2.0, 3.0, 4.0, 100.0], np.float32))
    assert summary == {"per_seed": [1, 2, 3, 4, 100], "mean": 22, "iqm": 3, "ci95": summary["ci95"]}
    assert summary["ci95"][0] < 3 < summary["ci95"][1]
    assert summarize([1.0]) == {"per_seed": [1], "mean": 1, "iqm": 1, "ci95": [None, None]}
    assert summarize([1.0, math.inf]) == {
        "per_seed": [1, None],
        "mean": None,
        "iqm": None,
        "ci95": [None, None],
    }
    assert summarize([1.0, math.nan])["per_seed"] == [1, None]


def test_probability_of_improvement_by_hand():
    # Of nine pairs, 1 beats 0, 3 beats all three, 2 beats two and ties with 2: (1 + 3 + 2 + 1/2) / 9.
    share, (low, high) = probability_of_improvement([1, 3, 2], [0, 2, 1.5])
    assert share == pytest.approx((1 + 3 + 2 + 0.5) / 9) and low < share < high
    # Two pairs without a common seed: 0.025 = p ** 2 at the lower bound.
    assert probability_of_improvement([2, 3, 4], [0, 1]) == (1.0, (pytest.approx(0.025**0.5), 1.0))
    assert probability_of_improvement([0, 1], [2, 3, 4]) == (0.0, (0.0, pytest.approx(1 - 0.025**0.5)))
    assert probability_of_improvement([1, 1], [1, 1])[0] == 0.5


@pytest.mark.parametrize("of_x", [True, False])
def test_the_interval_of_improvement_covers_95_percent_of_resampled_seeds(of_x):
    """One seed against fifty that it beats half of: the share of fifty draws is binomial."""
    many, one = np.repeat([-1.0, 1.0], 25), [0.0]
    share, interval = probability_of_improvement(many, one) if of_x else probability_of_improvement(one, many)
    assert share == 0.5
    np.testing.assert_allclose(interval, stats.binom.ppf([0.025, 0.975], 50, 0.5) / 50)


def test_a_stratified_interval_never_mixes_groups():
    """Two groups of equal values each: however they are resampled, the middle half is the same."""
    low, high = stratified_interval([np.zeros((4, 3)), np.ones((4, 3))])
    np.testing.assert_array_equal([low, high], np.full((2, 3), 0.5))
    values = np.arange(12.0)[:, None]
    mixed = stratified_interval([values])
    assert mixed[0] < iqm(values, axis=0) < mixed[1]
    np.testing.assert_allclose(np.ravel(mixed), bootstrap_interval(values[:, 0]))
    apart = stratified_interval([values[:6], values[6:]])
    assert apart[1] - apart[0] < mixed[1] - mixed[0]


def test_exact_intervals_are_those_of_the_tables():
    # 2 of 10: the roots of the binomial tails at 0.025; 10 of 10: 0.025 ** (1 / 10).
    np.testing.assert_allclose(exact_interval(2, 10), (0.02521, 0.55610), atol=1e-5)
    np.testing.assert_allclose(exact_interval(10, 10), (0.025**0.1, 1.0))


def test_holm_by_hand():
    np.testing.assert_allclose(holm([0.04, 0.01, 0.03]), [0.06, 0.03, 0.06])
    np.testing.assert_allclose(holm([0.6, 0.5]), [1.0, 1.0])
