"""Pictures of trajectories, drawn on the host: MuJoCo scenes, and the navigation room from above."""

import os
import sys

import matplotlib.figure
import matplotlib.patches
import mujoco
import numpy as np
from jax import Array
from jaxtyping import Float, UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg

from taic_jax.envs.errors import RenderingError

Frames = UInt8[np.ndarray, "T height width 3"]

_FLOOR, _WALL, _GOAL, _POINT = "#f4f1ea", "#3d4451", "#3a9d5d", "#d1495b"


def render_mujoco(model: mujoco.MjModel, qpos: Float[Array | np.ndarray, "T nq"], *, height: int, width: int) -> Frames:
    """Draw a trajectory of poses, from the model's camera `track` where it has one.

    Raises:
      RenderingError: if there is no OpenGL.
    """
    model.vis.global_.offwidth = max(model.vis.global_.offwidth, width)
    model.vis.global_.offheight = max(model.vis.global_.offheight, height)
    camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, "track")  # -1, a free one, if there is none
    data = mujoco.MjData(model)
    frames = []
    with _make_renderer(model, height, width) as renderer:
        for pose in np.asarray(qpos):
            data.qpos[:] = pose
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
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
    walls: Float[np.ndarray, "R 4"],
    position: Float[Array | np.ndarray, "T 2"],
    goal: Float[Array | np.ndarray, "T 2"],
    *,
    size: float,
    goal_radius: float,
    longest_move: float,
    height: int,
    width: int,
) -> Frames:
    """Draw a point's way through the room [0, size]^2: obstacles, start, goal, and the episode's path so far.

    A move longer than `longest_move` is a reset: there a new path starts.
    """
    dpi = height / 2.4  # lines and dots grow with the frame
    figure = matplotlib.figure.Figure(figsize=(width / dpi, height / dpi), dpi=dpi, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.02, 0.02, 0.96, 0.96), xlim=(0, size), ylim=(0, size), aspect="equal")
    axes.set(xticks=[], yticks=[], facecolor=_FLOOR)
    for spine in axes.spines.values():
        spine.set(color=_WALL, linewidth=2)
    for x, y, x_high, y_high in walls:
        axes.add_patch(matplotlib.patches.Rectangle((x, y), x_high - x, y_high - y, color=_WALL))
    target = matplotlib.patches.Circle((0, 0), goal_radius, color=_GOAL, alpha=0.6, linewidth=0)
    axes.add_patch(target)
    (path,) = axes.plot([], [], color=_POINT, linewidth=1.5, alpha=0.7, solid_capstyle="round")
    (start,) = axes.plot([], [], "o", markersize=6, markerfacecolor="white", markeredgecolor=_POINT)
    (point,) = axes.plot([], [], "o", markersize=7, color=_POINT, markeredgecolor="white", clip_on=False)
    point.set_zorder(9)  # above the walls

    position, goal, begin, frames = np.asarray(position), np.asarray(goal), 0, []
    for t, here in enumerate(position):
        if np.abs(here - position[max(t - 1, 0)]).max() > longest_move:
            begin = t
        target.set_center(goal[t])
        path.set_data(*position[begin : t + 1].T)
        start.set_data(*position[begin : begin + 1].T)
        point.set_data(*here[:, None])
        canvas.draw()
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    return np.stack(frames)
