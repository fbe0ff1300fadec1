"""A picture of the gate: the compass rose of codes, and the paths of navigated ants through the arenas."""

from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle
from PIL import Image

from taic_jax.envs.ant_tasks import SUCCESS_RADIUS
from taic_jax.envs.arenas import Arena
from taic_jax.experiments.evidence.navigate import Compass

PATHS = 32
BLUE, RED, GREEN, GREY = "#0072b2", "#d55e00", "#009e73", "#8c8c8c"  # Okabe and Ito's


def draw_navigation(compass: Compass, paths: Mapping[str, tuple[Arena, np.ndarray, float]], out: Path) -> None:
    """Draw codes and, for each arena by name, the paths [T, B, 2] of ants and their success; write a PNG."""
    figure, panels = plt.subplots(1, 1 + len(paths), figsize=(4 * (1 + len(paths)), 4.2), layout="constrained")
    _draw_rose(panels[0], compass)
    for axes, (name, (arena, places, success)) in zip(panels[1:], paths.items(), strict=True):
        _draw_arena(axes, arena, places[:, :PATHS])
        axes.set_title(f"{name}: {success:.0%} at the goal")
    figure.savefig(out, dpi=90)
    plt.close(figure)
    with Image.open(out) as picture:
        picture.convert("RGB").quantize(64).save(out, optimize=True)


def _draw_rose(axes: Axes, compass: Compass) -> None:
    """Draw where each option leads, m/s, seen as it is chosen; those that overturn a tenth of the ants are red."""
    risky = np.asarray(compass.overturned) >= 0.1
    for chosen, colour, label in ((~risky, BLUE, "upright"), (risky, RED, "overturns a tenth or more")):
        x, y = np.asarray(compass.velocity)[chosen].T
        axes.quiver(0 * x, 0 * y, x, y, angles="xy", scale_units="xy", scale=1, color=colour, width=0.004, label=label)
    reach = 1.1 * max(float(np.abs(compass.velocity).max()), 0.1)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel="m/s", ylabel="m/s")
    axes.set_title("where each option leads")
    axes.legend(loc="lower left", fontsize=8)


def _draw_arena(axes: Axes, arena: Arena, places: np.ndarray) -> None:
    """Draw walls, block, goal and paths."""
    for x, y, right, top in arena.solids:
        axes.add_patch(Rectangle((x, y), right - x, top - y, color=GREY))
    if arena.block:
        (x, y, _), (half_x, half_y, _) = arena.block.centre, arena.block.half
        corner = x - half_x, y - half_y
        axes.add_patch(Rectangle(corner, 2 * half_x, 2 * half_y, fill=False, hatch="//", edgecolor=GREY))
    axes.add_patch(Circle(arena.goal[:2], SUCCESS_RADIUS, color=GREEN, alpha=0.25))
    axes.plot(*np.moveaxis(places, -1, 0), color=BLUE, linewidth=0.6, alpha=0.7)
    axes.plot(*np.moveaxis(places[-1], -1, 0), "o", color=RED, markersize=3)
    x_low, y_low, x_high, y_high = arena.room
    axes.set(xlim=(x_low, x_high), ylim=(y_low, y_high), aspect="equal", xlabel="m")
