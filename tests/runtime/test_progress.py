"""What a run says while it runs: nothing, a bar on a terminal, or lines that tell a log file that it lives."""

import time

import numpy as np
import pytest

from taic_jax.runtime import progress
from taic_jax.runtime.logging import RunLogger
from taic_jax.runtime.progress import Work


@pytest.fixture
def clock(monkeypatch):
    """Stand in for the time: a list of one number, the seconds since some start."""
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    return now


def test_a_line_by_hand(clock):
    """Of 1000 ticks 400 were made before a resume and 200 in the last 10 s, by each of 3 seeds: 60 ticks/s."""
    work = Work("train", 1000, first=400, done=400, seeds=3)
    assert work.line() == "train: 40% of 1,000 ticks"
    clock[0] += 10
    work.done, work.result = 600, -1234.56
    assert work.line() == "train: 60% of 1,000 ticks, return -1,234.6, 60 ticks/s, 20 s left"
    work.done = 1000
    assert work.line() == "train: 100% of 1,000 ticks, return -1,234.6, 180 ticks/s"


def test_work_without_a_measure_says_how_long_it_takes(clock):
    work = Work("train: compiling")
    assert work.line() == "train: compiling"
    clock[0] += 41
    assert work.line() == "train: compiling, 41 s"


@pytest.mark.parametrize(("seconds", "left"), [(89, "89 s"), (90, "1.5 min"), (5399, "90.0 min"), (9000, "2.5 h")])
def test_time_left_is_told_in_few_digits(clock, seconds, left):
    work = Work("train", 2 * seconds, done=0)
    clock[0] += seconds
    work.done = seconds
    assert work.line().endswith(f", {left} left")


def lines_of(capfd) -> list[str]:
    out, err = capfd.readouterr()
    assert out == ""
    return err.splitlines()


def test_a_file_gets_a_line_at_least_every_interval(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(progress, "INTERVAL", 0.2)
    with RunLogger(tmp_path) as logger:
        logger.say("once")
        assert lines_of(capfd) == ["taic_jax: once"]
        with logger.doing("train: compiling"):
            assert lines_of(capfd) == ["taic_jax: train: compiling"], "at once"
            time.sleep(0.5)
        assert len(lines_of(capfd)) >= 2
        with logger.doing("train: compiling"):
            assert lines_of(capfd) == [], "the same is not said again at once"
        with logger.doing("train", 40, done=20):
            logger.log("train", 30, {"return": np.array([1.0, 4.0])})
            time.sleep(0.3)
            assert any("train: 75% of 40 ticks, return 2.5, " in line and " left" in line for line in lines_of(capfd))
            logger.log("train", 40, {"return": np.array([1.0, 5.0])})
        assert "train: 100% of 40 ticks, return 3.0, " in lines_of(capfd)[-1], "the end of a stage"
        time.sleep(0.5)
        assert lines_of(capfd) == [], "nothing is under way"
    time.sleep(0.3)
    assert lines_of(capfd) == []


@pytest.mark.parametrize("terminal", ["", "1"])
def test_quiet_is_quiet_everywhere(tmp_path, capfd, monkeypatch, terminal):
    monkeypatch.setenv("FORCE_COLOR", terminal)
    monkeypatch.setattr(progress, "INTERVAL", 0.05)
    with RunLogger(tmp_path, quiet=True) as logger, logger.doing("compiling"), logger.doing("train", 20):
        logger.say("something")
        logger.log("train", 20, {"return": 1.0})
        time.sleep(0.2)
    assert capfd.readouterr() == ("", "")


def test_a_terminal_gets_a_bar_for_each_stage_and_no_lines(tmp_path, capfd, monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "120")
    with RunLogger(tmp_path) as logger:
        logger.say("the newest ticks are kept")
        with logger.doing("train: compiling"):
            time.sleep(0.2)
        with logger.doing("train", 40, done=20):
            logger.log("train", 30, {"return": np.array([1.0, 4.0])})
    out, err = capfd.readouterr()
    assert out == "" and err.count("taic_jax: ") == err.count("taic_jax: the newest ticks are kept") == 1
    for text in ("train: compiling", "30/40", "ticks/s", "return 2.5"):
        assert text in err
    assert "train: compiling" not in err.splitlines()[-1], "it goes when it is over"
