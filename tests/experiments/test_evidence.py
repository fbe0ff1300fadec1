"""Evidence: what is run and what is not, the table of finished runs, and what figures refuse or mark."""

import csv
import dataclasses
import json
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from tiny_runs import CONFIG, PPO, tiny_steps, with_fields
from written_runs import TICKS, made_row, written

from taic_jax.config import Config
from taic_jax.experiments import drawing, evidence, figure5c, figure6, figure7, figure8, option_table, spaces
from taic_jax.experiments.cells import Cell, all_cells
from taic_jax.experiments.recovery import AFTER, recovery_of
from taic_jax.experiments.table import TableError, config_hash, difference, read_table, row_of, select
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
        return config_hash(difference(config, Path(folder)))

    def at(folder):
        return with_fields(CONFIG, options__experience=(f"{folder}/ant/strong",), seed=3)

    assert difference(with_fields(Config(seed=5, seeds=7), collect__capacity=1_000_000), tmp_path) == {}
    assert hashed(at("runs/a"), "runs/a") == hashed(dataclasses.replace(at("x"), seed=9), "x")
    assert hashed(at("x"), "x") != hashed(with_fields(at("x"), train__ticks=64), "x")


def test_the_runs_of_a_method_on_a_task_are_of_one_config(tmp_path):
    hashes: dict = {}
    for cell in all_cells(tmp_path):
        for task, method, _ in cell.keys:
            hashes.setdefault((task, method), set()).add(config_hash(difference(cell.config, tmp_path)))
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
        evidence.main([*arguments, "--only", "flat"])
        run_pipeline(options, tmp_path / "options")  # by another call of another program
        monkeypatch.setattr(evidence, "run_pipeline", lambda *_, **__: pytest.fail("it is finished"))
        evidence.main(arguments)
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
    evidence.main(arguments)
    assert capsys.readouterr().out == "nothing to do: the table has every row that these runs give\n"
    evidence.main([*arguments, "--list"])
    assert capsys.readouterr().out.count("in the table, took 0 minutes\n") == 2
    cells[0] = cells[0]._replace(config=with_fields(flat, collect__ticks=96))
    evidence.main([*arguments, "--list"])
    assert capsys.readouterr().out.count("of another config") == 1
    example = spaces.example_space(tmp_path / "options")
    assert np.shape(example["options"]) == (spaces.SHOWN, options.options.size)
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
            evidence.main([*arguments, *each])
            told.append([line.split("ticks  ")[-1] for line in capsys.readouterr().out.splitlines()])
    took = "in the table, took 0 minutes"
    assert told[0] == ["made when another run needs it", "missing", "missing", "3 runs to do"], "the first makes no row"
    assert told[2] == ["finished", took, took, "0 runs to do"]
    flat, transfer = read_table(table)
    assert (flat["method"], flat["pretraining"], transfer["method"]) == ("flat", 0, "transfer")
    assert transfer["pretraining"] == source.collect.ticks, "and not those of its own config"
    assert begun == [False, True]


def test_figure_7_marks_what_is_missing(table, tmp_path, monkeypatch):
    rows = [made_row("ant", "strong", 0, 20, 100.0), made_row("ant", "fixed-open-both", 0, 4, 1000.0)]
    rows[1]["pretraining"] = TICKS
    rows.append(made_row("ant", "long", 0, 20, 2000.0, ticks=2 * TICKS))
    marked = []
    monkeypatch.setattr(figure7, "mark", lambda axes, title, remarks: marked.append((title, *remarks)))
    out = tmp_path / "figure7.png"
    figure7.main(["--table", written(table, *rows), "--out", str(out), "--tasks", "ant", "hopper"])
    assert out.stat().st_size > 10_000
    (ant, hopper) = marked
    assert ant[:2] == ("ant", "Fix-len: 4 of 10 seeds") and "missing: flat PPO, paper-like," in ant[2]
    assert "missing: flat PPO, flat PPO, twice as long, flat PPO, paper-like" in hopper[1]
    with out.with_suffix(".csv").open() as file:
        options = next(row for row in csv.DictReader(file) if row["method"] == "fixed-open-both")
    # Every seed beats all of flat PPO, and none of flat PPO for twice as long, whose mean actions are worse.
    names = ("improvement", "improvement_at_same_total", "improvement_of_means", "improvement_of_means_at_same_total")
    assert [options[name] for name in ("mean", *names)] == ["-1001.5", "1", "0", "0", "1"]


