"""Each task's physics: that the table has what it promises. Not what it measures."""

import json

import pytest

from taic_jax.experiments.benchmark import worlds


def test_table_of_worlds_has_a_row_for_each_task_and_backend(tmp_path, capsys):
    out = tmp_path / "worlds.json"
    arguments = ["--tasks", "nav2d", "hopper", "--backends", "mujoco", "--num-envs", "4", "--length", "4", "--json"]
    assert worlds.main([*arguments, str(out)]) == 0
    nav2d, hopper = json.loads(out.read_text())
    assert (nav2d["task"], nav2d["obs"], nav2d["act"], nav2d["envs"]) == ("nav2d", 2, 2, 4)
    assert (hopper["task"], hopper["backend"], hopper["obs"], hopper["contacts"]) == ("hopper", "mujoco", 11, 2)
    assert hopper["ratio"] == pytest.approx(hopper["ticks_per_second"] / hopper["bare"], rel=0.5)
    assert "hopper" in capsys.readouterr().out


def test_soak_counts_what_leaves_the_arena(tmp_path, capsys):
    out = tmp_path / "soak.json"
    arguments = ["--soak", "--tasks", "ant_maze", "--backends", "mujoco", "--num-envs", "2", "--length", "8", "--json"]
    assert worlds.main([*arguments, str(out)]) == 0
    assert json.loads(out.read_text()) == [
        {"task": "ant_maze", "backend": "mujoco", "states": 64 * 8, "outside": 0, "nan": 0}
    ]
    heading, row = (line.split() for line in capsys.readouterr().out.splitlines())
    assert dict(zip(heading, row, strict=True)) == {"task": "ant_maze", "backend": "mujoco", "states": "512",
                                                    "outside": "0", "nan": "0"}  # fmt: skip
