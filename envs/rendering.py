"""Pictures of MuJoCo scenes, drawn on the host, and animations."""

import importlib
import io
import os
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any, BinaryIO

import mujoco
import numpy as np
from jax import Array
from jaxtyping import Float, UInt8
from PIL import Image

from taic_jax.envs.errors import MissingExtraError, RenderingError

FILMS = (".webp", ".gif", ".mp4")
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
    # A film looks as with MuJoCo's defaults, 4096 and 4, and takes a quarter of the time on a CPU.
    model.vis.quality.shadowsize, model.vis.quality.offsamples = 1024, 0
    camera_id = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, camera)  # -1 means a free one
    floor = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "floor")
    tile = 2 * model.geom_size[floor, :2] / model.mat_texrepeat[model.geom_matid[floor]] if floor >= 0 else np.zeros(2)
    data = mujoco.MjData(model)
    frames = []
    with make_renderer(model, height, width) as renderer:
        for t, pose in enumerate(np.asarray(qpos)):
            data.qpos[:] = pose
            mujoco.mj_forward(model, data)
            if tile.all():  # a robot at 7 m/s soon runs off the drawn part of the floor: whole tiles of it follow
                data.geom_xpos[floor, :2] = tile * np.round(data.cam_xpos[camera_id, :2] / tile)
            if site is not None:
                data.site_xpos[0] = site[t]
            renderer.update_scene(data, camera_id)
            frames.append(renderer.render())
    return np.stack(frames)


def make_renderer(model: mujoco.MjModel, height: int, width: int) -> mujoco.Renderer:
    """Return a renderer of a model, or raise `RenderingError` without OpenGL."""
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
    _animate(file, frames, dt, "webp")


def write_film(path: Path, file: BinaryIO | io.BytesIO, frames: Frames, dt: float) -> None:
    """Write an animation as `write_webp` does, in the format that the path's ending names, one of FILMS.

    Raises:
      RenderingError, MissingExtraError: as `check_film`.
    """
    check_film(path)
    if (kind := path.suffix.lower()) != ".mp4":
        return _animate(file, frames, dt, kind[1:])
    every = ticks_per_frame(dt)
    with tempfile.TemporaryDirectory() as folder:
        film = Path(folder) / "film.mp4"
        size = frames.shape[2], frames.shape[1]
        writer = _ffmpeg().write_frames(str(film), size, fps=1 / (dt * every), macro_block_size=2)
        with warnings.catch_warnings():  # JAX warns of a fork; ffmpeg is executed in it at once
            warnings.simplefilter("ignore", RuntimeWarning)
            writer.send(None)
        for frame in frames[::every]:
            writer.send(np.ascontiguousarray(frame))
        writer.close()
        file.write(film.read_bytes())


def check_film(path: Path) -> None:
    """Raise RenderingError if the name ends in none of FILMS, MissingExtraError for an MP4 without imageio-ffmpeg."""
    if path.suffix.lower() not in FILMS:
        raise RenderingError(f"{path}: expected a name that ends in one of {', '.join(FILMS)}")
    if path.suffix.lower() == ".mp4":
        _ffmpeg()


def _ffmpeg() -> Any:
    try:
        return importlib.import_module("imageio_ffmpeg")
    except ImportError:
        raise MissingExtraError("imageio-ffmpeg", "video") from None


def ticks_per_frame(dt: float) -> int:
    """Return the ticks of `dt` seconds between two frames of a film."""
    return max(round(0.04 / dt), 1)


def _animate(file: Path | BinaryIO | io.BytesIO, frames: Frames, dt: float, kind: str) -> None:
    every = ticks_per_frame(dt)
    first, *others = [Image.fromarray(frame) for frame in frames[::every]]
    first.save(file, format=kind, save_all=True, append_images=others, duration=round(1000 * dt * every), loop=0)
