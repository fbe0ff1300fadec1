"""Evidence: what is run and what is not, and the table of finished runs."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from tiny_runs import CONFIG, PPO, tiny_steps, with_fields
from written_runs import made_row, written

from taic_jax.config import Config
from taic_jax.experiments.evidence import __main__ as evidence
from taic_jax.experiments.evidence import measures
from taic_jax.experiments.evidence.measures import AFTER, recovery_of
from taic_jax.experiments.evidence.plan import Cell, all_cells
from taic_jax.experiments.evidence.table import TableError, config_hash, difference, read_table, row_of, select
from taic_jax.pipeline import run_pipeline


@pytest.fixture
def table(tmp_path):
    return tmp_path / "table.jsonl"


def test_rows_come_back_and_a_broken_line_is_refused(table):
    rows = [made_row("ant", "strong", 0, 2, 0.123456789), made_row("ant", "strong", 2, 3, float("nan"))]
    written(table, *rows)
    assert [row["seeds"] for row in read_table(table)] == [2, 3]
    assert read_table(table)[0]["numbers"]["last"] == [0.12346, 1.1235]
    runs = select(read_table(table), "ant", "strong", minimum=6)
    assert runs.seeds == (0, 1, 2, 3, 4) and runs.curves["return"].shape == (5, 50)
    assert np.isnan(runs.numbers["last"][2:]).all() and runs.remarks == ("5 of 6 seeds",)
    table.write_text(table.read_text()[:-20])
    with pytest.raises(TableError, match=r"table\.jsonl: line 2 is no row"):
        read_table(table)


UNFIT = {
    "nothing": ([], "ant/strong: no row"),
    "two configs": ([{"seed": 0}, {"seed": 9, "config": "b"}], "ant/strong: rows of 2 configs under one name: a, b"),
    "a seed twice": ([{"seed": 0}, {"seed": 1}], "ant/strong: seed 1 stands in several rows"),
}


@pytest.mark.parametrize(("changes", "message"), UNFIT.values(), ids=UNFIT)
def test_what_may_not_be_averaged_is_refused(changes, message):
    rows = [made_row("ant", "strong", 0, 2, 1.0) | change for change in changes]
    with pytest.raises(TableError, match=message):
        select(rows, "ant", "strong")


def test_mixed_versions_and_diverged_seeds_are_remarked():
    rows = [made_row("ant", "weak", 0, 2, 1.0), made_row("ant", "weak", 2, 1, 1.0)]
    rows[1] |= {"versions": {"jax": "2"}, "stopped": {"0": {"quantity": "reward", "after": 3}}}
    assert select(rows, "ant", "weak").remarks == ("mixed versions of jax", "1 diverged")


def test_the_hash_tells_configs_apart_but_not_seeds_or_folders(tmp_path):
    def hashed(config, folder):
        return config_hash(config, Path(folder))

    def at(folder):
        return with_fields(CONFIG, options__experience=(f"{folder}/ant/strong",), seed=3)

    assert difference(with_fields(Config(seed=5, seeds=7), collect__capacity=1_000_000), tmp_path) == {}
    assert hashed(at("runs/a"), "runs/a") == hashed(dataclasses.replace(at("x"), seed=9), "x")
    assert hashed(at("x"), "x") != hashed(with_fields(at("x"), train__ticks=64), "x")


def test_the_runs_of_a_method_on_a_task_are_of_one_config(tmp_path):
    hashes: dict = {}
    for cell in all_cells(tmp_path):
        for task, method, _ in cell.keys:
            hashes.setdefault((task, method), set()).add(config_hash(cell.config, tmp_path))
    assert {len(found) for found in hashes.values()} == {1}
    assert len(set().union(*hashes.values())) > len(hashes) // 2


def test_recovery_by_hand():
    """Iterations of 50 000 ticks; the room changes within the third; the last 100 episodes within 200 000 count."""
    unit = AFTER // 4
    changed = [0, 0, 0.5, 1, 1, 1, 1]
    episodes = [200, 100, 60, 50, 50, 80, 900]
    reached = [0, 90, 30, 0, 40, 80, 0]
    rows = [
        {"ticks": (i + 1) * unit, "train/mean/changed": [c], "train/mean/success": [s / unit], "train/episodes": [e]}
        for i, (c, e, s) in enumerate(zip(changed, episodes, reached, strict=True))
    ]
    shares, numbers = recovery_of(rows, "train")
    np.testing.assert_allclose(shares[0, :3], [0, 0.9, 0.5])
    assert numbers["changed_at"] == [2.5 * unit] and numbers["ticks_after"] == [4.5 * unit]
    np.testing.assert_allclose(numbers["success_before"], [0.9])
    np.testing.assert_allclose(numbers["success_after"], [120 / 130])
    never = [row | {"train/mean/changed": [0]} for row in rows]
    assert np.isnan(recovery_of(never, "train")[1]["success_after"]).all()


def test_what_is_in_the_table_is_not_done_again(tmp_path):
    cells = all_cells(tmp_path)
    assert len({cell.name for cell in cells}) == len(cells)
    keys = [key for cell in cells for key in cell.keys]
    assert len(set(keys)) == len(keys), "no two runs give the same row"
    for position, cell in enumerate(cells):
        assert evidence.sources(cell, tmp_path) <= {before.name for before in cells[:position]}
    names = [cell.name for cell in evidence.plan(cells, ("hopper/fixed-open-both",), set(), tmp_path)]
    assert names == ["hopper/strong", "hopper/fixed-open-both"], "and what it learns from is done before"
    for options, task in {"open": "ant_turn/open", "steering": "ant_turn/closed"}.items():
        names = [cell.name for cell in evidence.plan(cells, (task,), set(), tmp_path)]
        assert names == ["ant/source", f"ant/source-{options}", task], "and what that learns from before it"
    assert evidence.plan(cells, ("hopper/fixed-open-both",), {("hopper", "fixed-open-both", 200)}, tmp_path) == []
    with pytest.raises(TableError, match="expected the start of a run's name, got hoper"):
        evidence.plan(cells, ("hoper",), set(), tmp_path)


def test_runs_are_done_once_and_taken_in_as_rows(monkeypatch, tmp_path, table, capsys):
    """A flat run, then options learnt from it; an interrupted call finds both finished and only makes the rows."""
    flat = with_fields(CONFIG, collect__env="", options__experience=(), evaluate__video_ticks=0)
    options = with_fields(flat, options__experience=(str(tmp_path / "flat"),), train__baselines=())
    options = with_fields(options, env__change_after=1, train__ppo=dataclasses.replace(PPO, reset_at_change=True))
    cells = [Cell("flat", flat, {"strong": "collect"}, "7"), Cell("options", options, {"options": "train"}, "5")]
    monkeypatch.setattr(evidence, "all_cells", lambda run_dir: cells)
    arguments = ["--run-dir", str(tmp_path), "--table", str(table)]
    with tiny_steps():
        assert evidence.main([*arguments, "--only", "flat"]) == 0
        run_pipeline(options, tmp_path / "options")  # by another call of another program
        monkeypatch.setattr(evidence, "run_pipeline", lambda *_, **__: pytest.fail("it is finished"))
        assert evidence.main(arguments) == 0
    strong, taken = read_table(table)
    assert (strong["method"], strong["pretraining"], strong["seed"], strong["seeds"]) == ("strong", 0, 0, 2)
    assert (taken["method"], taken["pretraining"]) == ("options", 48)
    assert taken["fields"]["options.experience"] == ["flat"] and taken["numbers"]["ticks_after"] == [0.0, 0.0]
    assert len(taken["curves"]["return"]) == 2 and len(taken["grid"]) == 50
    told = json.loads((tmp_path / "flat/summary.json").read_text())["methods"]["collect"]
    np.testing.assert_allclose(strong["numbers"]["last"], told["return"]["per_seed"], rtol=1e-4)
    monkeypatch.setattr(evidence, "do", lambda *_: pytest.fail("it is in the table"))
    monkeypatch.setattr(evidence, "open_devices", lambda *_: pytest.fail("nothing needs a device"))
    capsys.readouterr()
    assert evidence.main(arguments) == 0
    assert capsys.readouterr().out == "nothing to do: the table has every row that these runs give\n"
    assert evidence.main([*arguments, "--list"]) == 0
    assert capsys.readouterr().out.count("in the table, took 0 minutes\n") == 2
    cells[0] = cells[0]._replace(config=with_fields(flat, collect__ticks=96))
    assert evidence.main([*arguments, "--list"]) == 0
    assert capsys.readouterr().out.count("of another config") == 1
    example = measures.example_space(tmp_path / "options")
    assert np.shape(example["options"]) == (measures.SHOWN, options.options.size)
    ends = np.array(example["ends"])
    assert np.isfinite(ends).all() and (ends.std(axis=0) > 0).all(), "options lead from one state to several"
    evidence_row = row_of(tmp_path / "flat", tmp_path, "strong", "collect")
    assert evidence_row["config"] == strong["config"]


def test_flat_ppo_from_another_runs_policy_is_a_run_of_its_own(monkeypatch, tmp_path, table, capsys):
    """It starts where the source's policy ended, and counts the interactions of that."""
    source = with_fields(CONFIG, collect__env="", options__experience=(), evaluate__video_ticks=0)
    apart = with_fields(source, collect__ticks=16, options__source=str(tmp_path / "source"))
    configs = {stage: with_fields(apart, train__baselines=(stage,)) for stage in ("flat", "transfer")}
    cells = [Cell("source", source, {}, "8"), *(Cell(f"nav2d/{s}", c, {s: s}, "8") for s, c in configs.items())]
    monkeypatch.setattr(evidence, "all_cells", lambda run_dir: cells)
    begun, train = [], evidence.train_baseline
    monkeypatch.setattr(evidence, "train_baseline", lambda *x: (begun.append(x[3] is not None), train(*x))[1])
    arguments, told = ["--run-dir", str(tmp_path), "--table", str(table)], []
    with tiny_steps():
        for each in (["--list"], [], ["--list"]):
            assert evidence.main([*arguments, *each]) == 0
            told.append([line.split("ticks  ")[-1] for line in capsys.readouterr().out.splitlines()])
    took = "in the table, took 0 minutes"
    assert told[0] == ["made when another run needs it", "missing", "missing", "3 runs to do"], "the first makes no row"
    assert told[2] == ["finished", took, took, "0 runs to do"]
    flat, transfer = read_table(table)
    assert (flat["method"], flat["pretraining"], transfer["method"]) == ("flat", 0, "transfer")
    assert transfer["pretraining"] == source.collect.ticks, "and not those of its own config"
    assert begun == [False, True]
