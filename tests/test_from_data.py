"""Options from recorded data alone: learnt, loaded, resumed, used on a task of the same sizes, and every mistake."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_runs import CONFIG, KilledError, die, files_of, rows_of, tiny_steps, with_fields

import taic_jax as taic
from taic_jax.__main__ import main
from taic_jax.config.files import to_yaml
from taic_jax.report.page import Detail, collect
from taic_jax.run import main as run_main
from taic_jax.runtime.checkpoint import Checkpoints

SMALL = ["--options.length", "2", "--options.size", "2", "--options.hidden-size", "4", "--options.mlp-sizes", "4"]
SMALL += ["--options.steps", "6", "--options.batch-size", "8", "--checkpoint-seconds", "0"]
SIZES = 2, 2  # of nav2d
RANGE = np.array([4.0, 2.0])  # of the actions around 1


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with tiny_steps():
        yield


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def write(path: str, steps: int = 120, sizes: tuple[int, int] = SIZES, **changes: np.ndarray) -> str:
    """Write episodes of 30 steps as OGBench does, whose actions are within 1 +- RANGE."""
    random = np.random.default_rng(0)
    action = 1 + np.resize(RANGE, sizes[1]) * random.uniform(-1, 1, (steps, sizes[1]))
    action[:2] = [1 - np.resize(RANGE, sizes[1]), 1 + np.resize(RANGE, sizes[1])]
    obs = np.cumsum(random.normal(size=(steps, sizes[0])), axis=0)
    arrays = {"observations": obs, "actions": action, "terminals": np.arange(steps) % 30 == 29}
    np.savez(path, **arrays | changes)
    return path


def learn(*args: str) -> int:
    return main(["learn", *args, *SMALL, "--quiet"])


def arrays(run: str) -> bytes:
    return Path(run, "options/arrays.safetensors").read_bytes()


BOUNDS = ("--action-bounds", "-3", "-1", "5", "3")


@pytest.fixture(scope="module")
def learnt(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("learnt")
    data = write(str(folder / "log.npz"))
    assert learn(data, "--run-dir", str(folder / "run"), "--seeds", "2", *BOUNDS) == 0
    return folder


def test_leaves_models_that_speak_the_units_of_the_data(learnt):
    handle = taic.load(learnt / "run")
    assert len(handle.options) == 2 and handle.config.options.length == 2
    model, config = handle.options[1], handle.config.options
    raw = taic.load_options(learnt / "run", taic.make_env("nav2d"), config, 2)
    plain = jax.tree.map(lambda x: x[1], raw)
    option, states = jnp.array([0.3, -0.2]), jnp.zeros((2, 2))
    (actions, ends), (scaled, same) = model.decode(option, states), plain.decode(option, states)
    np.testing.assert_allclose(actions, 1 + RANGE * np.asarray(scaled), rtol=1e-6)
    np.testing.assert_array_equal(ends, same)
    for in_units, alone in zip(model.encode(actions), plain.encode(scaled), strict=True):
        np.testing.assert_allclose(in_units, alone, atol=1e-6)
    executor = taic.make_executor(config, model)  # executors act in [-1, 1], whatever the units of the data
    _, acted = executor.act(executor.start(option, states[0]), model.state_scale.mean, jnp.zeros(0))
    np.testing.assert_allclose(acted, np.clip(scaled[0], -1, 1), rtol=1e-5)


def test_leaves_the_files_of_a_run(learnt, capsys):
    run, table = learnt / "run", taic.load(learnt / "run").config
    assert table.options.action_bounds == (-3, -1, 5, 3) and table.env.name == "data"
    names = {"config.yaml", "clock.json", "metrics.jsonl", "summary.json"}
    assert names <= {path.name for path in run.iterdir()} and not (run / "agents").exists()
    rows = rows_of(run)
    assert {row["stage"] for row in rows} == {"learn"} and rows[-1]["steps"] == 6
    assert all(len(row["learn/reconstruction_loss"]) == 2 for row in rows)
    (page,) = collect([run], Detail(options=50))["runs"]
    measured = page["measures"]
    for name in ("reconstruction_loss", "prediction_loss", "adversarial_loss", "active_dimensions", "kl"):
        assert len(measured[name]["per_seed"]) == 2 and np.isfinite(measured[name]["per_seed"]).all()
    assert page["options"]["drawn"] == "windows" and page["facts"]["finished"]
    for command in ("explore", "play", "evaluate"):
        assert main([command, str(run)]) == 2
        err = capsys.readouterr().err
        assert err.startswith("taic_jax: error: --env.name: expected a task of the same sizes") and err.count("\n") == 1


def test_says_what_was_read_and_the_share_that_windows_use(capsys):
    write("log.npz")
    assert main(["learn", "log.npz", *BOUNDS, "--run-dir", "run", *SMALL]) == 0
    err = capsys.readouterr().err
    assert "log.npz: D4RL or OGBench, 4 episodes, 120 steps, 2 observations, 2 actions in [-1, 1], scaled" in err
    assert "learn: 112 windows of 2 ticks begin in 93.3% of them" in err


def test_a_killed_run_goes_on_to_the_same_models(learnt, monkeypatch):
    args = (str(learnt / "log.npz"), "--run-dir", "again", "--seeds", "2", *BOUNDS)
    with monkeypatch.context() as patch, pytest.raises(KilledError):
        die(patch, Checkpoints, "save", 2)
        learn(*args)
    assert not Path("again/options").exists()
    assert learn(*args, "--resume") == 0
    assert arrays("again") == arrays(str(learnt / "run"))


def test_quantiles_become_bounds_of_the_run():
    assert learn(write("log.npz"), "--action-scale", "quantiles", "--run-dir", "run") == 0
    low, high = np.quantile(np.load("log.npz")["actions"], [0.01, 0.99], axis=0)
    np.testing.assert_allclose(taic.load("run").config.options.action_bounds, [*low, *high], rtol=1e-5)


def test_options_are_used_on_a_task_of_the_same_sizes_alone(learnt, capsys):
    options = {"size": 2, "length": 2, "hidden_size": 4, "mlp_sizes": (4,), "source": str(learnt / "run")}
    config = with_fields(CONFIG, evaluate__video_ticks=0, train__baselines=())
    config = with_fields(config, **{f"options__{name}": value for name, value in options.items()})
    Path("mine.yaml").write_text(to_yaml(config))
    assert run_main(["mine.yaml", "--run-dir", "new", "--quiet"]) == 0
    assert taic.load("new").agents["taic"][0].executor.model.action_scale is None
    capsys.readouterr()
    assert run_main(["mine.yaml", "--run-dir", "other", "--quiet", "--env.name", "half_cheetah"]) == 2
    assert "proprioceptive_size: expected 17, which half_cheetah needs; got 2" in capsys.readouterr().err
    assert not Path("other").exists()


MISTAKES = {
    "no data": ((), {}, "DATA: expected at least one file or folder"),
    "nothing there": (("none.npz",), {}, "none.npz: expected recorded data, got nothing"),
    "no scale": (("a.npz",), {}, "a.npz: actions: expected actions in [-1, 1], got 5; state their --action-bounds"),
    "two scales": (("a.npz", *BOUNDS, "--action-scale", "quantiles"), {}, "none with --action-scale quantiles"),
    "other sizes": (("a.npz", "b.npz"), {}, "b.npz: expected 2 observations and 2 actions, as a.npz has; got 3"),
    "no key": (("a.npz", "--actions", "motors"), {}, "a.npz: expected motors in it, got nothing; the nearest name"),
    "discrete": (("a.npz",), {"actions": np.zeros(120, int)}, "a.npz: actions: expected continuous actions"),
    "short": (
        ("a.npz", *BOUNDS),
        {"terminals": np.ones(120)},
        "options.length: expected the experience to hold",
    ),
    "no rewards": (("a.npz", *BOUNDS, "--options.select", "top"), {}, "options.select: expected random for a.npz"),
    "no heading": (
        ("a.npz", *BOUNDS, "--options.frame", "heading"),
        {},
        "options.frame: expected a body with",
    ),
    "no sides": (("a.npz", *BOUNDS, "--options.views", "all"), {}, "options.views: expected a body with several equal"),
    "experience": (("a.npz", "--options.experience", "c"), {}, "--options.experience: expected none"),
    "misspelt": (("a.npz", "--action-bound", "1"), {}, "unknown option --action-bound; the nearest is --action_bounds"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_one_line_and_nothing_is_written(mistake, capsys):
    args, changes, message = MISTAKES[mistake]
    write("a.npz", **changes)
    write("b.npz", sizes=(3, 2))
    before = files_of(Path())
    assert learn(*args, "--run-dir", "run") == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and err.startswith("taic_jax: error: ") and message in err, err
    assert files_of(Path()) == before
