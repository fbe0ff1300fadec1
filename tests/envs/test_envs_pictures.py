"""The command that draws every task: its files, its sheet, its motions, and its mistakes in one line."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

from taic_jax.command_line import typed
from taic_jax.envs import RenderingError, environment_names, make_env, rendering
from taic_jax.handles import pictures

SIZE = (pictures.WIDTH, pictures.HEIGHT)


@pytest.fixture(autouse=True)
def in_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def draw(*args: str) -> list[str]:
    """Run the command, or skip where MuJoCo scenes cannot be drawn; return the files there are."""
    try:
        pictures.draw(typed(args, "", pictures.Arguments))
    except RenderingError as error:
        pytest.skip(str(error))
    return sorted(str(path) for path in Path().rglob("*.*"))


def test_draws_each_task_and_one_sheet(capsys):
    files = ["all.png", "new/half_cheetah.png", "new/half_cheetah.webp", "new/nav2d.png", "new/nav2d.webp"]
    args = ["--out", "new", "--tasks", "nav2d", "half_cheetah", "--ticks", "4", "--contact-sheet", "all.png"]
    assert draw(*args) == files
    assert sorted(capsys.readouterr().out.split()) == files
    for name, count in (("nav2d", 4), ("half_cheetah", 4)):
        with Image.open(f"new/{name}.png") as still, Image.open(f"new/{name}.webp") as film:
            assert still.format == "PNG" and still.size == SIZE and np.asarray(still).std() > 20
            assert film.format == "WEBP" and film.size == SIZE and getattr(film, "n_frames") == count  # noqa: B009
    with Image.open("all.png") as sheet:
        across, down = pictures.WIDTH + pictures.GAP, pictures.HEIGHT + pictures.CAPTION + pictures.GAP
        assert sheet.size == (2 * across + pictures.GAP, down + pictures.GAP)


def test_by_default_all_tasks_are_drawn(monkeypatch):
    made = []

    def make(name):
        made.append(name)
        return make_env("nav2d")

    monkeypatch.setattr(pictures, "make_env", make)
    draw("--ticks", "1")
    assert tuple(made) == environment_names()


@pytest.mark.parametrize(("number", "columns"), [(1, 1), (3, 3), (4, 4), (6, 3), (8, 4), (9, 3), (10, 5), (12, 4)])
def test_sheet_has_equal_tiles_with_a_name_under_each(number, columns):
    tiles = {f"task {i}": np.full((40, 120, 3), 255 - i, np.uint8) for i in range(number)}
    sheet = np.asarray(pictures.contact_sheet(tiles))
    across, down = 120 + pictures.GAP, 40 + pictures.CAPTION + pictures.GAP
    assert sheet.shape == (-(-number // columns) * down + pictures.GAP, columns * across + pictures.GAP, 3)
    for i in range(number):
        x, y = pictures.GAP + i % columns * across, pictures.GAP + i // columns * down
        tile, caption = sheet[y + 2 : y + 38, x + 2 : x + 118], sheet[y + 42 : y + 40 + pictures.CAPTION, x : x + 120]
        assert (tile == 255 - i).all() and caption.min() < 120
        dark = np.flatnonzero((caption < 120).any(axis=(0, 2)))
        assert abs(dark.min() - (119 - dark.max())) <= 6, "the name stands in the middle"


def test_motions_are_smooth_and_start_anew_where_an_episode_ends(monkeypatch):
    env, actions = make_env("nav2d"), []
    step = type(env).step

    def recorded(self, state, action):
        jax.debug.callback(lambda action: actions.append(np.asarray(action)), action, ordered=True)
        return step(self, state, action)

    monkeypatch.setattr(type(env), "step", recorded)
    env.episode_length = 60
    states = jax.device_get(pictures.random_episodes(env, jax.random.key(0), 200))
    jax.effects_barrier()
    moves = np.array(actions)
    assert moves.shape == (200, 2) and np.abs(moves).max() <= 1.0 and 0.4 < moves.std() < 0.9
    assert np.abs(np.diff(moves, axis=0)).mean() < 0.6 * moves.std(), "white noise changes by more than its spread"
    np.testing.assert_array_equal(np.flatnonzero(states.truncated), [59, 119, 179])
    np.testing.assert_array_equal(states.physics.position[[59, 119]], [[1.0, 5.0]] * 2)


@pytest.mark.parametrize(
    ("ended", "tick"), [([0, 0, 0, 0], 2), ([0, 0, 1, 0, 0, 0, 0, 0, 0], 5), ([0, 0, 0, 0, 0, 0, 1, 0], 3), ([1], 0)]
)
def test_the_still_is_the_middle_of_the_longest_episode(ended, tick):
    assert pictures.still(np.array(ended, bool)) == tick


def test_the_animation_plays_in_real_time(tmp_path):
    frames = np.arange(10, dtype=np.uint8)[:, None, None, None] * 20 + np.zeros((10, 8, 8, 3), np.uint8)
    for dt, count, duration in ((0.05, 10, 50), (0.2, 10, 200), (0.008, 2, 40)):
        rendering.write_webp(tmp_path / "film.webp", frames, dt)
        with Image.open(tmp_path / "film.webp") as film:
            film.load()
            assert (getattr(film, "n_frames"), film.info["duration"]) == (count, duration)  # noqa: B009


@pytest.mark.parametrize("model", ["brax", "gym"])
def test_a_fast_robot_does_not_outrun_the_floor(model):
    env = make_env("half_cheetah", model=model)
    physics = jax.tree.map(lambda x: np.asarray(x)[None], env.reset(jax.random.key(0)).physics)
    tile = 80.0 / 60  # the MJCF draws 60 tiles on a floor of 80 m
    frames = [env.render(physics.replace(qpos=physics.qpos + x * np.eye(env.model.nq)[0])) for x in (0.0, 100 * tile)]
    first, far = (frame.astype(float)[0, 140:] for frame in frames)  # the floor's part of the picture
    assert first.std() > 40 and np.abs(first - far).mean() < 4


REFUSED = {
    "unknown task": ("--tasks nav2d half_cheeta", "unknown environment 'half_cheeta': did you mean 'half_cheetah'?"),
    "unknown option": ("--task nav2d", "unknown option --task; the nearest is --tasks"),
    "text for integer": ("--ticks many", "--ticks: expected an integer", "got 'many'"),
    "no value": ("--out", "--out: expected a value, got nothing"),
    "stray argument": ("nav2d", "unexpected argument in 'nav2d'; expected options"),
    "no ticks": ("--ticks 0", "--ticks: expected at least 1, got 0; the nearest valid value is 1"),
    "sheet's type": ("--contact-sheet all.jpeg", "got all.jpeg; the nearest valid value is all.jpeg.png"),
    "file for folder": ("--out file --tasks nav2d", "file"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_mistakes_are_told_in_one_line(case, capfd):
    Path("file").touch()
    args, *says = REFUSED[case]
    assert pictures.main(args.split()) == 2
    out, err = capfd.readouterr()
    assert out == "" and err.startswith("taic_jax: error: ") and err.count("\n") == 1
    assert all(part in err for part in says)
    assert [path.name for path in Path().iterdir()] == ["file"]


def test_where_scenes_cannot_be_drawn_one_line_says_so(monkeypatch, capsys):
    monkeypatch.setattr(rendering.mujoco, "GLContext", None)
    assert pictures.main(["--tasks", "half_cheetah", "--ticks", "1"]) == 2
    err = capsys.readouterr().err
    assert err.startswith("taic_jax: error: cannot draw MuJoCo scenes") and err.count("\n") == 1


def test_errors_of_the_program_keep_their_traceback(monkeypatch):
    monkeypatch.setattr(pictures, "make_env", lambda name: int("not a mistake of the user"))
    with pytest.raises(ValueError, match="invalid literal"):
        pictures.main(["--tasks", "nav2d"])


def test_the_module_runs_and_its_help_shows_every_argument():
    root = Path(pictures.__file__).parents[2]
    command = [sys.executable, "-m", "taic_jax", "envs", "--help"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True)
    assert done.returncode == 0 and done.stderr == ""
    for field in dataclasses.fields(pictures.Arguments):
        assert "--" + field.name.replace("_", "-") in done.stdout


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio-ffmpeg leaves a pipe open
def test_an_mp4_plays_in_real_time(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    film, frames = tmp_path / "film.mp4", np.zeros((30, 32, 48, 3), np.uint8)
    with film.open("wb") as file:
        rendering.write_film(film, file, frames, dt=0.02)
    reader = ffmpeg.read_frames(str(film))
    assert (about := next(reader))["size"] == (48, 32) and about["fps"] == 25.0
    assert len(list(reader)) == 15


@pytest.mark.parametrize("name", ["film.avi", "film"])
def test_a_film_of_another_format_is_refused(tmp_path, name):
    with pytest.raises(RenderingError, match=r"expected a name that ends in one of \.webp, \.gif, \.mp4"):
        rendering.check_film(tmp_path / name)
