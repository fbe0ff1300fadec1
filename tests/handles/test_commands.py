"""The command `taic` on a finished run: evaluations and films that agree with it, and every mistake in one line."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image
from tiny_runs import CONFIG, files_of, with_fields

import taic_jax as taic
from taic_jax.__main__ import BARE, COMMANDS, main
from taic_jax.command_line import COMMON_FIELDS
from taic_jax.config.files import preset_names
from taic_jax.envs.locomotion import Locomotion
from taic_jax.handles import assess, play
from taic_jax.handles.play import MARK, with_compass, with_label, with_options
from taic_jax.run import PROGRAM
from taic_jax.runtime.files import save_json
from taic_jax.runtime.run_folder import RunFolder


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "run"
    taic.run_pipeline(with_fields(CONFIG, evaluate__video_ticks=0), folder, quiet=True)
    return folder


@pytest.mark.parametrize("explore", [False, True])
def test_evaluate_measures_every_seed_as_the_function_does(run, tmp_path, monkeypatch, capsys, explore):
    monkeypatch.setenv("COLUMNS", "160")
    before, out = files_of(run), tmp_path / "evaluation.json"
    args = ["--episodes", "3", "--key", "5", "--out", str(out), *["--explore"] * explore]
    assert main(["evaluate", str(run), *args]) == 0
    table, told = capsys.readouterr().out, json.loads(out.read_text())
    assert "options (TAIC)" in table and "flat PPO" in table and "nav2d, 3 episodes a seed" in table
    assert "final/distance_to_goal" in table and "ticks of an option" in table
    assert (told["env"], told["episodes"], told["key"], told["explore"]) == ("nav2d", 3, 5, explore)
    handle, keys = taic.load(run), jax.random.split(jax.random.key(5), 2)
    for method in ("taic", "flat"):
        direct = [taic.evaluate(handle.env, handle.agents[method][k], keys[k], 3, float(explore)) for k in range(2)]
        for name in ("return", "final/distance_to_goal"):
            expected = [float(values[name]) for values in direct]
            np.testing.assert_allclose(told["methods"][method][name]["per_seed"], expected, rtol=1e-4)
    assert files_of(run) == before


def test_a_seed_that_diverged_in_training_has_no_numbers(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "160")
    lame, out = Path(shutil.copytree(run, tmp_path / "lame")), tmp_path / "evaluation.json"
    summary = RunFolder(lame).summary()
    summary["methods"]["taic"]["return"]["per_seed"][1] = None
    save_json(RunFolder(lame).summary_path, summary)
    assert main(["evaluate", str(lame), "--episodes", "1", "--out", str(out)]) == 0
    results, table = json.loads(out.read_text())["methods"], capsys.readouterr().out
    for values in results["taic"].values():
        assert values["per_seed"][0] is not None and values["per_seed"][1] is values["mean"] is values["iqm"] is None
    assert None not in results["flat"]["return"]["per_seed"]
    assert "a seed diverged" in table and f"{results['flat']['return']['mean']:,.1f}" in table


@pytest.mark.parametrize(("command", "work"), [("evaluate", (assess, "measure")), ("play", (play, "film"))])
def test_a_folder_of_the_result_that_is_missing_is_refused_before_the_work(run, monkeypatch, capsys, command, work):
    monkeypatch.setattr(*work, lambda *args: pytest.fail("the work was begun"))
    assert main([command, str(run), "--out", "missing/a.webp"]) == 2
    expected = "--out: expected a file in a folder that exists, got missing/a.webp; the nearest valid value is a.webp"
    assert capsys.readouterr().err == f"taic_jax: error: {expected}\n" and not Path("missing").exists()


def test_play_films_an_episode_of_methods_side_by_side(run, tmp_path, capsys):
    before, film = files_of(run), tmp_path / "film.gif"
    assert main(["play", str(run), "--methods", "taic", "flat", "--seed", "1", "--ticks", "7", "--out", str(film)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("options (TAIC): return ") and lines[0].endswith("in 7 ticks and 4 decisions")
    assert lines[1].startswith("flat PPO: return ") and lines[1].endswith("in 7 ticks and 7 decisions")
    assert lines[2] == str(film)
    env = taic.make_env("nav2d")
    with Image.open(film) as image:
        single = env.render(jax.tree.map(lambda x: x[None], env.reset(jax.random.key(0)).physics))
        assert image.size == (2 * single.shape[2], single.shape[1]) and image.n_frames > 1
    assert files_of(run) == before


def test_play_draws_only_the_frames_of_the_film(tmp_path, monkeypatch):
    drawn, film = [], tmp_path / "film.webp"

    def render(env, physics, **size):
        drawn.append(physics.qpos)
        return np.arange(2, dtype=np.uint8)[:, None, None, None] * 200 + np.zeros((2, 48, 64, 3), np.uint8)

    monkeypatch.setattr(Locomotion, "render", render)
    assert main(["play", "pretrained:hopper", "--ticks", "7", "--out", str(film)]) == 0  # ticks of 8 ms, frames of 40
    assert [len(poses) for poses in drawn] == [2]
    with Image.open(film) as image:
        image.load()
        assert (getattr(image, "n_frames"), image.info["duration"]) == (2, 40)  # noqa: B009


@pytest.mark.parametrize("ground", [0, 250])
def test_the_label_is_read_on_any_ground_and_covers_the_corner_alone(ground):
    frames = with_label(np.full((2, 48, 160, 3), ground, np.uint8), "flat PPO")
    corner = frames[:, :16, :40]
    assert corner.max() > 200 and np.median(corner) <= ground / 4 and (frames[0] == frames[1]).all()
    assert (frames[:, 16:] == ground).all() and (frames[:, :, 90:] == ground).all()


def test_the_strip_shows_the_options_of_past_ticks_and_marks_decisions():
    options = np.array([[9.0, -9, 0], [9, -9, 0], [-9, 9, 0]])
    frames = with_options(np.zeros((3, 48, 160, 3), np.uint8), options, np.array([True, False, True]))
    first, second = (227, 27, 127), (27, 227, 127)
    assert tuple(frames[2, -1, 159]) == second and tuple(frames[2, -1, 158]) == MARK  # the newest tick is at the right
    assert tuple(frames[2, -1, 157]) == tuple(frames[2, -1, 156]) == first  # it was a tick of the option before
    assert tuple(frames[2, -1, 155]) == first and tuple(frames[2, -1, 154]) == MARK
    assert not frames[2, -1, :154].any() and not frames[:, :40].any()


def test_a_ways_arrow_points_where_it_leads():
    """White pixels of the corner lie towards the arrow's tip: right, up, left and down."""
    ways = np.array([[3.0, 0.0], [0.0, 0.1], [-1.0, 0.0], [0.0, -2.0]])
    frames = with_compass(np.zeros((4, 240, 320, 3), np.uint8), ways)
    assert not frames[:, 60:].any() and not frames[:, :, :260].any() and frames.shape == (4, 240, 320, 3)
    for frame, (x, y) in zip(frames, ways, strict=True):
        rows, columns = np.nonzero(frame[8:48, 272:312].any(axis=-1))  # within the circle
        lean = np.array([columns.mean() - 19.5, 19.5 - rows.mean()])
        assert lean @ [x, y] / np.linalg.norm([x, y]) > 1.0


