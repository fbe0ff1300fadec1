"""Statistics over seeds: interquartile mean, bootstrap intervals (Agarwal et al., 2021), shares and many tests."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

BOOTSTRAP_DRAWS = 2000


def iqm(values: ArrayLike, axis: int = -1) -> Any:
    """Return the interquartile mean: the mean without the lowest and the highest quarter.

    Args:
        values: [..., K]. One that is not finite (a seed that diverged) is not trimmed: the result is NaN.
        axis: the axis of the seeds.
    """
    values = np.asarray(values, np.float64)
    finite = np.isfinite(values)
    trimmed = stats.trim_mean(np.where(finite, values, 0.0), 0.25, axis=axis)
    return np.where(finite.all(axis=axis), trimmed, np.nan)[()]


def bootstrap_interval(values: ArrayLike, seed: int = 0, confidence: float = 0.95) -> tuple[float, float]:
    """Return the percentile bootstrap interval of the interquartile mean.

    Args:
        values: [K], one per seed. One value alone tells nothing about its spread: the interval is NaN.
        seed: of the resampling; the same seed gives the same interval.
        confidence: probability mass of the interval.
    """
    values = np.asarray(values, np.float64)
    if values.size < 2:
        return float("nan"), float("nan")
    rows = np.random.default_rng(seed).integers(values.size, size=(BOOTSTRAP_DRAWS, values.size))
    tail = (1 - confidence) / 2
    low, high = np.quantile(iqm(values[rows]), [tail, 1 - tail])
    return float(low), float(high)


def probability_of_improvement(x: ArrayLike, y: ArrayLike, seed: int = 0) -> tuple[float, tuple[float, float]]:
    """Return P(a run of x beats a run of y), ties counted half, and its 95 % bootstrap interval over seeds.

    Args:
        x, y: [K] and [J], one value per seed.
        seed: of the resampling.
    """
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    wins = np.sign(x[:, None] - y[None]) / 2 + 0.5
    random = np.random.default_rng(seed)
    rows, columns = (random.integers(n, size=(BOOTSTRAP_DRAWS, n)) for n in wins.shape)
    means = [wins[np.ix_(i, j)].mean() for i, j in zip(rows, columns, strict=True)]
    low, high = np.quantile(means, [0.025, 0.975])
    return float(wins.mean()), (float(low), float(high))


def stratified_interval(
    groups: Sequence[ArrayLike], seed: int = 0, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray]:
    """Return the percentile bootstrap interval of the interquartile mean over all groups, each resampled by itself.

    Args:
        groups: [K, ...] each, one row per seed; a group is a task, or what else must not lend seeds to another.
        seed: of the resampling.
        confidence: probability mass of the interval.
    """
    groups, random = [np.asarray(group, np.float64) for group in groups], np.random.default_rng(seed)
    draws = []
    for _ in range(BOOTSTRAP_DRAWS):
        rows = np.concatenate([group[random.integers(len(group), size=len(group))] for group in groups])
        draws.append(iqm(rows, axis=0))
    tail = (1 - confidence) / 2
    low, high = np.quantile(draws, [tail, 1 - tail], axis=0)
    return low, high


def exact_interval(count: int, total: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return the interval of a share, `count` of `total`, of Clopper & Pearson (1934): it never covers too little."""
    interval = stats.binomtest(count, total).proportion_ci(confidence, method="exact")
    return float(interval.low), float(interval.high)


def holm(p_values: ArrayLike) -> np.ndarray:
    """Return p-values [H] of as many hypotheses, adjusted so that any false rejection is rare (Holm, 1979)."""
    p = np.asarray(p_values, np.float64)
    order = np.argsort(p)
    adjusted = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    return np.minimum(adjusted, 1.0)[np.argsort(order)]


def summarize(per_seed: ArrayLike) -> dict[str, Any]:
    """Return the values per seed, their mean, their interquartile mean and its 95 % interval, ready for JSON.

    Args:
        per_seed: [K]. What is not finite becomes None.
    """
    values = np.asarray(per_seed, np.float64)
    return {
        "per_seed": [_finite(value) for value in values],
        "mean": _finite(values.mean()),
        "iqm": _finite(iqm(values)),
        "ci95": [_finite(bound) for bound in bootstrap_interval(values)],
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
