"""The page of `taic explore`: options in three dimensions, with ghosts and paths, and a map of their codes."""

import random
import threading
from functools import partial
from typing import Any

import jax
import numpy as np
from matplotlib import colormaps
from mjviser.conversions import merge_geoms
from PIL import Image, ImageDraw
from viser import ViserServer

from taic_jax.analysis.measures import standardized
from taic_jax.analysis.option_space import replay
from taic_jax.envs.base import Env
from taic_jax.envs.scenes import PLANE, Scene, place_bodies
from taic_jax.envs.wrappers import AutoReset
from taic_jax.options.execution import Executor

CODES, GHOSTS, TIMES, RANGE = 400, 8, 10, 3.0
VIEW = np.array([0.1, -0.36, 0.3])  # from the centre of a scene to the camera, in extents of the scene
FRAME, REST, MAP = 1 / 30, 20, np.array([600, 450])  # s a frame, frames of rest after a replay, pixels
SIZES = (7, 4, 1, 1)  # coordinates of each type of joint
COLOURS = np.vstack([[209, 73, 91], 255 * colormaps["cool"](np.linspace(0, 1, GHOSTS))[:, :3]]).astype(np.uint8)
BUTTONS = {"code": ("random", "zero"), "ghosts": ("keep", "path", "clear"), "state": ("go on", "new start")}
LEGEND = """One option changes **{}** by {:.2g} (violet) to {:.2g} (yellow); this replay by {:.2g}. Dots are codes from
the prior, in the two directions that change the state most; the large one is this code, the others are ghosts."""


