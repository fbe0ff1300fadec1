"""Interactions to a threshold, by hand."""

import csv

import pytest
from tiny_runs import CONFIG, with_fields
from written_runs import write_run

from taic_jax.experiments.evidence.interactions import main

# Per seed: options are at 0.9 over two lines after 300 and 400 ticks, flat after 500 and never.
RETURNS = {
    "train": [(None, None), (0.8, 0.5), (1.0, 0.8), (1.0, 1.0), (0.0, 1.0)],
    "flat": [(None, 0.0), (0.0, 0.0), (0.0, 1.0), (0.9, 0.0), (1.0, 1.0), (1.0, 0.0)],
}


@pytest.fixture
def run(tmp_path):
    """Return the folder of a run of these returns, after 200 ticks of collect."""
    lines = [{"stage": "collect", "ticks": 200, "time": 0.0, "collect/return": [0.0, 0.0]}]
    for stage, returns in RETURNS.items():
        for i, pair in enumerate(returns):
            lines.append({"stage": stage, "ticks": 100 * (i + 1), "time": 0.0, f"{stage}/return": list(pair)})
    return write_run(tmp_path / "run", with_fields(CONFIG, seeds=2), written=lines)


def test_a_seed_is_there_once_the_mean_of_the_lines_is(run, tmp_path):
    out = tmp_path / "out.csv"
    assert main([str(run), "--lines", "2", "--out", str(out)]) == 0
    taic, flat = csv.DictReader(out.read_text().splitlines())
    assert (taic["method"], taic["pre_training"], flat["method"], flat["pre_training"]) == ("taic", "200", "flat", "0")
    assert (float(taic["interactions"]), float(flat["interactions"])) == (350.0, 550.0)
    assert (taic["there"], flat["there"]) == ("2", "1")
    assert (float(taic["p_options_first"]), float(flat["p_options_first"])) == (0.5, 1.0)


def test_more_lines_than_there_are_is_one_line(run, capsys):
    assert main([str(run), "--lines", "9"]) == 2
    assert capsys.readouterr().err == "taic_jax: error: --lines: expected at most the 5 log lines of train, got 9\n"
