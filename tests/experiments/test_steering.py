"""The gate as a command: real ants are led through all arenas, and what cannot be led is refused."""

import csv

import numpy as np
import pytest
from tiny_runs import CONFIG, with_fields
from written_runs import write_options, write_run

from taic_jax.experiments.evidence import navigate, steering


def test_ants_are_led_through_all_arenas(tmp_path, monkeypatch):
    for name, value in {"CODES": 3, "STARTS": 2, "SECONDS": 0.3, "WARM_UP": 0.1, "EPISODES": 2}.items():
        monkeypatch.setattr(navigate, name, value)
    config = with_fields(CONFIG, env__name="ant")
    run, out, picture = write_run(tmp_path / "run", config), tmp_path / "ways.csv", tmp_path / "ways.png"
    write_options(run, config, experience=False)
    assert steering.main([str(run), "--out", str(out), "--picture", str(picture)]) == 0
    with out.open() as file:
        rows = {(row["run"], row["measure"]): row for row in csv.DictReader(file)}
    measured = {name.partition("/")[0] for run, name in rows if run.endswith("/run")}
    assert measured == {"codes", "ant_maze", "ant_push", "ant_fall"} and picture.stat().st_size > 5000
    orders = [float(rows[f"{tmp_path.name}/run", f"codes/order_{starts}"]["iqm"]) for starts in ("one", "many")]
    assert 0 < max(np.abs(orders)) < 1 and orders[0] > orders[1], "many starts blur what even random weights obey"
    stand, went = (float(rows[x, "ant_maze/final_distance"]["iqm"]) for x in ("stand", f"{tmp_path.name}/run"))
    assert stand == 16 and abs(went - 16) < 4  # actions at random lead nowhere
    assert all(len(row["per_seed"].split()) == 2 for (run, _), row in rows.items() if run.endswith("/run"))


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("half_cheetah", True, "expected options of a robot that walks in every direction, as ant, got half_cheetah"),
        ("nav2d", True, "expected options of a robot that walks in every direction, as ant, got nav2d"),
        ("ant", False, "expected a run that got this far, or its option model; got none"),
    ],
)
def test_what_cannot_be_steered_is_refused(task, options, message, tmp_path, capsys):
    config = with_fields(CONFIG, env__name=task)
    run = write_run(tmp_path / "run", config)
    if options:
        write_options(run, config, experience=False)
    assert steering.main([str(run), "--out", str(tmp_path / "ways.csv")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "ways.csv").exists()


def test_no_run_is_refused(tmp_path, capsys):
    assert steering.main(["--out", str(tmp_path / "ways.csv")]) == 2
    assert "expected the folder of at least one run, got none" in capsys.readouterr().err
    assert not (tmp_path / "ways.csv").exists()