class OptionPage:
    """Replays of the code that the sliders name, and of the codes kept as ghosts, from a chosen state of the task."""

    def __init__(self, server: ViserServer, env: Env, scene: Scene, executor: Executor, key: int):
        self.server, (self.model, self.qpos), self.dt, env = server, scene, env.dt, AutoReset(env.evaluated)
        self.key, key_codes = jax.random.split(jax.random.key(key))
        self.codes = np.asarray(jax.random.normal(key_codes, (CODES, executor.option_size)))
        self.reset, self.replay = jax.jit(env.reset), jax.jit(partial(replay, env, executor), static_argnames="most")
        self.begin, self.ghosts, self.mapped, gui = self.reset(self.key), self.codes[:0], None, server.gui
        for label, names in BUTTONS.items():
            gui.add_button_group(label, names).on_click(self._press)
        self.sliders = [gui.add_slider(f"o{i + 1}", -RANGE, RANGE, 0.05, 0.0) for i in range(executor.option_size)]
        second = round(1 / (executor.length * env.dt))
        self.times = gui.add_slider("in a row", 1, TIMES, 1, min(max(second, 1), TIMES))
        joints = [(self.model.joint(i).name or f"joint {i}", self.model.jnt_type[i]) for i in range(self.model.njnt)]
        self.names = [f"{name} {i}" if SIZES[kind] > 1 else name for name, kind in joints for i in range(SIZES[kind])]
        self.colour = gui.add_dropdown("colour", self.names)
        self.moved = threading.Event()
        for control in (*self.sliders, self.times, self.colour):
            control.on_update(lambda _: self.moved.set())
        self.map, self.legend = gui.add_image(np.zeros((1, 1, 3), np.uint8)), gui.add_markdown("")
        self._build()
        self.update()

    def play(self, ended: threading.Event) -> None:
        """Show the replay again and again until `ended`, and another one when a control has moved."""
        frame = 0
        while not ended.wait(FRAME):
            if self.moved.is_set():
                self.moved.clear()
                self.update()
                frame = 0
            now = min(frame, len(self.places) - 1)
            with self.server.atomic():
                for body, mesh in self.meshes.items():
                    mesh.batched_positions, mesh.batched_wxyzs = self.places[now, :, body], self.turns[now, :, body]
            frame = (frame + 1) % (len(self.places) + REST)

    def update(self) -> None:
        """Execute the code and the ghosts, and draw their paths and the map."""
        codes = np.vstack([self._code(), self.ghosts])
        drawn = np.arange(GHOSTS + 1) < len(codes)  # always as many replays: one program
        poses, self.end = self._execute(np.resize(codes, (GHOSTS + 1, codes.shape[1])), self.times.value, TIMES)
        self._draw_map(codes, (poses[-1] - poses[0])[0])
        ticks = np.linspace(0, len(poses) - 1, max(round(len(poses) * self.dt / FRAME), 30))
        before, share = ticks.astype(int), (ticks % 1)[:, None, None]
        self._place((1 - share) * poses[before] + share * poses[np.minimum(before + 1, len(poses) - 1)])
        for mesh in self.meshes.values():
            mesh.batched_scales = np.where(drawn, 1.0, 1e-6).astype(np.float32)
        path = self.places[:, drawn, next(iter(self.meshes))]
        points = np.stack([path[:-1], path[1:]], axis=2)
        colours = np.broadcast_to(COLOURS[drawn][:, None], points.shape)
        self.server.scene.add_line_segments("/paths", points.reshape(-1, 2, 3), colours.reshape(-1, 2, 3))

    def _code(self) -> np.ndarray:
        """Return the code [D] that the sliders name."""
        return np.array([slider.value for slider in self.sliders], np.float32)

    def _execute(self, codes: np.ndarray, times: int, most: int) -> tuple[np.ndarray, Any]:
        """Return poses [T + 1, N, nq] up to the last end of a replay, and the state in which the first code ends."""
        states, last = self.replay(self.begin, codes, self.key, times, most=most)
        poses = np.asarray(self.qpos(states.physics), float)[: int(last.max()) + 1]
        return poses, jax.tree.map(lambda x: x[-1, 0], states)

    def _place(self, poses: np.ndarray) -> None:
        """Hold positions [T, N, bodies, 3] and quaternions [T, N, bodies, 4] of all bodies in poses [T, N, nq]."""
        self.places, self.turns = place_bodies(self.model, poses)
        if self.bare:  # ground alone looks alike everywhere: the robot begins in the middle of the view
            self.places[..., :2] -= self.places[0, 0, next(iter(self.meshes)), :2]

    def _build(self) -> None:
        """Draw the world, and give each body that moves a mesh of GHOSTS + 1 instances."""
        scene, model, camera = self.server.scene, self.model, self.server.initial_camera
        camera.position, camera.look_at = model.stat.center + model.stat.extent * VIEW, model.stat.center
        shown, planes = model.geom_group < 3, model.geom_type == PLANE
        for geom in np.flatnonzero(shown & planes):
            width, height, _ = 2 * model.geom_size[geom]
            scene.add_grid(f"/plane{geom}", width, height, position=model.geom_pos[geom], fade_distance=40.0)
        geoms = [np.flatnonzero(shown & ~planes & (model.geom_bodyid == body)).tolist() for body in range(model.nbody)]
        self.bare = not geoms[0]
        if not self.bare:
            scene.add_mesh_trimesh("/world", merge_geoms(model, geoms[0]))
        parts = {body: merge_geoms(model, own) for body, own in enumerate(geoms) if body and own}
        places, turns = np.zeros((GHOSTS + 1, 3)), np.tile([1.0, 0, 0, 0], (GHOSTS + 1, 1))
        looks: Any = {"batched_colors": COLOURS, "batched_opacities": np.array([1.0] + [0.3] * GHOSTS)}
        self.meshes = {
            body: scene.add_batched_meshes_simple(f"/body{body}", part.vertices, part.faces, turns, places, **looks)
            for body, part in parts.items()
        }

    def _draw_map(self, codes: np.ndarray, own: np.ndarray) -> None:
        """Draw codes of the prior, coloured by how a coordinate changes from this state on, and `codes` [N, D]."""
        if self.mapped is not self.begin:
            self.change, self.mapped = np.diff(self._execute(self.codes, 1, 1)[0][[0, -1]], axis=0)[0], self.begin
            effect = np.linalg.lstsq(self.codes, standardized(self.change, self.change), rcond=None)[0]
            self.plane = np.linalg.svd(np.pad(effect, 2))[0][2:-2, :2]
        column = self.names.index(self.colour.value)
        values, low, high = self.change[:, column], *np.percentile(self.change[:, column], (2, 98))
        shades = 255 * colormaps["viridis"]((values - low) / max(high - low, 1e-9))[:, :3]
        image = Image.new("RGB", tuple(MAP), "white")
        draw, places = ImageDraw.Draw(image), np.vstack([self.codes, codes[::-1]]) @ self.plane * (1, -1)
        places, colours = MAP / 2 + places * MAP[0] / (2.4 * RANGE), np.vstack([shades, COLOURS[: len(codes)][::-1]])
        sizes = [7] * CODES + [12] * (len(codes) - 1) + [16]
        for (x, y), colour, size in zip(places, colours.astype(int), sizes, strict=True):
            draw.ellipse((x - size, y - size, x + size, y + size), tuple(colour), "white", width=2)
        self.map.image = np.asarray(image)
        self.legend.content = LEGEND.format(self.colour.value, low, high, own[column])

    def _press(self, event: Any) -> None:
        """Do as a button says."""
        match event.target.value:
            case "random" | "zero" as name:
                for slider in self.sliders:
                    slider.value = round(min(max(random.gauss(0, name == "random"), -RANGE), RANGE), 2)
            case "keep":
                self.ghosts = np.vstack([self.ghosts, self._code()])[-GHOSTS:]
            case "path":  # from the oldest ghost, or from zero
                first = self.ghosts[0] if len(self.ghosts) else 0 * self._code()
                self.ghosts = np.linspace(first, self._code(), GHOSTS, endpoint=False, dtype=np.float32)
            case "clear":
                self.ghosts = self.ghosts[:0]
            case "go on":
                self.begin = self.end
            case "new start":
                self.key, key = jax.random.split(self.key)
                self.begin = self.reset(key)
        self.moved.set()
