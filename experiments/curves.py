"""Draw what a run learnt: a frame of its video beside the return of both methods over interactions.

python -m taic_jax.experiments.curves RUN_DIR --out curves.png
"""

import dataclasses
from pathlib import Path
from typing import Annotated

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.axes import Axes
from PIL import Image

from taic_jax.analysis.statistics import iqm
from taic_jax.config_io import load_config
from taic_jax.logging import read_metrics

COLOURS = {"flat": "#7f7f7f", "taic": "#d1495b"}
LABELS = {"flat": "flat PPO", "taic": "options (TAIC)"}


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Draw the curves of one run."""

    run: Annotated[Path, tyro.conf.Positional]
    """The run's folder."""
    out: Path = Path("curves.png")
    """The picture to write."""


def curve(rows: list[dict], stage: str) -> tuple[np.ndarray, np.ndarray]:
    """Return ticks [I] and training returns [I, K] of a stage; NaN before a seed's first finished episode."""
    rows = [row for row in rows if row["stage"] == stage]
    returns = np.array([row[f"{stage}/return"] for row in rows], float)
    return np.array([row["ticks"] for row in rows]), returns


def draw_curves(axes: Axes, rows: list[dict], stages: dict[str, str]) -> None:
    """Draw every seed as a thin line and their interquartile mean as a thick one."""
    for method, stage in stages.items():
        ticks, returns = curve(rows, stage)
        axes.plot(ticks, returns, color=COLOURS[method], linewidth=0.6, alpha=0.5)
        axes.plot(ticks, iqm(returns), color=COLOURS[method], linewidth=2.2, label=LABELS[method])
    axes.set_xlabel("interactions with the task, per seed")
    axes.set_ylabel("return of an episode")
    axes.spines[["top", "right"]].set_visible(False)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1e6:g} M")
    axes.legend(frameon=False, loc="lower right")


def main() -> None:
    """Write the picture."""
    arguments = tyro.cli(Arguments)
    config = load_config(str(arguments.run / "config.yaml"))
    rows = read_metrics(arguments.run / "metrics.jsonl")
    stages = {"flat": "flat" if config.collect.env else "collect", "taic": "train"}
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), width_ratios=(4, 5), layout="constrained")
    with Image.open(arguments.run / "video.webp") as video:
        video.seek(video.n_frames * 2 // 3)
        left.imshow(video.convert("RGB"))
    left.set_axis_off()
    draw_curves(right, rows, stages)
    right.set_title(f"{config.env.name}, {config.seeds} seeds", loc="left", fontsize=10)
    figure.savefig(arguments.out, dpi=120)


if __name__ == "__main__":
    main()
