"""Pictures of MuJoCo scenes, drawn on the host, and animations."""

import os
import sys
from pathlib import Path
from typing import BinaryIO

import mujoco
import numpy as np
from jax import Array
from jaxtyping import Float, UInt8
from PIL import Image

from taic_jax.envs.errors import RenderingError

Frames = UInt8[np.ndarray, "T height width 3"]


def render_mujoco(
    model: mujoco.MjModel, qpos: Float[Array | np.ndarray, "T nq"], *, height: int, width: int,
    camera: str = "track", site: Float[np.ndarray, "T 3"] | None = None,
) -> Frames:  # fmt: skip
    """Draw a trajectory of poses, in pixels.

    Args:
      camera: of the model; if it has none of that name, a free one looks at the whole scene.
      site: places in m for the model's first site, which marks a goal.

    Raises:
      RenderingError: there is no OpenGL.
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


def write_webp(file: Path | BinaryIO, frames: Frames, dt: float) -> None:
    """Write frames that are `dt` seconds apart as an animation in real time, at most 25 a second."""
    every = max(round(0.04 / dt), 1)
    first, *others = [Image.fromarray(frame) for frame in frames[::every]]
    first.save(file, format="webp", save_all=True, append_images=others, duration=round(1000 * dt * every), loop=0)
