"""The page of `taic explore`: replays with known answers, the room and robots, its controls, and each mistake."""

import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from probes import Counting, Repeat
from tiny_runs import CONFIG, with_fields

import taic_jax as taic
from taic_jax.__main__ import main
from taic_jax.analysis.option_space import replay
from taic_jax.envs.scenes import make_scene
from taic_jax.envs.wrappers import AutoReset
from taic_jax.options.execution import make_executor

BROWSER = next((path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), "")
KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "run"
    taic.run_pipeline(with_fields(CONFIG, evaluate__video_ticks=0), folder, quiet=True)
    return folder


def free_port() -> int:
    with socket.socket() as bound:
        bound.bind(("localhost", 0))
        return bound.getsockname()[1]


@pytest.mark.parametrize("times", [1, 3])
def test_a_replay_executes_every_option_from_the_given_state_and_stands_after_its_end(times):
    env, options = taic.make_env("nav2d"), jnp.array([[0.5, -1], [9, 0.25]])
    state = jax.jit(env.reset)(KEY)
    state = state.replace(physics=state.physics.replace(position=jnp.array([3.0, 8.0])))
    executor = Repeat(2, option_size=2)
    begin = AutoReset(env).reset(KEY).replace(physics=state.physics)
    states, last = jax.jit(lambda times: replay(AutoReset(env), executor, begin, options, KEY, times, 4))(times)
    assert last.tolist() == [2 * times] * 2 and states.physics.position.shape == (9, 2, 2)
    for row, option in enumerate(options):
        by_hand, here = [state.physics.position], state
        for _ in range(2 * times):
            here = env.step(here, jnp.clip(option, -1, 1))
            by_hand.append(here.physics.position)
        by_hand += [by_hand[-1]] * (8 - 2 * times)
        np.testing.assert_allclose(states.physics.position[:, row], by_hand, atol=1e-6)


def test_a_replay_stands_still_before_its_episode_ends_and_at_the_end_of_an_option_by_its_rule():
    env = AutoReset(Counting(3))
    states, last = replay(env, Repeat(2), env.reset(KEY), jnp.zeros((2, 1)), KEY, 2, 2)
    np.testing.assert_array_equal(states.physics[:, 0], [0, 1, 2, 2, 2])
    assert last.tolist() == [2, 2]
    env = AutoReset(Counting(0))
    _, last = replay(env, Repeat(3, noise_size=1), env.reset(KEY), jnp.zeros((40, 1)), KEY, 1, 2)
    assert set(last.tolist()) == {1, 2, 3}  # the chance to end is one half a tick


def test_the_room_has_its_walls_and_the_point_is_where_the_physics_has_it():
    env = taic.make_env("nav2d")
    model, pose = make_scene(env)
    kinds, data = model.geom_type.tolist(), mujoco.MjData(model)
    assert kinds.count(mujoco.mjtGeom.mjGEOM_BOX) == 4 and kinds.count(mujoco.mjtGeom.mjGEOM_CYLINDER) == 1
    low, high = model.geom_pos - model.geom_size, model.geom_pos + model.geom_size
    boxes = model.geom_type == mujoco.mjtGeom.mjGEOM_BOX
    walls = np.concatenate([low[boxes, :2], high[boxes, :2]], axis=1)
    np.testing.assert_allclose(walls, np.asarray(env.walls), atol=1e-6)
    data.qpos[:] = pose(env.reset(KEY).physics)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.body("point").xpos[:2], [1, 5])
    model, _ = make_scene(taic.make_env("nav2d_random"))
    assert mujoco.mjtGeom.mjGEOM_CYLINDER not in model.geom_type.tolist()  # its goal moves


@pytest.mark.parametrize("name", ["half_cheetah", "ant_maze", "brax:hopper"])
def test_the_pose_of_a_robot_is_that_of_its_model(name):
    env = taic.make_env(name)
    model, pose = make_scene(env)
    qpos = np.asarray(pose(jax.eval_shape(env.reset, KEY).physics).shape)
    assert qpos.tolist() == [model.nq] and model.nbody >= 5


def test_a_task_without_a_known_model_has_no_scene():
    assert make_scene(Counting(3)) is None


@pytest.fixture(scope="module")
def page(run) -> Iterator[Any]:
    """Yield the page without a browser."""
    pytest.importorskip("viser")
    from taic_jax.handles.option_page import OptionPage, ViserServer

    handle = taic.load(run)
    server = ViserServer("localhost", free_port(), verbose=False)
    executor = make_executor(handle.config.options, handle.options[0])
    yield OptionPage(server, handle.env, make_scene(handle.env), executor, 0)
    server.stop()


def press(page: Any, name: str) -> None:
    page._press(SimpleNamespace(target=SimpleNamespace(value=name)))
    page.update()


def test_the_controls_move_the_replays(page):
    at_zero, point = page.places[:, 0].copy(), 1
    page.sliders[0].value = 2.0
    assert page.moved.is_set()
    page.update()
    assert np.abs(page.places[-1, 0, point] - at_zero[-1, point]).max() > 1e-3
    press(page, "path")  # from zero to this code
    assert page.ghosts.shape == (8, 2) and np.allclose(page.ghosts[:, 0], np.arange(8) / 4)
    np.testing.assert_allclose(page.places[:, 1], at_zero, atol=1e-5)
    assert page.meshes[point].batched_scales.tolist() == [1.0] * 9
    own = page.places[-1, 0, point, 0] - page.places[0, 0, point, 0]
    assert "**x** by " in page.legend.content and f"this replay by {own:.2g}" in page.legend.content
    end = page.places[-1, 0]
    press(page, "go on")
    np.testing.assert_allclose(page.places[0, 0], end, atol=1e-5)
    press(page, "new start")
    np.testing.assert_allclose(page.places[0, 0, point, :2], [1, 5], atol=1e-5)
    press(page, "clear")
    assert page.meshes[point].batched_scales[1:].max() < 1e-3 and len(page.ghosts) == 0
    press(page, "keep")
    np.testing.assert_allclose(page.ghosts, [[2.0, 0.0]])
    press(page, "random")
    assert [slider.value for slider in page.sliders] != [2.0, 0.0]
    press(page, "zero")
    assert [slider.value for slider in page.sliders] == [0.0, 0.0]


