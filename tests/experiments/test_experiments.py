"""The commands that measure: that they run, say what they should, and do nothing twice. Not what they measure."""

import sys
from pathlib import Path

import numpy as np
import pytest

from taic_jax.config import PPOConfig
from taic_jax.experiments import flat_scores
from taic_jax.experiments.cells import all_cells
from taic_jax.experiments.table import TABLE, config_hash, curves_of, difference, read_table

TINY = PPOConfig(num_envs=4, rollout_length=32, minibatch_size=32, epochs=1)


def test_flat_scores_are_a_row_each_and_not_measured_twice(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(flat_scores, "PPO", dict.fromkeys(flat_scores.PPO, TINY))
    arguments = ["--tasks", "hopper", "--seeds", "2", "--ticks", "256", "--episodes", "1"]
    arguments += ["--out", str(tmp_path / "table.csv"), "--run-dir", str(tmp_path / "runs")]
    monkeypatch.setattr(sys, "argv", ["flat_scores", *arguments])
    flat_scores.main()
    (row,) = flat_scores.read_table(tmp_path / "table.csv")
    assert (row["task"], row["ticks"], row["seeds"], row["cleanrl"]) == ("hopper", "256", "2", "2383")
    per_seed = [float(x) for x in row["per_seed"].split()]
    assert len(set(per_seed)) == 2 and float(row["mean"]) == pytest.approx(sum(per_seed) / 2, abs=1)
    assert float(row["low"]) <= float(row["iqm"]) <= float(row["high"])
    monkeypatch.setattr(flat_scores, "score", lambda *_: pytest.fail("it is in the table"))
    flat_scores.main()
    assert "hopper" in capsys.readouterr().out


def test_every_row_of_the_published_table_is_of_the_run_that_would_be_done_today():
    """A preset that changes makes its rows stale: they are done again, or kept in the log of a search."""
    runs = Path("runs/evidence")
    hashes = {key: config_hash(difference(cell.config, runs)) for cell in all_cells(runs) for key in cell.keys}
    rows = read_table(Path(__file__).parents[2] / TABLE)
    assert len(rows) > 40
    for row in rows:
        key = row["task"], row["method"], row["seed"]
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
