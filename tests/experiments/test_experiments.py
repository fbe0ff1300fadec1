"""The commands that measure: that they run, say what they should, and do nothing twice. Not what they measure."""

from pathlib import Path

import numpy as np

from taic_jax.experiments.evidence.plan import EARLIER, all_cells
from taic_jax.experiments.evidence.table import TABLE, config_hash, curves_of, read_table


def test_every_row_of_the_published_table_is_of_the_run_that_would_be_done_today():
    """A preset that changes makes its rows stale: they are done again, or kept in the log of a search."""
    runs = Path("runs/evidence")
    hashes = {key: config_hash(cell.config, runs) for cell in all_cells(runs) for key in cell.keys}
    rows = read_table(Path(__file__).parents[2] / TABLE)
    assert len(rows) > 40
    for row in rows:
        key = row["task"], row["method"], row["seed"]
        if key[:2] in EARLIER:
            continue
        assert hashes.get(key) == row["config"], f"{'/'.join(map(str, key))}: cut this row, or undo what changed it"


def test_shares_of_ticks_are_means_over_two_points_of_the_grid_and_returns_the_latest():
    """Three iterations to a point, then one that is as long as three points."""
    ticks, grid = [10, 20, 30, 40, 50, 60, 150], np.array([30, 60, 90, 120, 150])
    rows = [
        {"ticks": t, "flat/return": [float(i)], "flat/mean/success": [float(i % 3 == 2)]} for i, t in enumerate(ticks)
    ]
    curves = curves_of(rows, "flat", grid)
    assert curves["return"] == [[2, 5, 5, 5, 6]]
    np.testing.assert_allclose(curves["mean/success"], [[1 / 3, 1 / 3, 1 / 3, 1, 0]])