def test_option_table_has_a_line_for_every_kind_that_was_run(table, tmp_path):
    """Flat PPO returns 100 to 104, options 101 to 105."""
    rows = [made_row("ant", "strong", 0, 5, 100.0), made_row("ant", "predict-closed-both", 0, 5, 101.0)]
    rows[1]["numbers"] |= {"space/kl": [1.5] * 5, "duration": [4.0] * 5}
    rows.append(made_row("hopper", "fixed-closed-both-tuned", 0, 2, 7.0))
    option_table.main(["--table", written(table, *rows), "--out", str(tmp_path / "options.md")])
    lines = [line.split(" | ") for line in (tmp_path / "options.md").read_text().splitlines() if line.startswith("| ")]
    headings, flat, options, tuned = lines[0], *lines[2:]
    assert flat[:3] == ["| ant", "flat PPO", ""] and tuned[:4] == ["| hopper", "fixed", "closed, fine-tuned", "both"]
    row = dict(zip(headings, options, strict=True))
    assert (row["termination"], row["decoder"], row["constraints"], row["seeds"]) == ("predict", "closed", "both", "5")
    values = np.arange(5)
    wins = np.mean(values[:, None] + 1 > values) + np.mean(values[:, None] + 1 == values) / 2
    assert row["P"] == f"{wins:.2f}" and row["return"].startswith("103 (10"), "seeds 102 to 104 are the middle half"
    assert row["KL, nats"] == "1.5" and row["ticks an option"] == "4" and row["active dimensions"] == ""


def test_figures_refuse_an_empty_table(table, capsys):
    for figure in (figure5c, figure6, figure7, figure8, option_table):
        with pytest.raises(SystemExit) as error:
            figure.main(["--table", str(table)])
        assert error.value.code == 2
    assert "evidence" in capsys.readouterr().err


def test_figure_5c_counts_who_recovered(table, tmp_path):
    rows = []
    for method, share in (("options", 1.0), ("flat", 0.0)):
        row = made_row("nav2d", method, 0, 50, 1.0)
        row["curves"]["success"] = np.full((50, 50), share).tolist()
        after = [share] * 40 + [1.0] * 10
        row["numbers"] |= {"success_before": [1.0] * 50, "success_after": after, "changed_at": [500.0] * 50}
        rows.append(row | {"numbers": row["numbers"] | {"ticks_after": [2.0 * AFTER] * 50}})
    out = tmp_path / "figure5c.png"
    figure5c.main(["--table", written(table, *rows), "--out", str(out)])
    lines = out.with_suffix(".csv").read_text().splitlines()
    assert lines[1].startswith("options,50,50,50,50,") and lines[2].startswith("flat,50,50,50,10,")


def test_figure_6_draws_what_the_table_holds_and_marks_the_rest(table, tmp_path, monkeypatch):
    """Of ten models without the constraints and four with them; the example's codes are where its options led to."""
    points = np.random.default_rng(0).normal(size=(100, 2))
    rows = []
    for method, seeds, level in (("fixed-open-none", 10, 0.2), ("predict-open-both", 4, 0.7)):
        row = made_row("half_cheetah", method, 0, seeds, 1.0)
        row["numbers"] |= {f"space/{name}": [level] * seeds for name in figure6.MEASURES}
        rows.append(row | {"example": {"options": points.tolist(), "ends": points.tolist()}})
    marked, out = {}, tmp_path / "figure6.png"
    monkeypatch.setattr(figure6, "mark", lambda axes, title, remarks, width: marked.update({title: tuple(remarks)}))
    figure6.main(["--table", written(table, *rows), "--out", str(out)])
    assert marked == {"RVAE": (), "Term-output": ("missing",), "Term-predict": ("4 of 10 seeds",)}
    assert out.stat().st_size > 50_000
    lines = out.with_suffix(".csv").read_text().splitlines()
    assert lines[1] == "half_cheetah,fixed-open-none,10,prior/one/distance_correlation,0.2,0.2,0.2,"
    assert len(lines) == 1 + 2 * len(figure6.MEASURES)


