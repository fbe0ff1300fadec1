"""Population-based training: on rows whose right answer is known, and as a sweep."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import numbers
from test_sweep import FEW, table_of
from tiny_runs import CONFIG, SLOPE, KilledError, die, tiny_steps, with_fields

from taic_jax.config import Config, replace
from taic_jax.config.files import load_config, to_yaml
from taic_jax.nonfinite import FINITE
from taic_jax.runtime.checkpoint import Checkpoints
from taic_jax.runtime.pbt import Population, schedule
from taic_jax.sweep.__main__ import main
from taic_jax.types import as_rows

RATE = "train.ppo.learning_rate"
BOUNDS = {RATE: (0.0, 1.0)}


def learner(state, rows):
    """Add the learning rate to what was learnt; the return is all that was learnt, and 100 is too much."""
    learnt, key = state["learnt"] + rows[0].train.ppo.learning_rate, state["key"]
    metrics = {"return": learnt, "nonfinite": jnp.where(learnt > 100, 0, FINITE)}
    return {"learnt": learnt, "key": key}, metrics, None


def evolved(rates: list[float], steps: int, every: int, bounds=BOUNDS):
    """Return what 2 seeds of these points are after some steps, and the metrics of each step."""
    population = Population(every, bounds, seeds=2)
    config = as_rows([replace(Config(), RATE, rate) for rate in rates], 2)
    keys = jax.random.split(jax.random.key(0), 2 * len(rates))
    members = population.begin({"learnt": jnp.zeros(len(keys)), "key": keys}, config, keys)
    step, told = jax.jit(population.evolving(learner)), []
    for i in range(steps):
        members, metrics, _ = step(members, (config, None))
        told.append({"ticks": i + 1} | {f"train/{name}": np.asarray(x).tolist() for name, x in metrics.items()})
    return members, told


def test_rows_that_learn_nothing_take_over_the_good_rows_weights_and_rate():
    members, told = evolved([0.0, 0.0, 0.1, 0.5], steps=4, every=4)
    # Points are rows in pairs, one a seed. One of four is replaced: of the two that learnt nothing the later one.
    np.testing.assert_allclose(members.state["learnt"], [0, 0, 2, 2, 0.4, 0.4, 2, 2], rtol=1e-6)
    rates = np.asarray(members.config.train.ppo.learning_rate)
    assert set(np.round(rates[2:4], 6)) <= {0.4, 0.625} and (rates[[0, 1, 6, 7]] == [0, 0, 0.5, 0.5]).all()
    assert told[2]["train/pbt/parent"] == list(range(8)) and told[3]["train/pbt/parent"] == [0, 1, 6, 7, 4, 5, 6, 7]
    assert len({row.tobytes() for row in numbers(members.state["key"])[0]}) == 8  # each row draws its own numbers
    again, _ = evolved([0.0, 0.0, 0.1, 0.5], steps=4, every=4)
    for x, y in zip(numbers(members), numbers(again), strict=True):
        np.testing.assert_array_equal(x, y)


def test_numbers_stay_within_their_bounds_and_diverged_rows_are_never_copied():
    members, _ = evolved([0.0, 0.5, 1.0, 101.0], steps=24, every=1, bounds={RATE: (0.4, 0.6)})
    rates = np.asarray(members.config.train.ppo.learning_rate)
    assert ((rates >= 0.4 - 1e-6) & (rates <= 1.0)).all() and np.asarray(members.state["learnt"]).max() < 100


def test_the_schedule_is_that_of_the_weights():
    members, told = evolved([0.0, 0.5], steps=6, every=2)
    for row in range(4):
        found = schedule(told, [RATE], row)
        starts = [tick for tick, _ in found] + [6]
        total = sum(point[RATE] * (end - start) for (start, point), end in zip(found, starts[1:], strict=True))
        np.testing.assert_allclose(total, members.state["learnt"][row], rtol=1e-5)
        assert found[0][0] == 0


@pytest.fixture
def in_folder_with_config(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("slope.py").write_text(SLOPE)
    config = with_fields(CONFIG, env__name="slope.py:Slope", train__ticks=6 * 16, train__baselines=(), seeds=1)
    Path("config.yaml").write_text(to_yaml(config))


def test_a_sweep_evolves_and_goes_on_as_if_it_had_not_been_cut(in_folder_with_config, monkeypatch, capfd):
    args = ["config.yaml", "--axes", f"{RATE}=0,0.03", "--pbt", "2", *FEW]
    with tiny_steps():
        assert main([*args, "--run-dir", "whole"]) == 0
        with monkeypatch.context() as patch, pytest.raises(KilledError):
            die(patch, Checkpoints, "save", 3 + 2 + 3)  # in stage train, between two exchanges
            main([*args, "--run-dir", "cut"])
        assert main([*args, "--run-dir", "cut", "--resume"]) == 0
    for name in ("table.csv", "best.yaml"):
        assert Path("cut", name).read_bytes() == Path("whole", name).read_bytes()
    text = Path("whole/best.yaml").read_text()
    assert text.startswith("# What --pbt found") and f"# from tick 0: {RATE}=" in text
    assert 0 <= load_config("whole/best.yaml").train.ppo.learning_rate <= 0.03
    assert len(table_of("whole")) == 2 and "at the end" in capfd.readouterr().out


BAD = {
    "static": ("--axes train.ppo.num_envs=2,4 --pbt 1", "train.ppo.num_envs: expected numbers of stage train"),
    "of another stage": ("--axes options.lambda_kl=0,1 --pbt 1", "options.lambda_kl: expected numbers of stage train"),
    "optuna": (f"--axes {RATE}=0,1 --pbt 1 --optuna 2", "--pbt and --optuna"),
    "devices": (f"--axes {RATE}=0,1 --pbt 1 --shard seeds", "--pbt and --shard seeds"),
    "several programs": (f"--axes {RATE}=0,1 --pbt 1 --chunk 1", "expected its 2 points to run in one program"),
    "negative": (f"--axes {RATE}=0,1 --pbt -1", "--pbt: expected at least 0"),
}


@pytest.mark.parametrize(("args", "message"), BAD.values(), ids=BAD)
def test_what_cannot_evolve_is_told_in_one_line(in_folder_with_config, capfd, args, message):
    assert main(["config.yaml", *args.split(), "--run-dir", "new"]) == 2
    err = capfd.readouterr().err
    assert err.count("\n") == 1 and message in err and not Path("new").exists()
