"""Export an agent of a finished run for programs without this package: `taic export RUN`; see docs/use.md."""

import sys
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from taic_jax import __version__
from taic_jax.config import TAIC, ConfigError
from taic_jax.handles.command import OnRun, agent_of, answer

if TYPE_CHECKING:
    from taic_jax.handles.load import Handle

PROGRAM = "taic export"
FORMAT = 1  # of the files
ABOUT = "agent.json"


@dataclass(frozen=True)
class Command(OnRun):
    """Write one tick of an agent under its mean options, as a function of an observation and a carry."""

    format: tuple[Literal["jax", "onnx", "npz"], ...] = ("jax",)
    """Files to write: jax (StableHLO for CPU and CUDA), onnx (extra onnx), npz (the layers, for NumPy)."""
    method: str = TAIC
    """Method by name, such as taic or flat."""
    seed: int = 0
    """Seed of the run whose agent is exported, counted from 0."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("export")
    """Folder for agent.json and agent.stablehlo, agent.onnx or agent.npz, in place of an earlier export."""


def main(args: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code: 0, or 2 for a mistake."""
    return answer(args, PROGRAM, Command, execute)


def _sees_heading(handle: "Handle") -> bool:
    options = handle.config.options
    return options.frame == "heading" or options.way_weight > 0


def execute(command: Command, handle: "Handle") -> None:
    """Write the files, once all are known, and print their paths."""
    from taic_jax.artifacts.models import describe
    from taic_jax.handles.tick import FILES, export
    from taic_jax.runtime.files import atomic_file, save_json, writing

    if not command.format:
        raise ConfigError(f"--format: expected some of {', '.join(FILES)}, got none")
    if "npz" in command.format and command.method == TAIC and _sees_heading(handle):
        expected = "jax or onnx for options that see the heading, which layers alone do not tell"
        raise ConfigError(f"--format: expected {expected}; got npz")
    files, function = export(agent_of(handle, command.method, "--method", command.seed), command.format)
    options = handle.config.options if command.method == TAIC else None
    about = {
        "format": FORMAT, "taic_jax": __version__, "method": command.method, "seed": command.seed,
        **describe(handle.env), "dt": handle.env.dt, **function,
        "decoder": options and options.decoder, "termination": options and options.termination,
        "crc32": {name: zlib.crc32(content) for name, content in files.items()},
    }  # fmt: skip
    with writing(command.out):
        command.out.mkdir(parents=True, exist_ok=True)
        for name in (ABOUT, *FILES.values()):  # those of an earlier export: none is described by another's agent.json
            (command.out / name).unlink(missing_ok=True)
    for name, content in files.items():
        with atomic_file(command.out / name) as file:
            file.write(content)
    save_json(command.out / ABOUT, about)
    print(*(command.out / name for name in (*files, ABOUT)), sep="\n")


if __name__ == "__main__":
    sys.exit(main())
