"""Figures: what they draw and count of a table of finished runs, and what they refuse or mark."""

import csv

import matplotlib.pyplot as plt
import numpy as np
import pytest
from written_runs import TICKS, made_row, written

from taic_jax.experiments.evidence.measures import AFTER
from taic_jax.experiments.evidence.plan import ARENAS
from taic_jax.experiments.figures import drawing, figure6
from taic_jax.experiments.figures.__main__ import COMMANDS, main


@pytest.fixture
def table(tmp_path):
    return tmp_path / "table.jsonl"


def test_figure_7_marks_what_is_missing(table, tmp_path, monkeypatch):
    rows = [made_row("ant", "strong", 0, 20, 100.0), made_row("ant", "fixed-open-both", 0, 4, 1000.0)]
    rows[1]["pretraining"] = TICKS
    rows.append(made_row("ant", "long", 0, 20, 2000.0, ticks=2 * TICKS))
    marked = []
    monkeypatch.setattr(drawing, "mark", lambda axes, title, remarks: marked.append((title, *remarks)))
    out = tmp_path / "figure7.png"
    assert main(["7", "--table", written(table, *rows), "--out", str(out), "--tasks", "ant", "hopper"]) == 0
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
    assert main(["table", "--table", written(table, *rows), "--out", str(tmp_path / "options.md")]) == 0
    lines = [line.split(" | ") for line in (tmp_path / "options.md").read_text().splitlines() if line.startswith("| ")]
    headings, flat, options, tuned = lines[0], *lines[2:]
    assert flat[:3] == ["| ant", "flat PPO", ""] and tuned[:4] == ["| hopper", "fixed", "closed, fine-tuned", "both"]
    row = dict(zip(headings, options, strict=True))
    assert (row["termination"], row["decoder"], row["constraints"], row["seeds"]) == ("predict", "closed", "both", "5")
    values = np.arange(5)
    wins = np.mean(values[:, None] + 1 > values) + np.mean(values[:, None] + 1 == values) / 2
    assert row["P"] == f"{wins:.2f}" and row["return"].startswith("103 (10"), "seeds 102 to 104 are the middle half"
    assert row["KL, nats"] == "1.5" and row["ticks an option"] == "4" and row["active dimensions"] == ""


@pytest.mark.parametrize("figure", COMMANDS)
def test_figures_refuse_an_empty_table(figure, table, capsys):
    assert main([figure, "--table", str(table)]) == 2
    assert "python -m taic_jax.experiments.evidence" in capsys.readouterr().err


def test_an_unknown_method_is_refused(table, capsys):
    assert main(["7", "--table", str(table), "--methods", "strong", "fast"]) == 2
    assert "--methods: expected some of strong, long, weak" in capsys.readouterr().err


def test_figure_5c_counts_who_recovered(table, tmp_path):
    rows = []
    for method, share in (("options", 1.0), ("flat", 0.0)):
        row = made_row("nav2d", method, 0, 50, 1.0)
        row["curves"]["success"] = np.full((50, 50), share).tolist()
        after = [share] * 40 + [1.0] * 10
        row["numbers"] |= {"success_before": [1.0] * 50, "success_after": after, "changed_at": [500.0] * 50}
        rows.append(row | {"numbers": row["numbers"] | {"ticks_after": [2.0 * AFTER] * 50}})
    out = tmp_path / "figure5c.png"
    assert main(["5c", "--table", written(table, *rows), "--out", str(out)]) == 0
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
    monkeypatch.setattr(drawing, "mark", lambda axes, title, remarks, width: marked.update({title: tuple(remarks)}))
    assert main(["6", "--table", written(table, *rows), "--out", str(out)]) == 0
    assert marked == {"RVAE": (), "Term-output": ("missing",), "Term-predict": ("4 of 10 seeds",)}
    assert out.stat().st_size > 50_000
    lines = out.with_suffix(".csv").read_text().splitlines()
    assert lines[1] == "half_cheetah,fixed-open-none,10,prior/one/distance_correlation,0.2,0.2,0.2,"
    assert len(lines) == 1 + 2 * len(figure6.MEASURES)


