"""Pictures of trajectories, drawn on the host: MuJoCo scenes, and the navigation room from above."""

import os
import sys
from pathlib import Path
from typing import BinaryIO

import matplotlib.figure
import matplotlib.patches
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from taic_jax.envs.errors import RenderingError
from taic_jax.envs.navigation import GOAL_RADIUS, ROOM

Frames = UInt8[np.ndarray, "T height width 3"]

_FLOOR, _WALL, _GOAL, _POINT = "#f4f1ea", "#3d4451", "#3a9d5d", "#d1495b"


def render_mujoco(
    model: mujoco.MjModel,
    qpos: Float[Array | np.ndarray, "T nq"],
    *,
    height: int,
    width: int,
    camera: str = "track",
    site: Float[np.ndarray, "T 3"] | None = None,
) -> Frames:
    """Draw a trajectory of poses.

    Args:
      model: compiled model.
      qpos: the poses.
      height: pixels.
      width: pixels.
      camera: name of the model's camera; where it has none of that name, a free one looks at the whole scene.
      site: places in m for the model's first site, which marks a goal.

    Raises:
      RenderingError: if there is no OpenGL.
    """
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    camera_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)  # -1 means a free one
    data = mujoco.MjData(model)
    frames = []
    with _make_renderer(model, height, width) as renderer:
        for t, pose in enumerate(np.asarray(qpos)):
            data.qpos[:] = pose
            mujoco.mj_forward(model, data)
            if site is not None:
                data.site_xpos[0] = site[t]
            renderer.update_scene(data, camera_id)
            frames.append(renderer.render())
    return np.stack(frames)


def _make_renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    headless = sys.platform == "linux" and "DISPLAY" not in os.environ
    context = getattr(mujoco, "GLContext", None)  # the kind was chosen when MuJoCo was imported
    # Without a display, GLFW fails, and the second time ends the process: it must not be tried.
    if context is None or (headless and context.__module__ == "mujoco.glfw"):
        raise RenderingError("cannot draw MuJoCo scenes: without a display, install libegl1 and set MUJOCO_GL=egl")
    try:
        return mujoco.Renderer(model, height, width)
    except (ImportError, RuntimeError, mujoco.FatalError) as error:
        raise RenderingError(f"cannot draw MuJoCo scenes: {error}") from error


def render_room(
    walls: Float[Array | np.ndarray, "R 4"],
    standing: Bool[Array | np.ndarray, "T R"],
    position: Float[Array | np.ndarray, "T 2"],
    goal: Float[Array | np.ndarray, "T 2"],
    longest_move: float,
    *,
    height: int,
    width: int,
) -> Frames:
    """Draw a point's way through the room of `Navigation`: obstacles, start, goal, and the episode's path so far.

    `standing` says at which ticks a wall is there. A move longer than `longest_move` is a reset: there a new path
    starts.
    """
    walls, standing, position, goal = (np.asarray(array) for array in (walls, standing, position, goal))
    dpi = height / 2.4  # lines and dots grow with the frame
    figure = matplotlib.figure.Figure(figsize=(width / dpi, height / dpi), dpi=dpi, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.02, 0.02, 0.96, 0.96), xlim=(0, ROOM), ylim=(0, ROOM), aspect="equal")
    axes.set(xticks=[], yticks=[], facecolor=_FLOOR)
    for spine in axes.spines.values():
        spine.set(color=_WALL, linewidth=2)
    patches = [
        axes.add_patch(matplotlib.patches.Rectangle((x, y), x_high - x, y_high - y, color=_WALL))
        for x, y, x_high, y_high in walls
    ]
    target = axes.add_patch(matplotlib.patches.Circle((0, 0), GOAL_RADIUS, color=_GOAL, alpha=0.6, linewidth=0))
    (path,) = axes.plot([], [], color=_POINT, linewidth=1.5, alpha=0.7, solid_capstyle="round")
    (start,) = axes.plot([], [], "o", markersize=6, markerfacecolor="white", markeredgecolor=_POINT)
    (point,) = axes.plot([], [], "o", markersize=7, color=_POINT, markeredgecolor="white", clip_on=False)
    point.set_zorder(9)  # above the walls

    begin, frames = 0, []
    for t, here in enumerate(position):
        if np.abs(here - position[max(t - 1, 0)]).max() > longest_move:
            begin = t
        for patch, stands in zip(patches, standing[t], strict=True):
            patch.set_visible(stands)
        target.set_center(goal[t])
        path.set_data(*position[begin : t + 1].T)
        start.set_data(*position[begin : begin + 1].T)
        point.set_data(*here[:, None])
        canvas.draw()
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return np.stack(frames)


def write_webp(file: Path | BinaryIO, frames: Frames, dt: float) -> None:
    """Write frames that are `dt` seconds apart as an animation in real time, at most 25 a second."""
    every = max(round(0.04 / dt), 1)
    images = [Image.fromarray(frame) for frame in frames[::every]]
    duration = round(1000 * dt * every)
    images[0].save(file, format="webp", save_all=True, append_images=images[1:], duration=duration, loop=0)
