"""Sweeps: what axes mean, that a point in a program of many is the run it would be alone, and going on."""

import csv
import json
import random
import sys
from pathlib import Path

import numpy as np
import psutil
import pytest
from PIL import Image
from tiny_runs import CONFIG, SLOPE, KilledError, die, tiny_steps, with_fields

from taic_jax.config import Config, ConfigError
from taic_jax.config.files import load_config, to_yaml
from taic_jax.run import main as run
from taic_jax.runtime.checkpoint import Checkpoints
from taic_jax.sweep import runs
from taic_jax.sweep.__main__ import main
from taic_jax.sweep.axes import chunks, configs_of, grid, is_leaf, parse_axis, sample

RATE, LENGTH = "train.ppo.learning_rate=3e-4,0.03", "options.length=2,3"
FEW = ["--chunk", "2", "--checkpoint-seconds", "0"]


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with tiny_steps():
        yield


def enter(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """Go into a folder with a config and its task."""
    patch.chdir(folder)
    Path("slope.py").write_text(SLOPE)
    Path("config.yaml").write_text(to_yaml(with_fields(CONFIG, env__name="slope.py:Slope")))


@pytest.fixture(scope="module")
def whole(tmp_path_factory, tiny) -> Path:
    """Return the folder of a sweep over four points, two of which fit a program, that nothing interrupted."""
    folder = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        enter(folder, patch)
        assert main(["config.yaml", "--run-dir", "run", "--axes", RATE, LENGTH, *FEW]) == 0
    return folder / "run"


@pytest.fixture(autouse=True)
def in_folder_with_config(tmp_path, monkeypatch):
    enter(tmp_path, monkeypatch)


def table_of(folder: str | Path) -> list[dict[str, str]]:
    with Path(folder, "table.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def killed(path: Path, **_) -> None:
    """Stand for a `shutil.rmtree` that was killed, once it is asked for the checkpoints of a chunk."""
    if path.name == "checkpoints" and path.parent.name.startswith("chunk"):
        raise KilledError


def returns_of(row: dict[str, str]) -> np.ndarray:
    return np.array(row["per_seed"].split(), float)


def test_axes_by_hand():
    rate, size = parse_axis("train.ppo.learning-rate=1e-4,3"), parse_axis("options.size=2, 4")
    assert rate.values == (1e-4, 3.0) and size.values == (2, 4) and not rate.is_range
    assert grid([rate, size])[1] == {"train.ppo.learning_rate": 1e-4, "options.size": 4}
    assert is_leaf("options.lambda_kl") and not is_leaf("options.size") and not is_leaf("env.name")
    drawn = [parse_axis("options.lambda_kl=1e-4..1:log").draw(random.Random(i)) for i in range(400)]
    assert 1e-4 < min(drawn) < 1e-3 and 0.1 < max(drawn) < 1 and 0.005 < np.median(drawn) < 0.02
    axes = [rate, parse_axis("options.lambda_kl=0..1")]
    assert sample(axes, 5, 1) == sample(axes, 5, 1) != sample(axes, 5, 2)
    points = grid([rate, size])
    assert chunks(points, 9) == [[0, 2], [1, 3]] and chunks(points, 1) == [[0], [2], [1], [3]]
    assert configs_of(Config(), points)[3].options.size == 4


def test_each_point_is_the_run_that_it_would_be_alone(whole):
    rows = table_of(whole)
    assert [(row["train.ppo.learning_rate"], row["options.length"]) for row in rows] == [
        ("0.0003", "2"), ("0.0003", "3"), ("0.03", "2"), ("0.03", "3"),
    ]  # fmt: skip
    assert sorted(path.name for path in whole.glob("chunk-*")) == ["chunk-000", "chunk-001"]
    changes = ["--train.ppo.learning-rate", "0.03", "--options.length", "3"]
    assert run(["config.yaml", "--run-dir", "one", *changes]) == 0
    alone = json.loads(Path("one/summary.json").read_text())["methods"]["taic"]["return"]
    np.testing.assert_allclose(returns_of(rows[3]), alone["per_seed"], rtol=1e-3)
    assert float(rows[3]["iqm"]) == pytest.approx(alone["iqm"], rel=1e-3)
    assert len({row["per_seed"] for row in rows}) == 4

    best = load_config(str(whole / "best.yaml"))
    top = max(rows, key=lambda row: float(row["iqm"]))
    assert (best.train.ppo.learning_rate, best.options.length) == (
        float(top["train.ppo.learning_rate"]), int(top["options.length"]),
    )  # fmt: skip
    with Image.open(whole / "marginals.png") as picture:
        assert picture.size[0] > 600 and len(picture.convert("L").getcolors()) > 10


def test_an_interrupted_sweep_ends_as_if_it_had_not_been(whole, monkeypatch, capfd):
    args = ["config.yaml", "--axes", RATE, LENGTH, *FEW]
    for i, count in enumerate((2, None, 2)):
        with monkeypatch.context() as patch, pytest.raises(KilledError):
            if count is None:  # in the end of the first chunk, whose checkpoints are still there
                patch.setattr(runs.shutil, "rmtree", killed)
            else:
                die(patch, Checkpoints, "save", count)
            main([*args, "--run-dir", "cut", *(["--resume"] if i else [])])
    assert main([*args, "--run-dir", "cut", "--resume"]) == 0
    for name in ("table.csv", "best.yaml"):
        assert Path("cut", name).read_bytes() == (whole / name).read_bytes()
    assert not list(Path("cut").glob("chunk-*/checkpoints"))
    capfd.readouterr()
    assert main([*args, "--run-dir", "cut", "--resume"]) == 0
    assert "is finished" in capfd.readouterr().err
    assert main(["config.yaml", "--axes", RATE, *FEW, "--run-dir", "cut", "--resume"]) == 2
    assert "other points" in capfd.readouterr().err


def test_a_point_that_diverges_is_marked_and_spoils_none():
    rates = "collect.ppo.learning_rate=3e-4,1e38"
    assert main(["config.yaml", "--run-dir", "both", "--axes", rates, *FEW]) == 0
    assert main(["config.yaml", "--run-dir", "good", "--axes", "collect.ppo.learning_rate=3e-4", *FEW]) == 0
    good, bad = table_of("both")
    assert (good["diverged"], bad["diverged"], bad["iqm"]) == ("0", "2", "nan") and np.isnan(returns_of(bad)).all()
    np.testing.assert_allclose(returns_of(good), returns_of(table_of("good")[0]), rtol=1e-3)
    assert load_config("both/best.yaml").collect.ppo.learning_rate == 3e-4
    assert main(["config.yaml", "--run-dir", "none", "--axes", "collect.ppo.learning_rate=1e38", *FEW]) == 0
    assert table_of("none")[0]["diverged"] == "2" and not Path("none/best.yaml").exists()


def test_optuna_asks_for_points_and_goes_on(monkeypatch):
    pytest.importorskip("optuna")
    args = ["config.yaml", "--axes", "train.ppo.learning_rate=1e-4..1e-1:log", "train.ppo.gamma=0.9,0.99"]
    args += ["--optuna", "3", *FEW]
    with monkeypatch.context() as patch, pytest.raises(KilledError):
        die(patch, Checkpoints, "save", 12)
        main([*args, "--run-dir", "cut"])
    assert main([*args, "--run-dir", "cut", "--resume"]) == 0
    assert main([*args, "--run-dir", "whole"]) == 0
    rows = table_of("whole")
    assert len(rows) == 3 and len({row["train.ppo.learning_rate"] for row in rows}) == 3
    assert [row["train.ppo.learning_rate"] for row in table_of("cut")[:2]] == [
        row["train.ppo.learning_rate"] for row in rows[:2]
    ]
    assert len(table_of("cut")) == 3


BAD = {
    "none": ("", "--axes: expected at least one"),
    "unknown": ("--axes train.ppo.lerning_rate=1", "nearest is train.ppo.learning_rate"),
    "another library's word": ("--axes collect.ppo.lr=1", "nearest is collect.ppo.learning_rate"),
    "no values": ("--axes options.size=", "options.size: expected values"),
    "no equals": ("--axes options.size", "expected FIELD=VALUES"),
    "mistyped": ("--axes options.size=2,x", "options.size: expected an integer, got 'x'"),
    "interval of static": ("--axes options.size=2..4 --samples 3", "options.size: an interval is for numbers"),
    "interval in a grid": ("--axes options.lambda_kl=0..1", "an interval needs --samples or --optuna"),
    "empty interval": ("--axes options.lambda_kl=1..0 --samples 3", "expected LOW..HIGH"),
    "logarithm of nothing": ("--axes options.lambda_kl=0..1:log --samples 3", "0 < LOW < HIGH"),
    "impossible point": ("--axes options.fraction=0.5,1.5", "point options.fraction=1.5: options.fraction: expected"),
    "twice": ("--axes seed=1", "--seed and --seeds"),
    "stands twice": ("--axes options.size=2 options.size=3", "stands twice"),
    "two strategies": ("--axes options.size=2 --samples 1 --optuna 1", "at most one of the two"),
    "negative": ("--axes options.size=2 --samples -1", "--samples: expected at least 0"),
    "too little memory": ("--axes options.lambda_kl=0,1 --memory 1", "--memory: expected at least"),
}


@pytest.mark.parametrize(("args", "message"), BAD.values(), ids=BAD)
def test_bad_axes_are_told_in_one_line(capfd, args, message):
    assert main(["config.yaml", *args.split(), "--run-dir", "new"]) == 2
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and err.startswith("taic_jax: error: ") and message in err
    assert not Path("new").exists()


@pytest.mark.parametrize("dry", [[], ["--dry-run"]], ids=["sweep", "dry run"])
def test_what_is_missing_is_refused_before_anything_is_written_or_measured(monkeypatch, capfd, dry):
    from taic_jax.sweep import memory

    monkeypatch.setattr(memory, "points_that_fit", lambda *_: pytest.fail("minutes of measuring"))
    axes = ["--axes", RATE, "--run-dir", "new"]
    refusals = {"--options none": "none: expected a run", "--resume": "new holds no run to resume"}
    for option, message in refusals.items():
        assert main(["config.yaml", *option.split(), *axes, *dry]) == 2
        assert message in capfd.readouterr().err
    monkeypatch.setitem(sys.modules, "optuna", None)  # as where it is not installed
    monkeypatch.delitem(sys.modules, "taic_jax.sweep.optuna_study", raising=False)
    assert main(["config.yaml", "--optuna", "3", *axes, *dry]) == 2
    assert "the package optuna is not installed" in capfd.readouterr().err
    assert not Path("new").exists()


def test_the_plan_is_told_before_anything_runs(capfd):
    assert main(["config.yaml", "--axes", RATE, LENGTH, "--chunk", "1", "--dry-run"]) == 0
    out = capfd.readouterr().out
    assert "4 points x 2 seeds, at most 1 points at once, in 4 programs" in out and "options.length=3" in out


def test_chunks_are_as_large_as_memory_allows(capfd):
    from taic_jax.sweep import memory

    row = memory.row_bytes(CONFIG)
    assert 10_000 < row < 10_000_000
    assert memory.points_that_fit(CONFIG, 64_000) > memory.points_that_fit(CONFIG, 32_000) > 100
    with pytest.raises(ConfigError):
        memory.points_that_fit(CONFIG, 1)


def test_memory_that_is_in_use_is_counted_in_bytes_on_every_system():
    """Half a GiB more in use leaves no room; macOS counts peaks in bytes, Linux in KiB."""
    from taic_jax.sweep import memory

    memory.row_bytes(CONFIG)  # compiling takes memory too
    limit = psutil.Process().memory_info().rss // 2**20 + 200
    assert limit < memory.machine_memory() <= psutil.virtual_memory().total // 2**20
    assert memory.points_that_fit(CONFIG, limit) > 1
    more = np.ones(2**26)
    with pytest.raises(ConfigError, match="--memory: expected at least"):
        memory.points_that_fit(CONFIG, limit)
    assert more[-1] == 1.0
