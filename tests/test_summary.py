"""What a run's summary says, by hand."""

import io
import subprocess

import numpy as np
import pytest
from rich.console import Console

from taic_jax import summary
from taic_jax.analysis.statistics import summarize
from taic_jax.summary import _durations, _method


def test_durations_by_hand():
    # Seed 0: 1 option of one tick, 3 of three; seed 1: 2 of one, 2 of two, 2 of three.
    durations = _durations(np.array([[1.0, 0.0, 3.0], [2.0, 2.0, 2.0]]))
    assert durations["per_seed"] == [2.5, 2.0] and durations["mean"] == 2.25
    assert durations["histogram"] == pytest.approx([0.3, 0.2, 0.5])  # of all ten options


def test_durations_of_a_method_are_those_of_the_exploring_policy():
    """The counts of the mean options are not a metric with one number per seed, and are left out."""
    counts = np.array([[1.0, 3.0]], np.float32)
    evaluation = {"return": np.array([5.0]), "length": np.array([4.0])}
    last = {
        "return": evaluation | {"durations": counts},
        "return_mean_option": evaluation | {"durations": counts[:, ::-1]},
    }
    method = _method(last, last)
    assert method["duration"]["mean"] == 1.75 and method["duration"]["histogram"] == [0.25, 0.75]
    assert set(method["metrics"]) == {"return", "length"}
    assert "durations" in last["return_mean_option"]


def test_the_table_has_a_row_a_method_with_intervals_where_there_are_several_seeds():
    def method(first, last, mean):
        return {"return": summarize(last) | {"first_per_seed": first}, "return_mean_option": summarize(mean)}

    seeds = [1000.0, 2000.0, 3000.0, 4000.0]
    methods = {
        "taic": method([1.0, 2.0, 3.0, 4.0], seeds, [5.0] * 4),
        "flat": method([7.0], [-1234.5], [8.0]),
        "repeat": method([1.0, 2.0], [1.0, np.nan], [1.0, 2.0]),
    }
    console = Console(width=100, file=io.StringIO())
    console.print(summary.as_table({"methods": methods}, "ppo"))
    lines = [line.split("  ") for line in console.file.getvalue().splitlines()]  # pyright: ignore
    cells = {cells[0]: cells[1:] for line in lines if (cells := [text.strip() for text in line if text.strip()])}
    low, high = summarize(seeds)["ci95"]
    assert cells["options (TAIC)"] == ["2", f"2,500 ({low:,.0f} … {high:,.0f})", "5 (5 … 5)"]
    assert cells["flat PPO"] == ["7", "-1,234", "8"]
    assert cells["flat PPO, held actions"][:2] == ["2", "a seed diverged"]
    assert "trained, as it explores" in cells["method"]


def test_commit_is_dirty_where_the_package_was_changed_and_nowhere_else(tmp_path, monkeypatch):
    package, table = tmp_path / "taic_jax", tmp_path / "table.jsonl"
    package.mkdir()
    module = package / "summary.py"
    for file in (module, table):
        file.write_text("")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for line in (["init", "-q"], ["add", "."], ["commit", "-qm", "first"]):
        subprocess.run([*git, *line], check=True)
    monkeypatch.setattr(summary, "__file__", str(module))
    head = subprocess.run([*git, "rev-parse", "HEAD"], check=True, capture_output=True, text=True).stdout.strip()
    table.write_text("a row\n")
    assert summary.commit() == head
    module.write_text("changed\n")
    assert summary.commit() == f"{head}-dirty"
