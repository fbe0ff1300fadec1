"""Pictures: right size, right place, and they move."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import ImageColor

from taic_jax.envs import Navigation, RenderingError, make_env, rendering
from taic_jax.envs.navigation import NavigationState
from taic_jax.envs.plans import _PATH, _WALL


def near(frame, colour: str):
    """Return where [H, W] a frame has about that colour."""
    return np.abs(frame.astype(int) - ImageColor.getrgb(colour)).max(axis=-1) < 30


def test_room_shows_point_walls_and_path():
    env = Navigation(change_after=1)
    position = jnp.array([[1.0, 5.0], [1.2, 5.0], [1.4, 5.0], [8.0, 2.0]])  # the last is a reset
    physics = NavigationState(position, jnp.broadcast_to(jnp.array([9.0, 5.0]), (4, 2)), jnp.array([0, 0, 0, 1]))
    frames = env.render(physics, height=200, width=300)
    assert frames.shape == (4, 200, 300, 3) and frames.dtype == np.uint8

    def pixel(x, y):  # the room is the middle 200 x 200 pixels, less a margin of 2 %
        return round(200 - 4 - 19.2 * y), round(150 - 96 + 19.2 * x)

    for t in range(4):
        assert near(frames[t], _WALL)[pixel(5.0, 2.0)] and near(frames[t], _WALL)[pixel(2.5, 3.0)]
        assert near(frames[t], _PATH)[pixel(*position[t].tolist())]
        assert near(frames[t], _WALL)[pixel(7.2, 4.0)] == (t == 3), "the trap stands from the second episode on"
    red = near(frames, _PATH).sum(axis=(1, 2))
    assert red[0] < red[2] and red[3] <= red[0] + 2, "the path grows, and starts anew after a reset"
    assert not near(frames[0], "#3a9d5d")[pixel(9.0, 5.7)]
    assert frames[0][pixel(9.0, 5.0)][1] > frames[0][pixel(9.0, 5.0)][0] + 30, "the goal is green"


@pytest.mark.parametrize("name", ["half_cheetah", "ant", "ant_push"])
def test_robots_move_in_their_pictures(name):
    env = make_env(name, "mujoco")
    physics = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 2)).physics
    try:
        frames = env.render(physics, height=120, width=160)
    except RenderingError as error:
        pytest.skip(str(error))
    assert frames.shape == (2, 120, 160, 3) and frames.dtype == np.uint8
    assert frames.std() > 20 and (frames[0] != frames[1]).any()
    large = env.render(physics, height=500, width=700)  # beyond the model's own limit
    assert large.shape == (2, 500, 700, 3)


@pytest.mark.parametrize("kind", ["mujoco.glfw", None])
def test_without_opengl_the_error_says_what_to_do(kind, monkeypatch):
    """GLFW is not even tried without a display."""
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    context = kind and type("GLContext", (), {"__module__": kind})
    monkeypatch.setattr(rendering.mujoco, "GLContext", context)
    monkeypatch.setattr(rendering.mujoco, "Renderer", None)
    env = make_env("ant", "mujoco")
    physics = jax.vmap(env.reset)(jax.random.split(jax.random.key(0), 1)).physics
    with pytest.raises(RenderingError, match="install libegl1 and set MUJOCO_GL=egl"):
        env.render(physics)