def test_figure_8_compares_every_measure_with_both_baselines(table, tmp_path):
    """Options return 10 to 14: more than flat PPO's 0 to 4, less than 20 to 24 of flat PPO from Ant's policy."""
    levels = {"flat": 0.0, "transfer": 20.0, "closed": 10.0, "open": 12.0}
    rows = [made_row("ant_turn", method, 0, 5, level) for method, level in levels.items()]
    for row, share in zip(rows, (0.0, 1.0, 0.4, 0.4), strict=True):
        row["numbers"] |= {"final/success": [share] * 4 + [1.0], "final/closest_approach": [share] * 5}
        row["numbers"]["final/upside_down"] = [1 - share] * 5
        row["curves"]["mean/success"] = np.outer([0, 0, 0, 1, 1], np.arange(50) == 20).tolist()
    out = tmp_path / "figure8.png"
    assert main(["8", "--table", written(table, *rows), "--out", str(out), "--tasks", "ant_turn", "ant_maze"]) == 0
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
    assert closed["last"]["remarks"] == "5 of 10 seeds" and float(closed["mean_option"]["p_holm"]) > 0.9
    assert closed["last"]["p_holm"] == "" and closed["final/success"]["mean"] == "0.52"


def test_figure_8_compares_options_that_steer_with_flat_ppo_of_as_many_interactions(table, tmp_path):
    levels = {"steering": 10.0, "total": 0.0, "walker": 20.0, "closed": 99.0}
    rows = [made_row("ant_push", method, 0, 10, level) for method, level in levels.items()]
    out = tmp_path / "figure8.png"
    assert main(["8", "--table", written(table, *rows), "--out", str(out), "--tasks", "ant_push"]) == 0
    with out.with_suffix(".csv").open() as file:
        numbers = {(row["method"], row["measure"]): row for row in csv.DictReader(file)}
    assert {method for method, _ in numbers} == levels.keys() - {"closed"}, "a row of an earlier plan is not drawn"
    ours = numbers["steering", "last"]
    assert (ours["improvement_on_total"], ours["improvement_on_walker"], ours["improvement_on_flat"]) == ("1", "0", "")
    assert ours["remarks"] == "" and numbers["steering", "mean_option"]["p_holm"] != ""
    assert numbers["total", "mean_option"]["p_holm"] == ""


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


def test_the_gate_counts_the_models_that_pass(table, tmp_path):
    """Of three models the second overturns ants before the block, and the third does not cross the chasm."""
    good = {"codes/speed": 1.3, "codes/agreement": 0.97, "codes/order_one": 0.2, "codes/order_many": 0.1}
    good |= {
        f"{name}/{measure}": x for name in ARENAS for measure, x in (("success", 0.8), ("overturned_per_1000", 0.2))
    }
    models = [good, good | {"ant_push/overturned_per_1000": 0.3}, good | {"ant_fall/success": 0.7}]
    numbers = {name: [model[name] for model in models] for name in good}
    row = made_row("ant", "gate", 1000, 3, 0.0, numbers=numbers, curves={}, grid=[])
    out = tmp_path / "gate.csv"
    assert main(["gate", "--table", written(table, row), "--out", str(out)]) == 0
    with out.open() as file:
        lines = {line["measure"]: line for line in csv.DictReader(file)}
    assert len(lines) == 4 + 2 * len(ARENAS) + 2 and lines["codes/speed"]["remarks"] == "3 of 10 seeds"
    assert lines["reach"]["per_seed"] == "1 1 0" and lines["pass"]["per_seed"] == "1 0 0"
    assert float(lines["ant_fall/success"]["low"]) >= 0.7 and lines["ant_fall/success"]["iqm"] != ""
    assert main(["gate", "--table", str(tmp_path / "none.jsonl"), "--out", str(tmp_path / "no.csv")]) == 2
