"""What figure 7 says of a method beside flat PPO, by hand: area, threshold, jump-start, improvement."""

import numpy as np
import pytest

from taic_jax.experiments.evidence.table import EvidenceRows
from taic_jax.experiments.figures.drawing import adjust
from taic_jax.experiments.figures.figure7 import numbers

GRID = np.array([10, 20, 30, 40])


def rows(method: str, seeds: tuple, curves: list, first: list, mean: list | None = None, **fields) -> EvidenceRows:
    """Return rows whose last returns are the curves' ends."""
    values = {"last": np.array(curves, float)[:, -1], "first": np.array(first, float)}
    values["mean_option"] = np.array(mean, float) if mean else values["last"]
    fields = {"ticks": 40, "pretraining": 0} | fields
    return EvidenceRows("ant", method, seeds, fields["ticks"], fields["pretraining"], GRID,
                        {"return": np.array(curves, float)}, values, ())  # fmt: skip


FLAT = rows("strong", (0, 1, 2), [[np.nan, 2, 6, 10], [np.nan, 4, 8, 20], [0, 1, 5, 30]], [1, 2, 3])
OPTIONS = rows(
    "fixed-open", (1, 2, 5), [[9, 10, 11, 25], [0, 2, 9, 9], [3, 4, 12, 30]], [5, 2, 100], [31, 32, 9], pretraining=60
)


def test_numbers_by_hand():
    (row,) = numbers(OPTIONS, {"strong": FLAT, "fixed-open": OPTIONS})
    # Areas are means of curves: 13.75, 5 and 12.25; of three seeds nothing is trimmed.
    assert row["auc"] == pytest.approx((13.75 + 5 + 12.25) / 3) and row["auc_low"] < row["auc"] < row["auc_high"]
    assert row["iqm"] == pytest.approx(64 / 3) and row["mean"] == 24 and row["seeds"] == 3
    # Half of flat's last, 20 in the middle, is 10: reached at 20, never, and at 30.
    assert (row["ticks_to_threshold"], row["reached"]) == (30, "2/3")
    # Seeds 1 and 2 are flat's too: 5 - 2 and 2 - 3.
    assert (row["jump_start"], row["jump_starts_positive"]) == (1.0, "1/2")
    # Last, 25, 9, 30 against 10, 20, 30: 2, 0, 2.5 of 3. Means, 31, 32, 9: 3, 3, 0.
    assert row["improvement"] == pytest.approx(4.5 / 9) and row["improvement_of_means"] == pytest.approx(6 / 9)
    assert row["improvement_low"] < row["improvement"] < row["improvement_high"]
    assert row["p"] == pytest.approx(7 / 20), "of the 20 orders of both methods' means, 7 have as many wins"
    assert {"improvement_on_weak", "improvement_at_same_total"}.isdisjoint(row)


def test_the_baseline_reaches_its_own_threshold_and_is_not_compared_with_itself():
    (row,) = numbers(FLAT, {"strong": FLAT})
    # Not a number before an episode was over: areas 6, 32/3 and 9. 10 is reached at the end, by all.
    assert row["auc"] == pytest.approx((6 + 32 / 3 + 9) / 3)
    assert (row["ticks_to_threshold"], row["reached"]) == (40, "3/3")
    assert {"jump_start", "improvement", "p"}.isdisjoint(row)


def test_a_threshold_that_few_reach_is_never_in_the_middle():
    slow = rows("fixed-open", (0, 1, 2), [[0, 0, 0, 10], [0] * 4, [0] * 4], [0] * 3)
    (row,) = numbers(slow, {"strong": FLAT, "fixed-open": slow})
    assert (row["ticks_to_threshold"], row["reached"]) == (np.inf, "1/3")


def test_the_same_total_is_of_ticks_with_the_pretraining_counted_in():
    weak, long = rows("weak", (0,), [[0, 0, 0, 26]], [0]), rows("long", (0, 1), [[0] * 4, [0, 0, 0, 27]], [0, 0])
    long_as_both = rows("long", (0, 1), [[0] * 4, [0, 0, 0, 27]], [0, 0], [31.5, 0], ticks=100)
    methods = {"strong": FLAT, "weak": weak, "long": long_as_both, "fixed-open": OPTIONS}
    (row,) = numbers(OPTIONS, methods)
    assert row["improvement_on_weak"] == pytest.approx(1 / 3)
    # Last, 25, 9, 30 against 0 and 27; means, 31, 32, 9 against 31.5 and 0.
    assert row["improvement_at_same_total"] == pytest.approx(4 / 6)
    assert row["improvement_of_means_at_same_total"] == pytest.approx(4 / 6)
    assert "improvement_at_same_total" not in numbers(OPTIONS, methods | {"long": long})[0]


def test_p_values_are_adjusted_over_the_tasks_of_each_method():
    table = [{"method": "a", "p": 0.04}, {"method": "b", "p": 0.03}, {"method": "a", "p": 0.01}, {"method": "c"}]
    adjust(table)
    assert table == [
        {"method": "a", "p_holm": 0.04}, {"method": "b", "p_holm": 0.03}, {"method": "a", "p_holm": 0.02},
        {"method": "c"},
    ]  # fmt: skip
