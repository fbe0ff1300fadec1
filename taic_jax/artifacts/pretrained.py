"""Agents that ship with the package: `pretrained:NAME` is a source of options and of agents, as a run's folder is."""

from importlib import resources
from pathlib import Path

from taic_jax.config.files import nearest
from taic_jax.runtime.checkpoint import ArtifactError

PREFIX = "pretrained:"


def locate(source: str | Path) -> Path:
    """Return the folder that a source names, or raise ArtifactError if no pretrained agents have this name."""
    name = str(source).removeprefix(PREFIX)
    if name == str(source):
        return Path(source)
    if name not in (names := pretrained_names()):
        hint = nearest(name, names) or f"; there are {', '.join(names)}"
        raise ArtifactError(f"unknown pretrained agents {name!r}{hint}")
    return _folder() / name


def pretrained_names() -> list[str]:
    """List the agents that ship with the package."""
    return sorted(path.name for path in _folder().iterdir())


def _folder() -> Path:
    return Path(str(resources.files("taic_jax.experiments") / "pretrained"))
