"""Rows made anew beside those of the table: what came out again and what did not."""

import csv

import pytest
from written_runs import made_row, written

from taic_jax.experiments.evidence import reproduce
from taic_jax.experiments.evidence.table import TABLE, read_table


def compared(folder, committed, fresh):
    """Return the lines of the comparison of two tables of these rows, or the exit code where there is none."""
    tables = [written(folder / f"{name}.jsonl", *rows) for name, rows in (("table", committed), ("again", fresh))]
    code = reproduce.main([tables[1], "--table", tables[0], "--out", str(folder / "again.csv")])
    if code:
        return code
    return list(csv.DictReader((folder / "again.csv").read_text().splitlines()))


def test_a_row_comes_out_again_where_its_mean_is_within_the_interval(tmp_path):
    levels = ((100.0, 100.5), (500.0, 400.0), (500.0, 600.0))
    committed, fresh = (
        [made_row("ant", "strong", 10 * i, 10, level[k]) for i, level in enumerate(levels)] for k in (0, 1)
    )
    lines = [line for line in compared(tmp_path, committed, fresh) if line["measure"] == "return"]
    # The interquartile mean of ten numbers in a row is the middle of them.
    assert [(line["value"], line["again"], line["within"]) for line in lines] == [
        ("104.5", "105", "True"), ("504.5", "404.5", "False"), ("504.5", "604.5", "False")
    ]  # fmt: skip
    assert float(lines[0]["p"]) > 0.5 and float(lines[1]["p"]) < 0.001


def test_the_share_that_recovered_has_its_exact_interval(tmp_path):
    rows = [made_row("nav2d", "options", 0, 10, 1.0) for _ in range(2)]
    for row, count in zip(rows, (9, 5), strict=True):
        row["numbers"]["success_after"] = [0.95] * count + [0.1] * (10 - count)
    (line,) = [line for line in compared(tmp_path, rows[:1], rows[1:]) if line["measure"] == "recovered"]
    assert (line["value"], line["low"], line["high"]) == ("0.9", "0.55498", "0.99747")  # Clopper and Pearson
    assert (line["again"], line["within"], line["p"]) == ("0.5", "False", "")


def test_the_committed_table_has_every_measure():
    known = {name for row in read_table(TABLE) for name in row["numbers"]}
    assert set(reproduce.MEASURES.values()) | {"success_after"} <= known


UNFIT = {
    "no rows": ([], "no rows; python -m taic_jax.experiments.evidence --table makes them"),
    "another config": ([made_row("ant", "strong", 0, 2, 1.0, config="b")], "made with config b, but the table has a"),
    "other seeds": ([made_row("ant", "strong", 4, 2, 1.0)], "the table has no row of 2 seeds from 4"),
}


@pytest.mark.parametrize(("fresh", "message"), UNFIT.values(), ids=UNFIT)
def test_what_has_no_counterpart_is_refused(fresh, message, tmp_path, capsys):
    assert compared(tmp_path, [made_row("ant", "strong", 0, 2, 1.0)], fresh) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "again.csv").exists()
