"""A run that is left alone: what is told of its memory and its silence."""

import subprocess
import sys

import pytest

from taic_jax.experiments.reliability import endurance
from taic_jax.experiments.reliability.endurance import Sample, growth, longest_silence
from taic_jax.runtime.run_folder import RunFolder


def samples(*mib: float) -> list[Sample]:
    return [Sample(float(i), "train", i, value) for i, value in enumerate(mib)]


def test_growth_leaves_out_the_first_fifth():
    assert growth(samples(1, 9, 100, 100, 107, 109, 108, 109, 110, 110)) == pytest.approx(0.1)
    assert growth(samples(50)) == 0


def test_the_longest_silence_is_between_rows_or_at_the_end():
    seen = [Sample(float(i), "train", rows, 1) for i, rows in enumerate([1, 2, 2, 2, 3, 4])]
    assert longest_silence(seen) == 3
    assert longest_silence([*seen, Sample(9.0, "train", 4, 1)]) == 4


def test_a_command_that_goes_on_is_stopped_and_a_leak_is_seen(tmp_path):
    run = RunFolder(tmp_path)
    code = """if True:
        import pathlib, time
        kept = []
        for i in range(10_000):
            kept.append(b"x" * 2**20)
            with pathlib.Path("metrics").open("a") as file:
                file.write('{"stage": "train"}\\n')
            time.sleep(0.01)
    """.replace('"metrics"', repr(str(run.metrics_path)))
    seen, exit_code = endurance.watch(subprocess.Popen([sys.executable, "-c", code]), run, 3.0, poll=0.1)
    assert exit_code == -15 and seen[-1].stage == "train" and seen[-1].rows > 20
    assert growth(seen) > 0.5 and longest_silence(seen) < 2


def test_stages_are_told_one_by_one(capsys):
    endurance.report([*samples(10, 10, 10), Sample(7200.0, "flat", 9, 30.0)], 75)
    train, flat, whole = capsys.readouterr().out.splitlines()
    assert train.startswith("train") and "+0.0%" in train and "2 rows" in train
    assert flat.startswith("flat") and whole == "2.00 h, exit code 75, at most 30 MiB"


def test_a_run_that_cannot_begin_is_told(tmp_path, capsys):
    assert endurance.main(["ant"]) == 2
    assert "--run-dir" in capsys.readouterr().err
    assert endurance.main(["aunt", "--run-dir", str(tmp_path / "run")]) == 1
