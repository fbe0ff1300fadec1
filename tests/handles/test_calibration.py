"""The cost of a run, by its first steps: those steps and no more, and a line for whatever makes them fail."""

from pathlib import Path

import pytest
from tiny_runs import CONFIG, tiny_steps, with_fields

from taic_jax import run
from taic_jax.config import ConfigError
from taic_jax.config.files import preset_names, to_yaml
from taic_jax.experiments.benchmark import presets
from taic_jax.handles import calibration
from taic_jax.handles.calibration import Cost, calibrate
from taic_jax.pipeline import Result
from taic_jax.runtime.run_folder import RunFolder
from taic_jax.runtime.signals import DivergedError

LONG = with_fields(CONFIG, collect__ticks=100 * 16 + 5, train__ticks=50 * 16, options__steps=400)
TOTAL = with_fields(LONG, train__baselines=("flat", "total"))


@pytest.fixture
def measured(monkeypatch):
    """Stand in for a run: rows at these times, with a first step of each stage that takes long."""

    def run_pipeline(config, folder, *, quiet, shard, most):
        rows = [
            ("collect", "ticks", 16, (0, 2, 4)),
            ("learn", "steps", 100, (10, 10.5, 11)),
            ("total", "ticks", 16, (20,)),
        ]
        rows += [("train", "ticks", 16, (30, 40))]
        lines = [
            f'{{"stage": "{stage}", "{unit}": {(i + 1) * size}, "time": {second}}}'
            for stage, unit, size, seconds in rows
            for i, second in enumerate(seconds)
        ]
        folder.mkdir()
        RunFolder(folder).metrics_path.write_text(
            "\n".join([*lines, '{"stage": "evaluate", "ticks": 1, "time": 99}\n'])
        )
        return Result({"seconds": {"compile": 7.0, "run": 0.0}}, {})  # pyright: ignore[reportArgumentType]

    monkeypatch.setattr(calibration, "run_pipeline", run_pipeline)


def test_the_seconds_are_those_of_all_steps_at_the_speed_after_the_first(measured, tmp_path):
    cost = calibrate(LONG, tmp_path / "run")
    assert cost.seconds == pytest.approx(100 * 2 + 4 * 0.5 + 50 * 10) and cost.compilation == 7.0


def test_memory_holds_the_experience_of_all_seeds_twice(measured, tmp_path):
    small, big = (calibrate(with_fields(LONG, collect__capacity=0, seeds=k), tmp_path / str(k)) for k in (1, 1000))
    row = 4 * (2 + 2 + 1) + 1  # of two observations, two actions, a reward in four bytes each, and an end
    assert (big.memory - small.memory) * 2**20 == pytest.approx(2 * 999 * 1600 * row, rel=0.2)


def test_only_the_first_steps_are_taken_and_no_evaluation(tmp_path):
    with tiny_steps():
        calibrate(with_fields(TOTAL, options__since=0.9, options__fraction=0.01), tmp_path / "run")
    rows = RunFolder(tmp_path / "run").metrics()
    counts = {stage: len(RunFolder(tmp_path / "run").metrics(stage)) for stage in ("collect", "train", "flat", "total")}
    assert set(counts.values()) == {20}  # as many as a window of each tenth stretch takes, 80 options of 2 ticks
    assert len(RunFolder(tmp_path / "run").metrics("learn")) == 20
    assert not any("return_mean_option" in name for row in rows for name in row)
    assert RunFolder(tmp_path / "run").summary()["methods"] == {} and not (tmp_path / "run/video.webp").exists()


def test_a_dry_run_prints_the_cost_and_leaves_nothing(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    folders = []

    def measure(config, folder, shard):
        folders.append(folder)
        return Cost(90.0, 12.3, 1000.0)

    monkeypatch.setattr(calibration, "calibrate", measure)
    assert run.main(["--dry-run", "--run-dir", "a"]) == 0
    time, peak = capsys.readouterr().out.splitlines()[-2:]
    assert "about 1.5 minutes here" in time and "compilation, which took 12 s" in time and peak.endswith("1,000 MiB")
    assert not folders[0].parent.exists() and not any(tmp_path.iterdir())


def test_seeds_that_diverge_at_once_are_a_mistake_in_one_line(monkeypatch, capsys, tmp_path):
    def diverge(*args, **settings):
        raise DivergedError("train: every seed has stopped")

    monkeypatch.setattr(calibration, "run_pipeline", diverge)
    with pytest.raises(ConfigError, match="every seed has stopped"):
        calibrate(CONFIG, tmp_path)
    (tmp_path / "tiny.yaml").write_text(to_yaml(CONFIG))
    capsys.readouterr()
    assert run.main([str(tmp_path / "tiny.yaml"), "--dry-run"]) == 2
    assert capsys.readouterr().err == "taic_jax: error: train: every seed has stopped\n"


def test_the_table_of_presets_has_a_row_of_each(monkeypatch, capsys):
    sources = {}

    def measure(config, folder):
        sources[Path(folder).name] = config.options.source
        return Cost(60.0 * 12.34, 0, 0)

    monkeypatch.setattr(presets, "calibrate", measure)
    presets.main()
    header, *rows = capsys.readouterr().out.splitlines()
    assert header == "preset,minutes" and set(rows) == {f"{name},12" for name in preset_names()}
    assert sources["transfer_ant_maze"] == "pretrained:steering" and sources["ant"] == ""
