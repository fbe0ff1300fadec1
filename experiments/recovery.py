"""How a run fares where its task changes (section 4.1): successes before the change and after it, from its log."""

from collections.abc import Sequence
from typing import Any

import numpy as np

EPISODES = 100
"""Fewest episodes that a share of successes is taken of."""
AFTER = 200_000
"""Ticks after the change in which a method may recover: 1000 episodes of the longest kind."""
RECOVERED = 0.9
"""Share of these last episodes that reach the goal where a seed has recovered."""


def recovery_of(rows: Sequence[dict[str, Any]], stage: str) -> tuple[np.ndarray, dict[str, list]]:
    """Return the share of episodes that reached the goal, per seed and iteration [K, I], and numbers per seed.

    Numbers: `changed_at`, the tick at which the task changed; `success_before` and `success_after`, the share of
    successes among the last 100 episodes before it, and among the last 100 that ended in the `AFTER` ticks behind it;
    `ticks_after`, the ticks that a seed had behind it. NaN where it never changed.

    Args:
        rows: of the stage, one per iteration.
        stage: its name.
    """
    unit = rows[0]["ticks"]
    changed, success, episodes = (
        np.array([row[f"{stage}/{name}"] for row in rows], float).T
        for name in ("mean/changed", "mean/success", "episodes")
    )
    reached = success * unit  # an episode ends at its success
    shares = np.divide(reached, episodes, out=np.full_like(reached, np.nan), where=episodes > 0)
    numbers: dict[str, list] = {"changed_at": [], "success_before": [], "success_after": [], "ticks_after": []}
    for k in range(len(changed)):
        behind = np.cumsum(changed[k] * unit)
        numbers["ticks_after"].append(float(behind[-1]))
        if not behind[-1]:
            numbers["changed_at"].append(float("nan"))
            numbers["success_before"].append(_last_share(reached[k], episodes[k]))
            numbers["success_after"].append(float("nan"))
            continue
        before, within = changed[k] == 0, (changed[k] == 1) & (behind <= AFTER)
        numbers["changed_at"].append(len(behind) * unit - float(behind[-1]))
        numbers["success_before"].append(_last_share(reached[k, before], episodes[k, before]))
        numbers["success_after"].append(_last_share(reached[k, within], episodes[k, within]))
    return shares, numbers


def _last_share(reached: np.ndarray, episodes: np.ndarray) -> float:
    """Return the share of successes of the fewest last iterations that hold `EPISODES` episodes, or NaN."""
    counts = np.cumsum(episodes[::-1])
    if not len(counts) or counts[-1] < EPISODES:
        return float("nan")
    last = np.argmax(counts >= EPISODES) + 1
    return float(reached[-last:].sum() / counts[last - 1])
