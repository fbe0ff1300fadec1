"""Statistics over seeds: interquartile mean and bootstrap interval (Agarwal et al., 2021)."""

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
