"""Killed at random moments, resumed, the same to the last bit; `experiments.reliability.kills` does it at length."""

import sys

import pytest

from taic_jax.experiments.reliability import kills


@pytest.mark.timeout(1200)
def test_a_killed_run_and_a_killed_sweep_end_as_if_they_had_not_been(monkeypatch, capsys):
    # The seed draws the first moment within the run, and the second within the sweep.
    arguments = ["--kills", "2", "--seed", "18", "--iterations", "4", "--seeds", "1", "--jobs", "2"]
    monkeypatch.setattr(sys, "argv", ["kills", *arguments])
    assert kills.main() == 0
    out = capsys.readouterr().out
    assert "2 resumed runs identical, 0 not" in out and "1 in sweep" in out


def test_differences_are_found():
    whole = {"rows": [1], "collect/0/params": b"a", "methods": {}}
    assert kills.differences(whole, whole) == []
    assert kills.differences(whole, {"rows": [1], "collect/0/params": b"b"}) == ["collect/0/params", "methods"]
