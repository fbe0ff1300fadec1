"""Statistics over seeds: interquartile mean, bootstrap intervals (Agarwal et al., 2021), shares and many tests."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from taic_jax.runtime.files import json_safe
from taic_jax.runtime.run_folder import Statistics

BOOTSTRAP_DRAWS = 2000


def iqm(values: ArrayLike, axis: int = -1) -> Any:
    """Return the mean over seeds without the lowest and the highest quarter; NaN if a seed's value is not finite."""
    values = np.asarray(values, np.float64)
    finite = np.isfinite(values)
    trimmed = stats.trim_mean(np.where(finite, values, 0.0), 0.25, axis=axis)
    return np.where(finite.all(axis=axis), trimmed, np.nan)[()]


def bootstrap_interval(values: ArrayLike, seed: int = 0, confidence: float = 0.95) -> tuple[float, float]:
    """Return the percentile bootstrap interval of the interquartile mean of values [K]; NaN for one value alone."""
    values = np.asarray(values, np.float64)
    if values.size < 2:
        return float("nan"), float("nan")
    draws, tail = iqm(values[_resamples(np.random.default_rng(seed), values.size)]), (1 - confidence) / 2
    low, high = np.quantile(draws, [tail, 1 - tail])
    return float(low), float(high)


def probability_of_improvement(x: ArrayLike, y: ArrayLike, seed: int = 0) -> tuple[float, tuple[float, float]]:
    """Return P(a run of x [K] beats a run of y [J]), ties counted half, and its 95 % interval.

    That is the bootstrap's over seeds. If all pairs agree, every resample does: then it is the exact one of min(K, J)
    pairs without a common seed, which are independent.
    """
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    wins = np.sign(x[:, None] - y[None]) / 2 + 0.5
    if wins.min() == wins.max() != 0.5:
        pairs = min(wins.shape)
        return float(wins.mean()), exact_interval(int(wins[0, 0]) * pairs, pairs)
    random = np.random.default_rng(seed)
    rows, columns = _resamples(random, len(x)), _resamples(random, len(y))
    draws = [wins[np.ix_(i, j)].mean() for i, j in zip(rows, columns, strict=True)]
    low, high = np.quantile(draws, [0.025, 1 - 0.025])
    return float(wins.mean()), (float(low), float(high))


def stratified_interval(groups: Sequence[ArrayLike], seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return the 95 % bootstrap interval of the interquartile mean over groups [K, ...], each resampled by itself."""
    arrays = [np.asarray(group, np.float64) for group in groups]
    values, resamples = np.concatenate(arrays), _resamples(np.random.default_rng(seed), *map(len, arrays))
    tail = (1 - 0.95) / 2
    low, high = np.quantile([iqm(values[rows], axis=0) for rows in resamples], [tail, 1 - tail], axis=0)
    return low, high


def _resamples(random: np.random.Generator, *sizes: int) -> np.ndarray:
    """Draw each group's rows from its own with replacement: indices [draws, sum of sizes] into all rows."""
    starts = np.repeat(np.cumsum([0, *sizes[:-1]]), sizes)
    return starts + random.integers(np.repeat(sizes, sizes), size=(BOOTSTRAP_DRAWS, sum(sizes)))


def exact_interval(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of the share `count` of `total`, never too narrow (Clopper & Pearson, 1934)."""
    interval = stats.binomtest(count, total).proportion_ci(method="exact")
    return float(interval.low), float(interval.high)


def holm(p_values: ArrayLike) -> np.ndarray:
    """Return p-values [H] of as many hypotheses, adjusted so that any false rejection is rare (Holm, 1979)."""
    p = np.asarray(p_values, np.float64)
    order = np.argsort(p)
    adjusted = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1))
    return np.minimum(adjusted, 1.0)[np.argsort(order)]


def summarize(per_seed: ArrayLike) -> Statistics:
    """Return the values [K], their mean, interquartile mean and 95 % interval, with None for numbers not finite."""
    values = np.asarray(per_seed, np.float64)
    summary = {"per_seed": values, "mean": values.mean(), "iqm": iqm(values), "ci95": bootstrap_interval(values)}
    return json_safe(summary)