def test_figure_8_compares_every_measure_with_both_baselines(table, tmp_path):
    """Options return 10 to 14: more than flat PPO's 0 to 4, less than 20 to 24 of flat PPO from Ant's policy."""
    levels = {"flat": 0.0, "transfer": 20.0, "closed": 10.0, "open": 12.0}
    rows = [made_row("ant_maze", method, 0, 5, level) for method, level in levels.items()]
    for row, share in zip(rows, (0.0, 1.0, 0.4, 0.4), strict=True):
        row["numbers"] |= {"final/success": [share] * 4 + [1.0], "final/closest_approach": [share] * 5}
        row["numbers"]["final/upside_down"] = [1 - share] * 5
        row["curves"]["mean/success"] = np.outer([0, 0, 0, 1, 1], np.arange(50) == 20).tolist()
    out = tmp_path / "figure8.png"
    figure8.main(["--table", written(table, *rows), "--out", str(out), "--tasks", "ant_maze", "ant_turn"])
    assert out.stat().st_size > 10_000
    with out.with_suffix(".csv").open() as file:
        numbers = {(row["method"], row["measure"]): row for row in csv.DictReader(file)}
    closed = {measure: row for (method, measure), row in numbers.items() if method == "closed"}
    improvements = [(row["improvement_on_flat"], row["improvement_on_transfer"]) for row in closed.values()]
    assert dict(zip(closed, improvements, strict=True)) == {
        "first": ("0.5", "0.5"),
        "last": ("1", "0"),
        "mean_option": ("0", "1"),
        "final/success": ("0.82", "0.1"),
        "final/closest_approach": ("0", "1"),
        "final/upside_down": ("1", "0"),
        "training/return": ("1", "0"),
        "training/success": ("0.5", "0.5"),
    }
    assert closed["training/return"]["mean"] == "11.52", "of 12 on average, the last five points of a straight line"
    assert numbers["flat", "last"]["improvement_on_flat"] == "" and closed["last"]["per_seed"] == "10 11 12 13 14"
    assert closed["last"]["improvement_on_open"] == "0.18", "of the 25 pairs 3 are won and 3 are ties"
    at_goal = {name: numbers[name, "final/success"]["seeds_at_goal"] for name in levels}
    assert at_goal == {"flat": "1/5", "transfer": "5/5", "closed": "1/5", "open": "1/5"}
    assert closed["training/success"]["seeds_at_goal"] == "2/5", "at any time, and nothing is left at the end"
    assert closed["last"]["remarks"] == "5 of 10 seeds" and float(closed["last"]["p_holm"]) > 0.9
    assert closed["first"]["p_holm"] == "" and closed["final/success"]["mean"] == "0.52"


def test_colours_of_near_points_are_alike():
    points = np.array([[0.0, 0.0], [0.1, 0.1], [5.0, 9.0], [5.1, 0.2]])
    colours = figure6.as_colours(points)
    np.testing.assert_allclose(colours[0], figure6.CORNERS[0, 0])
    between = np.linalg.norm(colours[:, None] - colours[None], axis=-1)
    assert between[0, 1] < between[0, 2] and between[0, 1] < between[0, 3]


def test_the_style_of_figures_is_theirs_alone():
    before = dict(plt.rcParams)
    drawing.styled(lambda: None)()
    assert dict(plt.rcParams) == before and not before["figure.constrained_layout.use"]
