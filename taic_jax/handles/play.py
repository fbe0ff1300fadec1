"""Film the agents of a finished run: `taic play RUN`; see docs/use.md. Nothing is trained or changed."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from PIL import Image, ImageDraw

from taic_jax.config import TAIC, impossible, method_label
from taic_jax.handles import command
from taic_jax.handles.command import agent_of, answer, methods_of

if TYPE_CHECKING:
    from taic_jax.handles.load import Handle

PROGRAM = "taic play"
WINDOW = 80  # frames in the strip of options
MARK = (255, 255, 255)


@dataclass(frozen=True)
class Command(command.Command):
    """Film one episode of an agent, with its running option; of several methods, side by side, by default of taic."""

    seed: int = 0
    """Seed of the run whose agent acts, counted from 0."""
    ticks: int = 0
    """Ticks to film; 0 films an episode."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("play.webp")
    """Film to write: a name that ends in .webp, .gif or, with the extra video, .mp4."""


def main(args: Sequence[str]) -> int:
    """Run one command and return its exit code: 0, or 2 for a mistake or a machine that cannot draw."""
    return answer(args, PROGRAM, Command, execute)


def execute(command: Command, handle: "Handle") -> None:
    """Film, write the file and print its path and the returns."""
    methods = methods_of(command, handle, (TAIC,))
    agent_of(handle, methods[0], "--methods", command.seed)
    if command.ticks < 0:
        raise impossible("--ticks", command.ticks, "at least 0", 0)
    from taic_jax.envs.rendering import check_film, ticks_per_frame, write_film
    from taic_jax.runtime.files import atomic_file

    check_film(command.out)
    if not command.out.parent.is_dir():
        raise impossible("--out", command.out, "a file in a folder that exists", command.out.name)
    films = [film(handle, name, command) for name in methods]
    frames = np.concatenate([np.pad(x, ((0, max(map(len, films)) - len(x)), *[(0, 0)] * 3), "edge") for x in films], 2)
    with atomic_file(command.out) as file:
        write_film(command.out, file, frames, handle.env.dt * ticks_per_frame(handle.env.dt))
    print(command.out)


def film(handle: "Handle", method: str, command: Command) -> np.ndarray:
    """Return the frames [F, H, W, 3] of one episode, or of `--ticks` ticks, and print the return."""
    import jax

    from taic_jax.analysis.evaluate import trace
    from taic_jax.envs.rendering import ticks_per_frame

    env, agent = handle.env, handle.agents[method][command.seed]
    length, key = command.ticks or env.episode_length, jax.random.key(command.key)

    def run(agent: Any, key: Any) -> Any:
        return trace(env, agent, key, length, float(command.explore))

    ticks = jax.device_get(jax.jit(run)(agent, key))
    done = ticks.terminated | ticks.truncated
    end = int(np.argmax(done)) + 1 if done.any() and not command.ticks else length
    ticks = jax.tree.map(lambda x: x[:end], ticks)
    count = int(ticks.decision.sum())
    label = method_label(method, handle.config.collect.learner)
    print(f"{label}: return {ticks.reward.sum():,.1f} in {end} ticks and {count} decisions")
    latest = np.maximum.accumulate(np.where(ticks.decision, np.arange(end), 0))
    marks = ticks.decision if agent.executor.length > 1 else np.zeros(end, bool)  # flat PPO decides at every tick
    shown = np.arange(0, end, ticks_per_frame(env.dt))
    frames = env.render(jax.tree.map(lambda x: x[shown], ticks.extras))
    options = ticks.option[latest[shown]]
    if handle.config.options.choose == "way" and method == TAIC:
        frames = with_compass(frames, options)
    return with_label(with_options(frames, options, np.logical_or.reduceat(marks, shown)), label)


def with_label(frames: np.ndarray, text: str) -> np.ndarray:
    """Write a text into the corner of each frame, white on a darkened ground."""
    image = Image.new("L", (frames.shape[2], 16))
    draw = ImageDraw.Draw(image)
    draw.text((6, 3), text, fill=255)
    corner = frames[:, :16, : int(draw.textlength(text)) + 12]
    corner[:] = np.maximum(corner // 4, np.asarray(image)[:, : corner.shape[2], None])
    return frames


def with_compass(frames: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Draw in the upper right corner of each frame an arrow along the way [F, 2] of its option: x right, y up."""
    radius = max(frames.shape[1] // 10, 12)
    centre = np.array([frames.shape[2] - radius - 4, radius + 4])
    head = np.array([[1.0, 0.0], [-0.2, 0.5], [-0.2, -0.5]])
    drawn = []
    for frame, way in zip(frames, ways, strict=True):
        x, y = way / max(np.linalg.norm(way), 1e-6) * (1, -1)  # pixels count downwards
        image = Image.fromarray(frame)
        draw = ImageDraw.Draw(image)
        draw.circle(tuple(centre), radius, outline=MARK, width=2)
        tips = centre + 0.8 * radius * head @ np.array([[x, y], [-y, x]])
        draw.line([tuple(centre - 0.7 * radius * np.array([x, y])), tuple(centre)], fill=MARK, width=2)
        draw.polygon([tuple(tip) for tip in tips], fill=MARK)
        drawn.append(np.asarray(image))
    return np.stack(drawn)


def with_options(frames: np.ndarray, options: np.ndarray, decision: np.ndarray) -> np.ndarray:
    """Draw the options [F, D] of the last frames below each, as colours, with a mark at each decision."""
    count, height, width, _ = frames.shape
    colours = np.zeros((count, 3))
    shown = min(3, options.shape[1])
    colours[:, :shown] = np.tanh(options[:, :shown] / 2)
    colours = (127.5 + 100 * colours).astype(np.uint8)
    cell, strip = max(width // WINDOW, 1), max(height // 24, 4)
    for t, frame in enumerate(frames):
        for age in range(min(WINDOW, t + 1)):
            right = width - age * cell
            frame[-strip:, max(right - cell, 0) : right] = colours[t - age]
            if decision[t - age]:
                frame[-strip:, max(right - cell, 0)] = MARK
    return frames
