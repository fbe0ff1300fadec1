"""Numbers that are not finite: named, confined to their seed, dumped, and shown again."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_runs import CONFIG, rows_of, tiny_steps, with_fields

from taic_jax.config.files import to_yaml
from taic_jax.nonfinite import FINITE, QUANTITIES, begin, earliest, first_nonfinite, guarded
from taic_jax.run import main

PIT = """
import jax
import jax.numpy as jnp
from probes import NO, Probe


class Pit(Probe):
    name = "pit"
    episode_length = 4

    def first(self, key):
        return jax.random.uniform(key)

    def move(self, x, action):
        return x, jnp.where(x > 0.98, jnp.nan, action), NO, NO
"""
FALLS, STANDS = 0, 1  # which of the two seeds below meets a start above 0.98 in stage collect
SEED = 0


@pytest.fixture(scope="module", autouse=True)
def tiny():
    with tiny_steps():
        yield


def test_names_the_first_quantity_that_is_not_finite():
    good, bad, counts = jnp.ones(2), {"a": jnp.ones(1), "b": jnp.array([1.0, jnp.inf])}, jnp.arange(3)
    assert QUANTITIES[first_nonfinite(action=good, reward=bad, loss=bad)] == "reward"
    assert QUANTITIES[first_nonfinite(loss=jnp.array(jnp.nan), reward=good, action=bad)] == "loss"
    assert first_nonfinite(action=(good, counts), physics={}) == FINITE
    assert earliest(jnp.array([FINITE, 4, FINITE, 2])) == 4 and earliest(jnp.array([FINITE])) == FINITE


def test_a_seed_stops_at_its_last_good_state_and_the_others_go_on():
    def step(x, bound):
        y = 2.0 * x
        return y, {"nonfinite": jnp.where(y > bound, 5, FINITE).astype(jnp.int32), "x": x}, y

    guard, call = begin(jnp.array([1.0, 3.0, 1.0]), jnp.array([FINITE, FINITE, 2], jnp.int32)), jax.jit(guarded(step))
    for _ in range(3):
        guard, metrics, _ = call(guard, 10.0)
    np.testing.assert_array_equal(guard.state, [8.0, 6.0, 1.0])  # 12 would be too much for the second
    np.testing.assert_array_equal(guard.code, [FINITE, 5, 2])
    np.testing.assert_array_equal(guard.step, [3, 1, 0])
    np.testing.assert_array_equal(metrics["x"], [4.0, np.nan, np.nan])
    assert set(metrics) == {"x"}


@pytest.fixture
def config(tmp_path, monkeypatch) -> Path:
    (tmp_path / "pit.py").write_text(PIT)
    monkeypatch.chdir(tmp_path)
    fields = {"env__name": "pit.py:Pit", "seed": SEED, "evaluate__video_ticks": 0}
    (tmp_path / "config.yaml").write_text(to_yaml(with_fields(CONFIG, **fields)))
    return tmp_path / "config.yaml"


def test_only_the_seed_that_diverges_stops(config, capfd):
    assert main([str(config), "--run-dir", "run"]) == 0
    (line,) = [line for line in capfd.readouterr().err.splitlines() if "stopped" in line]
    (dump,) = Path("run/dumps").iterdir()
    assert f"seed {FALLS} stopped in collect" in line and "reward" in line and f"--replay {dump}" in line
    summary = json.loads(Path("run/summary.json").read_text())
    told = json.loads((dump / "description.json").read_text())
    assert summary["stopped"]["collect"] == {str(FALLS): {"quantity": "reward", "after": told["after"]}}
    assert summary["stopped"]["train"] == {str(FALLS): {"quantity": "reward", "after": 0}}
    for method in summary["methods"].values():
        returns = method["return"]["per_seed"]
        assert returns[FALLS] is None and returns[STANDS] is not None and method["return"]["iqm"] is None
    for stage in ("collect", "learn", "train"):
        losses = [row[name] for row in rows_of(Path("run")) for name in row if row["stage"] == stage and "loss" in name]
        assert losses[-1][FALLS] is None and losses[-1][STANDS] is not None

    before = {path: path.read_bytes() for path in Path("run").rglob("*") if path.is_file()}
    assert main(["--replay", str(dump)]) == 0
    out = capfd.readouterr().out
    assert f"seed {FALLS}, collect, after {told['after']}: reward is not finite, first at tick" in out
    assert {path: path.read_bytes() for path in before} == before


def test_the_seed_that_goes_on_is_as_it_would_be_alone(config):
    assert main([str(config), "--run-dir", "both"]) == 0
    assert main([str(config), "--run-dir", "alone", "--seed", str(SEED + STANDS), "--seeds", "1"]) == 0
    both, alone = (json.loads(Path(name, "summary.json").read_text())["methods"] for name in ("both", "alone"))
    for method, numbers in alone.items():
        np.testing.assert_allclose(both[method]["return"]["per_seed"][STANDS], numbers["return"]["per_seed"], rtol=1e-3)


def test_a_run_of_which_nothing_is_left_ends_in_one_line(config, capfd):
    assert main([str(config), "--run-dir", "run", "--seed", str(SEED + FALLS), "--seeds", "1"]) == 1
    *_, line = capfd.readouterr().err.splitlines()
    assert line.startswith("taic_jax: error: collect: every seed has stopped") and not Path("run/summary.json").exists()
    assert main(["--run-dir", "run", "--resume"]) == 1


def test_diverging_weights_are_told_from_what_the_task_does(config, capfd):
    weights = ["--collect.ppo.learning-rate", "1e38", "--env.name", "nav2d"]
    assert main([str(config), "--run-dir", "run", *weights]) == 1
    assert "its action is not finite" in capfd.readouterr().err  # the first update left weights that are too large
    assert main([str(config), "--run-dir", "new", "--env.name", "nav2d", "--options.learning-rate", "1e38"]) == 1
    assert "stopped in learn after 0: its loss is not finite" in capfd.readouterr().err
    (dump, *_) = Path("new/dumps").iterdir()
    assert main(["--replay", str(dump)]) == 0 and "learn" in capfd.readouterr().out


@pytest.mark.parametrize("text", [None, "{}", "no json"])
def test_what_is_no_dump_is_refused_in_one_line(tmp_path, capfd, text):
    if text is not None:
        (tmp_path / "description.json").write_text(text)
    assert main(["--replay", str(tmp_path)]) == 2
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and str(tmp_path) in err and "dumps" in err
