"""What a report collects from folders whose every number is known, and what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
from tiny_runs import CONFIG, with_fields
from written_runs import method, rows, write_options, write_run

from taic_jax.analysis.statistics import bootstrap_interval
from taic_jax.report.__main__ import main
from taic_jax.report.curves import thinned
from taic_jax.report.option_plots import principal_plane
from taic_jax.report.page import GENERATOR, Detail, collect, render

NO_PLOTS = Detail(options=0)


@pytest.fixture
def run(tmp_path) -> Path:
    return write_run(tmp_path / "a")


def one(folder: Path, detail: Detail = NO_PLOTS) -> dict:
    (found,) = collect([folder], detail)["runs"]
    return found


def stage(found: dict, name: str) -> dict:
    return next(stage for stage in found["stages"] if stage["stage"] == name)


def test_curves_hold_every_seed_and_the_statistics_over_them(run):
    train = stage(one(run), "train")
    assert (train["x"], train["task"], train["pretraining"]) == ([16, 32, 48], "nav2d", 48)
    curve = train["metrics"]["return"]
    assert curve["seeds"] == [[11, 12, 13], [13, 16, 19]] and curve["iqm"] == [12, 14, 16]
    assert [curve["low"][2], curve["high"][2]] == pytest.approx(bootstrap_interval(np.array([13.0, 19.0])), rel=1e-4)
    assert train["metrics"]["entropy"]["low"] == [-1, -2, -3] and "durations" not in train["metrics"]


def test_no_statistics_where_a_seed_has_no_number(run):
    curve = stage(one(run), "learn")["metrics"]["kl_loss"]
    assert curve["seeds"] == [[0.5], [None]] and curve["iqm"] == curve["low"] == [None]


def test_curves_are_thinned_evenly_and_say_so(run):
    train = stage(one(run, Detail(points=2, options=0)), "train")
    assert (train["x"], train["iterations"]) == ([16, 48], 3)
    assert thinned(10, 4) == [0, 3, 6, 9] and thinned(3, 300) == [0, 1, 2]


def test_methods_are_those_of_the_summary(run):
    taic, flat = one(run)["methods"]
    assert taic["return"] == {key: method(11.0, 13.0)["return"][key] for key in ("per_seed", "mean", "iqm", "ci95")}
    assert taic["return_untrained"]["iqm"] == 0 and taic["duration"]["iqm"] == 1.75
    assert (taic["ticks"], taic["pretraining"], flat["ticks"], flat["pretraining"]) == (48, 48, 48, 0)
    assert (flat["stage"], flat["return"]["iqm"]) == ("collect", 2)
    assert one(run)["histograms"][0]["share"] == [0.25, 0.75]


def test_a_run_without_a_summary_is_partial_and_its_durations_are_those_of_training(tmp_path):
    found = one(write_run(tmp_path / "a", finished=False, written=rows()[:-2]))
    assert not found["facts"]["finished"] and "stage train is at 32 of 48 ticks" in found["notes"][0]
    collector, train = found["methods"]
    assert collector["evaluated"] and collector["return"]["iqm"] == 2
    assert not train["evaluated"] and train["ticks"] == 32
    assert found["histograms"][0]["share"] == [0.25, 0.75] and "32 ticks" in found["histograms"][0]["of"]


def test_a_stopped_seed_is_told_and_nothing_is_said_of_the_others_alone(run):
    told = json.loads((run / "summary.json").read_text())
    told["stopped"] = {"train": {"1": {"quantity": "gradients", "after": 32}}}
    told["methods"]["taic"]["return"]["per_seed"][1] = None
    (run / "summary.json").write_text(json.dumps(told))
    found = one(run)
    assert found["notes"] == ["seed 1 stopped in stage train after 32: gradients was not finite"]
    assert found["methods"][0]["return"] == {"per_seed": [11, None], "mean": None, "iqm": None, "ci95": [None, None]}


def test_pretraining_elsewhere_is_counted_where_it_can_be(run, tmp_path):
    there = with_fields(CONFIG, options__source=str(run))
    gone = with_fields(CONFIG, options__experience=("collect", "gone/b"))
    taken, missing = (one(write_run(tmp_path / name, config)) for name, config in (("t", there), ("m", gone)))
    assert (stage(taken, "train")["pretraining"], stage(taken, "train")["uncounted"]) == (48, [])
    assert (stage(missing, "train")["pretraining"], stage(missing, "train")["uncounted"]) == (48, ["gone/b"])


def test_runs_that_lead_to_each_other_are_not_counted_for_ever(tmp_path):
    for name, other in (("a", "b"), ("b", "a")):
        write_run(tmp_path / name, with_fields(CONFIG, options__source=str(tmp_path / other)))
    assert stage(one(tmp_path / "a"), "train")["uncounted"]


@pytest.mark.parametrize("experience", [True, False])
def test_option_space_of_windows_or_of_the_prior(run, experience):
    write_options(run, experience=experience)
    plot = one(run, Detail(options=20))["options"]
    assert plot["drawn"] == ("windows" if experience else "prior") and plot["size"] == 2
    assert len(plot["x"]) == len(plot["y"]) == 20 and sum(plot["shares"]) == pytest.approx(1, abs=1e-2)
    if experience:  # two ticks, of i + 1 each
        assert plot["changes"] == [[2] * 20, [4] * 20] and plot["r2"] == [None, None]
    else:
        assert plot["why"] and np.std(plot["changes"][0]) > 0


def test_principal_plane_by_hand():
    codes = np.array([[3.0, 0, 1], [-3, 0, 1], [0, 1, 1], [0, -1, 1]])
    plane, shares = principal_plane(codes)
    np.testing.assert_allclose(plane, codes[:, :2], atol=1e-12)
    np.testing.assert_allclose(shares, [0.9, 0.1])
    plane, shares = principal_plane(codes[:, :1])
    assert (plane[:, 1] == 0).all() and shares.tolist() == [1, 0]


def test_a_sweep_is_its_points_each_with_its_own_seeds(tmp_path):
    sweep = tmp_path / "s"
    axis, points = "train.ppo.learning_rate", [{"train.ppo.learning_rate": x} for x in (0.1, 0.2)]
    doubled = [{k: v * 2 if isinstance(v, list) else v for k, v in row.items()} for row in rows()]
    for row in doubled:
        if "train/return" in row:
            row["train/return"][2:] = [7.0, 9.0]
    chunk = write_run(sweep / "chunk-000", written=doubled)
    told = json.loads((chunk / "summary.json").read_text())
    told["methods"] = {"taic": method(11.0, 13.0, 7.0, 9.0)}
    (chunk / "summary.json").write_text(json.dumps(told))
    (sweep / "config.yaml").write_text((chunk / "config.yaml").read_text())
    plan = {"axes": [f"{axis}=0.1,0.2"], "samples": 0, "optuna": 0, "size": 2, "points": points, "chunks": [[0, 1]]}
    (sweep / "plan.json").write_text(json.dumps(plan))
    (sweep / "table.csv").write_text(f"point,{axis},iqm\n0,0.1,12\n1,0.2,8\n")
    data = collect([sweep], NO_PLOTS)
    assert [run["config"][axis] for run in data["runs"]] == [0.1, 0.2]
    assert [run["methods"][0]["return"]["iqm"] for run in data["runs"]] == [12, 8]
    assert stage(data["runs"][1], "train")["metrics"]["return"]["iqm"] == [8, 8, 8]
    assert data["sweeps"][0]["axes"] == [axis] and len(data["sweeps"][0]["table"]) == 2
    with pytest.raises(ValueError, match=r"expected 2 seeds.*a sweep's chunk is shown by its sweep's folder"):
        collect([chunk], NO_PLOTS)


def test_differences_are_told_and_names_tell_runs_apart(tmp_path):
    hopper = with_fields(CONFIG, env__name="hopper", seed=7)
    folders = [write_run(tmp_path / "x" / "r"), write_run(tmp_path / "y" / "r", hopper)]
    data = collect(folders, NO_PLOTS)
    assert [run["name"] for run in data["runs"]] == ["x/r", "y/r"]
    assert data["notes"] == ["the runs differ in task: nav2d, hopper"]


def test_half_a_row_is_left_out_and_told(run):
    with (run / "metrics.jsonl").open("a") as file:
        file.write('{"stage": "tra')
    found = one(run)
    assert len(stage(found, "train")["x"]) == 3 and any("half-written" in note for note in found["notes"])


def test_a_config_of_another_version_is_shown_as_it_is(run):
    with (run / "config.yaml").open("a") as file:
        file.write("gone: 3\n")
    found = one(run, Detail(options=5))
    assert found["config"]["gone"] == 3 and found["options"] == {"missing": "the config is of another version"}


def test_nothing_in_a_config_ends_the_script(tmp_path):
    evil = "</script><script>alert(1)</script>"
    page = render(collect([write_run(tmp_path / "a", with_fields(CONFIG, options__source=evil))], NO_PLOTS))
    assert evil not in page and page.count("</script>") == 2
    embedded = page.partition('id="data">')[2].partition("</script>")[0]
    assert json.loads(embedded)["runs"][0]["config"]["options.source"] == evil


BROKEN = {
    "no run": (lambda run: (run / "config.yaml").unlink(), "expected the folder of a run"),
    "no row": (lambda run: (run / "metrics.jsonl").write_text('{"stage": "col'), "at least one finished iteration"),
    "no rows": (lambda run: (run / "metrics.jsonl").unlink(), "at least one finished iteration"),
    "not a row": (lambda run: (run / "metrics.jsonl").write_text("{}\n"), "line 1: expected a row"),
    "not JSON": (lambda run: (run / "metrics.jsonl").write_text("a\n"), "line 1: expected a row"),
    "not a config": (lambda run: (run / "config.yaml").write_text("a: 1"), "expected the resolved config of a run"),
    "not YAML": (lambda run: (run / "config.yaml").write_text("a: [1"), "expected YAML"),
    "other summary": (lambda run: (run / "summary.json").write_text("{}"), "expected the summary of a run"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_no_run_is_told_in_one_line(run, tmp_path, capsys, name):
    damage, expected = BROKEN[name]
    damage(run)
    assert main([str(run), "--out", str(tmp_path / "r.html")]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and expected in err and not (tmp_path / "r.html").exists()


def test_mistakes_on_the_command_line(run, tmp_path, capsys):
    (tmp_path / "mine.html").write_text("mine")
    for args, expected in (
        ([], "at least one folder of a run, got none"),
        ([str(run), str(run)], "expected every run once, got it 2 times"),
        ([str(tmp_path)], f"holds {run}"),
        ([str(run), "--points", "1"], "--points: expected at least 2, got 1"),
        ([str(run), "--poins", "9"], "the nearest is --points"),
        ([str(run), "--out", str(tmp_path)], "expected a file to write"),
        ([str(run), "--out", str(tmp_path / "mine.html")], "is no report, so it is not replaced"),
        ([str(run), "--out", str(tmp_path / "gone" / "r.html")], "expected a file in a folder that is there"),
    ):
        assert main(args) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1 and expected in err, err
    assert (tmp_path / "mine.html").read_text() == "mine"


def test_writes_a_page_and_replaces_it(run, tmp_path, capsys):
    out = tmp_path / "r.html"
    for _ in range(2):
        assert main([str(run), "--out", str(out), "--options", "0"]) == 0
    text = out.read_text()
    assert GENERATOR in text and "data:image/webp;base64," in text and "{{" not in text
    assert capsys.readouterr().out == f"{out}\n" * 2
    assert main([str(run), "--out", str(out), "--no-videos", "--options", "0"]) == 0
    assert "data:image/webp;base64," not in out.read_text()