MISTAKES = {
    "evaluate": "RUN: expected the folder of a finished run first",
    "evaluate nowhere": "nowhere: expected the folder of a run, or of an artifact of one",
    "evaluate RUN --methods flta": "--methods: expected some of collect, flat, taic, got flta; the nearest is flat",
    "evaluate RUN --episodes 0": "--episodes: expected at least 1, got 0; the nearest valid value is 1",
    "evaluate RUN --episods 3": "unknown option --episods; the nearest is --episodes",
    "evaluate RUN --env.name nav3d": "unknown environment 'nav3d': did you mean 'nav2d'?",
    "evaluate RUN --env.name nav2d_random": "as flat was trained for, got nav2d_random with 4 and 2",
    "play RUN --seed 2": "--seed: expected 0 to 1, got 2; the nearest valid value is 1",
    "play RUN --ticks -1": "--ticks: expected at least 0, got -1",
    "play RUN --out film.avi": "film.avi: expected a name that ends in one of .webp, .gif, .mp4",
    "play RUN/options": "RUN: expected agents",
    "evalute RUN": "unknown command evalute; the nearest is evaluate",
    "presets now": "taic presets: expected no arguments, got now",
}


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_is_one_line_and_leaves_nothing(run, tmp_path, monkeypatch, capsys, line):
    monkeypatch.chdir(tmp_path)
    before = files_of(run)
    assert main([word.replace("RUN", str(run)) for word in line.split()]) == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert message.startswith("taic_jax: error: ") and MISTAKES[line] in message.replace(str(run), "RUN")
    assert files_of(run) == before and not any(tmp_path.iterdir())


def test_the_help_lists_every_command_and_each_has_its_own(capsys):
    assert main([]) == main(["--help"]) == 0
    out = capsys.readouterr().out
    assert all(f"  {name} " in out for name in COMMANDS)
    for name in set(COMMANDS) - set(BARE):
        with pytest.raises(SystemExit) as stop:
            main([name, "--help"])
        assert stop.value.code == 0 and "--" in capsys.readouterr().out
    for name in BARE:
        assert main([name, "--help"]) == 0 and capsys.readouterr().out.startswith(f"usage: taic {name}")


def test_the_help_and_the_version_answer_without_jax():
    code = (
        "import sys\nfrom taic_jax.__main__ import main\nmain(['--version'])\nmain([])\nassert 'jax' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith(f"taic_jax {taic.__version__}\nusage: taic COMMAND")


def test_presets_lists_each_with_its_task_its_purpose_and_its_minutes(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["presets"]) == 0
    header, _, *lines = [line.split(maxsplit=2) for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert {line[0] for line in lines} == set(preset_names()) and "by --dry-run" in header[2]
    assert all(re.fullmatch(r".*  about \d+(\.\d+)?", line[2].strip()) for line in lines)
    (maze,) = (line for line in lines if line[0] == "transfer_ant_maze")
    assert maze[1] == "ant_maze" and maze[2].startswith("Ant's options in the maze")


def test_the_short_help_shows_the_options_of_the_command_and_the_common_fields(capsys):
    with pytest.raises(SystemExit) as stop:
        main(["run", "half_cheetah", "--help"])
    lines = capsys.readouterr().out.splitlines()
    assert stop.value.code == 0 and lines[0] == f"usage: {PROGRAM} [CONFIG] [OPTIONS]" and len(lines) < 50
    assert f"{PROGRAM} --help-all shows every field; presets: ant, " in lines[-1]
    shown = {line.split()[0]: " ".join(line.split()[1:]) for line in lines if line.startswith("  --")}
    assert shown["--train.ppo.gamma"] == "Discount per tick (0.99)" and shown["--seeds"].endswith("(1)")
    assert shown["--resume"] == "Continue the run in --run-dir from its last checkpoint"
    assert {f"--{name}".replace("_", "-") for name in COMMON_FIELDS} <= set(shown)
    assert "--replay" in shown and "--config" not in shown and max(map(len, lines[4:-1])) <= 140
