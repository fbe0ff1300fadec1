"""Draw the picture of the method: `python docs/site/draw_method.py` writes method.png beside this file."""

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

BLUE, ORANGE, GREEN, GREY = "#56b4e9", "#e69f00", "#009e73", "#d0d0d0"  # Okabe and Ito's
BOXES = {  # name: centre, text, colour
    "experience": ((1.2, 3.0), "experience:\nwindows of\nactions, states", GREY),
    "E": ((3.7, 3.0), "E\nencoder", BLUE),
    "code": ((5.9, 3.0), "code o\n= option", ORANGE),
    "D": ((8.1, 4.3), "D\ndecoder", BLUE),
    "P": ((8.1, 3.0), "P, sees s too\npredictor", BLUE),
    "F": ((8.1, 1.7), "F\nestimator", BLUE),
    "actions": ((10.6, 4.3), "the window's\nactions", GREY),
    "change": ((10.6, 3.0), "the state change\nthat follows", GREY),
    "states": ((10.6, 1.7), "the states\n(E against F)", GREY),
    "policy": ((3.7, 0.3), "policy\nPPO, SAC, DQN", GREEN),
    "executor": ((6.4, 0.3), "executor: D tick by\ntick, until it ends", BLUE),
    "task": ((9.2, 0.3), "task", GREY),
}
ARROWS = [
    ("experience", "E", ""), ("E", "code", ""), ("code", "D", ""), ("code", "P", ""), ("code", "F", ""),
    ("D", "actions", "L_Recons"), ("P", "change", "L_pred"), ("F", "states", "L_adv"),
    ("policy", "executor", "option"), ("executor", "task", "actions"),
]  # fmt: skip
HALF = (0.85, 0.42)


def draw_arrow(axes: Axes, first: str, last: str, text: str) -> None:
    """Draw an arrow between two boxes, with a text in its middle."""
    (x0, y0), (x1, y1) = BOXES[first][0], BOXES[last][0]
    ends = (x0 + HALF[0] + 0.08, y0), (x1 - HALF[0] - 0.08, y1)
    axes.add_patch(FancyArrowPatch(*ends, arrowstyle="-|>", mutation_scale=12, color="#404040"))
    axes.text((ends[0][0] + ends[1][0]) / 2, (y0 + y1) / 2 + 0.12, text, ha="center", fontsize=8)


def main() -> None:
    """Draw and write the picture."""
    figure, axes = plt.subplots(figsize=(11, 4.9), layout="constrained")
    for (x, y), text, colour in BOXES.values():
        corner = x - HALF[0], y - HALF[1]
        box = FancyBboxPatch(corner, 2 * HALF[0], 2 * HALF[1], boxstyle="round,pad=0.05", color=colour, alpha=0.55)
        axes.add_patch(box)
        axes.text(x, y, text, ha="center", va="center", fontsize=9)
    for arrow in ARROWS:
        draw_arrow(axes, *arrow)
    ends, bow = ((9.2, -0.15), (3.7, -0.15)), "arc3,rad=-0.12"
    axes.add_patch(FancyArrowPatch(*ends, arrowstyle="-|>", mutation_scale=12, color="#404040", connectionstyle=bow))
    axes.text(6.1, -0.68, "observation, at each end of an option; reward", ha="center", fontsize=8)
    axes.text(0.2, 4.75, "learning options", fontsize=11, weight="bold")
    axes.text(0.2, 0.55, "acting by options", fontsize=11, weight="bold")
    axes.set(xlim=(0, 12), ylim=(-0.9, 5))
    axes.axis("off")
    figure.savefig(Path(__file__).with_name("method.png"), dpi=100)


if __name__ == "__main__":
    main()
