"""Make the agents that ship with the package: train one seed of each preset, and keep its agents with a card.

python -m taic_jax.experiments.pretrain [--only NAME ...] [--run-dir DIR]

A finished run is only evaluated again, and an interrupted one goes on.
"""

import dataclasses
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tyro

from taic_jax.artifacts.models import AGENTS
from taic_jax.command_line import tell
from taic_jax.config import COLLECT, TAIC, Config, ConfigError, experience_ticks, replace
from taic_jax.config.files import load_config, nearest
from taic_jax.pipeline import run_pipeline
from taic_jax.runtime.files import save_json
from taic_jax.runtime.program_cache import keep_programs
from taic_jax.runtime.run_folder import RunFolder, Summary

FOLDER = Path(__file__).parent / "pretrained"
GYM: dict[str, Any] = {"env.model": "gym"}  # so that the agents act in Gymnasium too
AS_LEARNT: dict[str, Any] = {"train.fine_tune.epochs": 0}  # options to carry to other tasks
CHANGES = {
    "nav2d": {}, "half_cheetah": GYM, "hopper": GYM, "walker2d": GYM, "ant": AS_LEARNT, "ant_steering": AS_LEARNT,
    "steering": {"seed": 1},
}  # fmt: skip
"""The presets, and the fields of each that differ here."""


@dataclasses.dataclass(frozen=True)
class Command:
    """Train the agents that ship with the package, and write them to experiments/pretrained."""

    only: tuple[str, ...] = tuple(CHANGES)
    """Names of presets."""
    run_dir: Path = Path("runs/pretrained")
    """Folder of the runs, one each."""


def main(args: Sequence[str] | None = None) -> int:
    """Make the agents and return the exit code."""
    return tell(lambda: execute(tyro.cli(Command, args=args, description=__doc__)))


def execute(command: Command) -> None:
    """Train, and replace each folder."""
    for name in command.only:
        if name not in CHANGES:
            raise ConfigError(f"--only: expected some of {', '.join(CHANGES)}, got {name}{nearest(name, CHANGES)}")
    keep_programs()
    for name in command.only:
        config = load_config(name)
        for field, value in {"seeds": 1, "evaluate.episodes": 100, "evaluate.video_ticks": 0, **CHANGES[name]}.items():
            config = replace(config, field, value)
        run = RunFolder(command.run_dir / name)
        summary = run_pipeline(config, run.path, resume=run.begun).summary
        shutil.rmtree(FOLDER / name, ignore_errors=True)
        for method in (TAIC, COLLECT):
            shutil.copytree(run.path / AGENTS / method, FOLDER / name / AGENTS / method)
        save_json(FOLDER / name / "card.json", card(name, config, summary))
        print(FOLDER / name)


def card(name: str, config: Config, summary: Summary) -> dict[str, Any]:
    """Return the origin and the returns of pretrained agents."""
    collect, methods = config.collect, summary["methods"]
    return {
        "preset": name,
        "changes": CHANGES[name],
        "task": config.env.name,
        "data": f"the last {experience_ticks(collect):,} of {collect.ticks:,} ticks of flat "
        f"{collect.learner.upper()}'s training on {collect.env or config.env.name}",
        "interactions": summary["ticks"],
        "episodes": config.evaluate.episodes,
        "return_mean_option": {method: x["return_mean_option"]["mean"] for method, x in methods.items()},
        "seconds": summary["seconds"],
        "commit": summary["commit"],
        "versions": summary["versions"],
    }


if __name__ == "__main__":
    sys.exit(main())
