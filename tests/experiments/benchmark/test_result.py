"""The time to a result: a process is stopped at its first evaluation above the threshold, and a table has medians."""

import pytest

from taic_jax.experiments.benchmark import climbs, result
from taic_jax.experiments.benchmark.result import Arrival, arrival, row


@pytest.mark.timeout(600)
def test_a_process_ends_at_the_first_evaluation_above_the_threshold(monkeypatch, tmp_path):
    monkeypatch.setitem(result.THRESHOLDS, "hopper", 1.0)
    seconds, ticks = arrival("taic_jax", "hopper", 0, tmp_path)
    assert ticks == climbs.EVERY and seconds > 2, "imports and compilation count"
    assert any(tmp_path.rglob("*-cache")), "compiled programs are kept in the folder"


def test_the_seconds_of_evaluation_do_not_count(monkeypatch, tmp_path):
    library = tmp_path / "python"
    library.write_text("#!/bin/sh\necho 40 1999 500\necho 80 2000 1000\nexec sleep 60\n")
    library.chmod(0o755)
    monkeypatch.setattr(result.sys, "executable", str(library))
    seconds, ticks = arrival("taic_jax", "hopper", 0, tmp_path)
    assert ticks == 80 and -1000 < seconds < -970, "a thousand seconds less, and stopped before the sleep is over"


def test_a_process_that_fails_is_an_error(tmp_path):
    with pytest.raises(RuntimeError, match="taic_jax nowhere 0 failed with exit code 1"):
        arrival("taic_jax", "nowhere", 0, tmp_path)


def test_a_row_has_the_seeds_that_arrived():
    line = row("ant", "taic_jax warm", [Arrival(9.0, 300), Arrival(), Arrival(4.0, 100), Arrival(5.0, 200)])
    assert [*line.values()] == ["ant, taic_jax warm", 5.0, 4.0, 9.0, 200, "3 of 4"]
    assert [*row("ant", "a", [Arrival()]).values()] == ["ant, a", None, None, None, None, "0 of 1"]
