"""The gate as a command: real ants are led through all arenas, and what cannot be led is refused."""

import csv
from pathlib import Path

import numpy as np
import pytest
from quadruped import write_checkout
from tiny_runs import CONFIG, with_fields
from written_runs import write_options, write_run

from taic_jax.experiments.evidence import navigate, steering
from taic_jax.experiments.evidence.plan import ARENAS


@pytest.fixture
def small_gate(monkeypatch):
    for name, value in {"CODES": 3, "STARTS": 2, "SECONDS": 0.3, "WARM_UP": 0.1, "EPISODES": 2}.items():
        monkeypatch.setattr(navigate, name, value)


def gate_of(folder: Path, task: str) -> dict[tuple[str, str], dict[str, str]]:
    """Run the gate on fresh options of two seeds; return its rows by run and measure."""
    config = with_fields(CONFIG, env__name=task)
    run, out, picture = write_run(folder / "run", config), folder / "ways.csv", folder / "ways.png"
    write_options(run, config, experience=False)
    assert steering.main([str(run), "--out", str(out), "--picture", str(picture)]) == 0
    assert picture.stat().st_size > 5000
    with out.open() as file:
        rows = {(Path(row["run"]).name, row["measure"]): row for row in csv.DictReader(file)}
    assert all(len(row["per_seed"].split()) == 2 for (run, _), row in rows.items() if run == "run")
    return rows


def test_ants_are_led_through_all_arenas(small_gate, tmp_path):
    rows = gate_of(tmp_path, "ant")
    assert {name.partition("/")[0] for run, name in rows if run == "run"} == {"codes", *ARENAS}
    orders = [float(rows["run", f"codes/order_{starts}"]["iqm"]) for starts in ("one", "many")]
    assert 0 < max(np.abs(orders)) < 1 and orders[0] > orders[1], "many starts blur what even random weights obey"
    stand, went = (float(rows[x, "ant_maze/final_distance"]["iqm"]) for x in ("stand", "run"))
    assert stand == 16 and abs(went - 16) < 4  # actions at random lead nowhere


def test_a_robot_of_menagerie_is_led_through_its_maze(small_gate, tmp_path, monkeypatch):
    pytest.importorskip("mujoco_menagerie")
    monkeypatch.setenv("MENAGERIE_ROOT", str(write_checkout(tmp_path)))
    rows, maze = gate_of(tmp_path, "menagerie:unitree_go2"), "menagerie:unitree_go2_maze"
    assert {name.partition("/")[0] for _, name in rows} == {"codes", maze}
    stand, went = (float(rows[x, f"{maze}/final_distance"]["iqm"]) for x in ("stand", "run"))
    assert stand == 16 and abs(went - 16) < 4


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