def test_the_map_has_a_dot_for_each_code_in_the_colour_of_its_change(page):
    assert np.asarray(page.map.image).shape == (450, 600, 3)
    before = np.asarray(page.map.image).copy()
    page.colour.value = "y"
    page.update()
    assert "**y**" in page.legend.content and (np.asarray(page.map.image) != before).mean() > 0.02
    assert page.change.shape == (400, 2) and np.ptp(page.change, axis=0).min() > 0


@contextmanager
def served(run: Path, port: int) -> Iterator[None]:
    """Serve the page as a user does, and end it as one does."""
    command = [sys.executable, "-m", "taic_jax", "explore", str(run), "--port", str(port)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout and process.stdout.readline() == f"http://localhost:{port} (Ctrl-C ends it)\n"
        yield
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
    finally:
        process.kill()
        process.communicate()


@contextmanager
def browser(url: str, profile: Path) -> Iterator[Callable[[str], Any]]:
    """Open a page, and yield a function that evaluates an expression in it."""
    from websockets.sync.client import connect

    command = [BROWSER, "--headless", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    command += ["--remote-debugging-port=0", f"--user-data-dir={profile}", url]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stderr
        address = next(found[1] for line in process.stderr if (found := re.search(r"on ws://([^/]+)/", line)))
        with urllib.request.urlopen(f"http://{address}/json") as answer:
            (tab,) = [tab for tab in json.load(answer) if tab["type"] == "page"]
        with connect(tab["webSocketDebuggerUrl"], max_size=None) as socket_:

            def evaluate(expression: str) -> Any:
                params = {"expression": expression, "returnByValue": True}
                socket_.send(json.dumps({"id": 1, "method": "Runtime.evaluate", "params": params}))
                return json.loads(socket_.recv())["result"]["result"].get("value")

            yield evaluate
    finally:
        process.kill()
        process.communicate()


def until(holds: Callable[[], Any], seconds: float = 60.0) -> Any:
    """Return the first value of a function that is true."""
    end = time.monotonic() + seconds
    while not (value := holds()):
        assert time.monotonic() < end, "it does not come to hold"
        time.sleep(0.2)
    return value


@pytest.mark.skipif(not BROWSER, reason="no Chromium on PATH, which draws the page")
def test_a_slider_moved_in_the_browser_moves_the_robot(run, tmp_path, page):
    port = free_port()
    slider = "document.querySelectorAll('[role=slider]')"
    said = "(document.body.innerText.match(/this replay by ([-+.e0-9]+[0-9])/) || [])[1]"
    with served(run, port), browser(f"http://localhost:{port}", tmp_path / "profile") as evaluate:
        until(lambda: evaluate(f"{slider}.length") == 3)  # two of the code, one of the times in a row
        before = until(lambda: evaluate(said))
        end = "{key: 'End', code: 'End', bubbles: true}"
        evaluate(f"{slider}[0].dispatchEvent(new KeyboardEvent('keydown', {end}))")
        until(lambda: evaluate(f"{slider}[0].getAttribute('aria-valuenow')") == "3")
        after = until(lambda: (now := evaluate(said)) != before and now)
    press(page, "new start")
    page.colour.value, page.sliders[0].value = "x", 3.0
    page.update()
    own = page.places[-1, 0, 1, 0] - page.places[0, 0, 1, 0]
    assert float(after) == pytest.approx(own, rel=0.06)


MISTAKES = {
    "RUN --seed 2": "--seed: expected 0 to 1, got 2; the nearest valid value is 1",
    "RUN --port 0": "--port: expected 1 to 65535, got 0; the nearest valid value is 1",
    "RUN --port BUSY": "--port: expected a free port, got BUSY; the nearest valid value is ",
    "RUN --env.name half_cheetah": "a body with 2 observations and 2 actions, as the options were learnt on",
    "RUN/agents/flat": "expected options, got the agents of flat alone",
    "RUN --methods flat": "unknown option --methods",
}


@pytest.mark.parametrize("line", MISTAKES)
def test_a_mistake_is_one_line(run, capsys, line):
    pytest.importorskip("viser")
    with socket.create_server(("localhost", 0)) as taken:
        busy = str(taken.getsockname()[1])
        assert main(["explore", *line.replace("RUN", str(run)).replace("BUSY", busy).split()]) == 2
    told = capsys.readouterr()
    (message,) = told.err.splitlines()
    assert message.startswith("taic_jax: error: ") and MISTAKES[line].replace("BUSY", busy) in message
    assert "http" not in told.out


@pytest.mark.parametrize("package", ["viser", "mjviser"])
def test_a_missing_extra_is_named(run, capsys, monkeypatch, package):
    monkeypatch.delitem(sys.modules, "taic_jax.handles.option_page", raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "mjviser.conversions", raising=False)
    assert main(["explore", str(run)]) == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert "explore" in message and package in message
