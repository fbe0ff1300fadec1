"""Draw every task: a picture and a short animation of each, and one sheet of them all: `taic envs`."""

import dataclasses
import math
import re
import sys
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro
from jax import Array
from jaxtyping import Key, UInt8
from PIL import Image, ImageDraw, ImageFont

from taic_jax.command_line import tell, typed
from taic_jax.config import impossible
from taic_jax.envs import AutoReset, Env, State, environment_names, make_env
from taic_jax.envs.rendering import write_webp

PROGRAM = "taic envs"
HEIGHT, WIDTH = 300, 400  # pixels of every picture
GAP, CAPTION = 20, 36  # pixels between the tiles of the sheet, and below each for its name
INK, PAPER, FRAME = "#3d4451", "#ffffff", "#c9ccd2"
MEMORY = 10  # ticks of correlation of the random actions; with fewer a body only shivers
SPREAD = 0.8  # their standard deviation, before they are clipped


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Draw tasks under smooth random actions: NAME.png and NAME.webp for each."""

    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("pictures")
    """Folder for the pictures."""
    tasks: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")] = ()
    """Tasks to draw, by any name that make_env takes; none means all of this package."""
    contact_sheet: Annotated[Path | None, tyro.conf.arg(metavar="FILE.png")] = None
    """Also write one picture that shows all tasks with their names."""
    ticks: int = 100  # Length of the animations.


def main(args: Sequence[str] | None = None) -> int:
    """Draw, and return the exit code: 0, or 2 for a mistake of the user or a machine that cannot draw."""
    return tell(lambda: draw(typed(sys.argv[1:] if args is None else args, PROGRAM, Arguments)))


def draw(arguments: Arguments) -> None:
    """Write the pictures, and print the path of each; raise at a wrong name before any is written."""
    if arguments.ticks < 1:
        raise impossible("--ticks", arguments.ticks, "at least 1", 1)
    sheet = arguments.contact_sheet
    if sheet and sheet.suffix.lower() != ".png":
        raise impossible("--contact-sheet", sheet, "a .png file", f"{sheet}.png")
    envs = [make_env(name) for name in arguments.tasks or environment_names()]
    arguments.out.mkdir(parents=True, exist_ok=True)
    tiles = {}
    for env in envs:
        key = jax.random.key(zlib.crc32(env.name.encode()) >> 1)  # of the name alone, not of the other tasks
        states = jax.device_get(random_episodes(env, key, arguments.ticks))
        frames = env.render(states.physics, height=HEIGHT, width=WIDTH)
        path = arguments.out / re.sub(r"[^\w-]+", "_", env.name)
        picture, film = path.with_suffix(".png"), path.with_suffix(".webp")
        tiles[env.name] = frames[still(states.terminated | states.truncated)]
        Image.fromarray(tiles[env.name]).save(picture)
        write_webp(film, frames, env.dt)
        print(picture, film, sep="\n", flush=True)
    if sheet:
        sheet.parent.mkdir(parents=True, exist_ok=True)
        contact_sheet(tiles).save(sheet)
        print(sheet)


def random_episodes(env: Env, key: Key[Array, ""], ticks: int) -> State:
    """Act at random with automatic resets; return the states after each tick, leading axis T.

    The actions are white noise through a first-order filter: a slow body would average white noise away.
    """
    env, keep = AutoReset(env), math.exp(-1.0 / MEMORY)
    key_reset, key_start, key_noise = jax.random.split(key, 3)

    def tick(carry: tuple[State, Array], noise: Array) -> tuple[tuple[State, Array], State]:
        state, drift = carry
        drift = keep * drift + math.sqrt(1.0 - keep**2) * noise
        state = env.step(state, (SPREAD * drift).clip(-1.0, 1.0))
        return (state, drift), state

    @jax.jit
    def episodes() -> State:
        noise = jax.random.normal(key_noise, (ticks, env.action_size))
        start = (env.reset(key_reset), jax.random.normal(key_start, (env.action_size,)))
        return jax.lax.scan(tick, start, noise)[1].replace(key=None)

    return episodes()


def still(ended: np.ndarray) -> int:
    """Return the tick in the middle of the longest episode of `ended` [T]."""
    edges = np.concatenate([[0], np.flatnonzero(ended), [len(ended)]])
    longest = np.argmax(np.diff(edges))
    return int((edges[longest] + edges[longest + 1]) // 2)


def contact_sheet(tiles: dict[str, UInt8[np.ndarray, "height width 3"]]) -> Image.Image:
    """Arrange pictures of one size on a grid with the fewest empty places, each with its name below."""
    height, width, _ = next(iter(tiles.values())).shape
    columns = min(range(3, 6), key=lambda n: (-len(tiles) % n, abs(n - 4))) if len(tiles) > 3 else len(tiles)
    rows = math.ceil(len(tiles) / columns)
    across, down = width + GAP, height + CAPTION + GAP
    sheet = Image.new("RGB", (columns * across + GAP, rows * down + GAP), PAPER)
    brush, font = ImageDraw.Draw(sheet), ImageFont.load_default(0.6 * CAPTION)
    for index, (name, picture) in enumerate(tiles.items()):
        x, y = GAP + index % columns * across, GAP + index // columns * down
        sheet.paste(Image.fromarray(picture), (x, y))
        brush.rectangle((x - 1, y - 1, x + width, y + height), outline=FRAME, width=2)
        brush.text((x + width / 2, y + height + CAPTION / 2), name, INK, font, anchor="mm")
    return sheet
