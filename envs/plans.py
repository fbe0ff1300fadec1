"""Pictures of a room from above, without MuJoCo."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Shaped, UInt8

_FLOOR, _WALL, _PATH = "#f4f1ea", "#3d4451", "#d1495b"


class Plan:
    """A square room whose coordinates are from `low` to `high`: solids, discs, and the path of a point."""

    def __init__(self, low: float, high: float, height: int, width: int):
        from matplotlib.backends.backend_agg import FigureCanvasAgg  # matplotlib takes a while to import
        from matplotlib.figure import Figure

        dpi = height / 2.4  # lines and dots grow with the frame
        figure = Figure(figsize=(width / dpi, height / dpi), dpi=dpi, facecolor="white")
        self._canvas = FigureCanvasAgg(figure)
        self._axes = figure.add_axes((0.02, 0.02, 0.96, 0.96), xlim=(low, high), ylim=(low, high), aspect="equal")
        self._axes.set(xticks=[], yticks=[], facecolor=_FLOOR)
        for spine in self._axes.spines.values():
            spine.set(color=_WALL, linewidth=2)

    def add_solid(self, x: float, y: float, right: float, top: float):
        """Draw a rectangle of wall; return its patch."""
        from matplotlib.patches import Rectangle

        return self._axes.add_patch(Rectangle((x, y), right - x, top - y, color=_WALL))

    def add_disc(self, radius: float, color: str):
        """Draw a disc at the origin; return its patch."""
        from matplotlib.patches import Circle

        return self._axes.add_patch(Circle((0, 0), radius, color=color, alpha=0.6, linewidth=0))

    def film(
        self, position: Shaped[np.ndarray, "T 2"], begins: Bool[np.ndarray, " T"], arrange: Callable[[int], None]
    ) -> UInt8[np.ndarray, "T height width 3"]:
        """Draw the point and its path since the latest tick that `begins` one; `arrange(t)` sets the patches before."""
        (path,) = self._axes.plot([], [], color=_PATH, linewidth=1.5, alpha=0.7, solid_capstyle="round")
        (start,) = self._axes.plot([], [], "o", markersize=6, markerfacecolor="white", markeredgecolor=_PATH)
        (point,) = self._axes.plot([], [], "o", markersize=7, color=_PATH, markeredgecolor="white", clip_on=False)
        point.set_zorder(9)  # above the walls
        begin, frames = 0, []
        for t, here in enumerate(position):
            begin = t if begins[t] else begin
            arrange(t)
            path.set_data(*position[begin : t + 1].T)
            start.set_data(*position[begin : begin + 1].T)
            point.set_data(*here[:, None])
            self._canvas.draw()
            frames.append(np.asarray(self._canvas.buffer_rgba())[..., :3].copy())
        return np.stack(frames)
