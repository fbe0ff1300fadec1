"""Flat arrays, all steps of all episodes one after another: NumPy's files, ours and OGBench's, and D4RL's names."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taic_jax.data.arrays import Layout, Place, nearest_name, read_arrays, reading
from taic_jax.options.dataset import Experience
from taic_jax.runtime.checkpoint import ArtifactError

OWN = Layout("taic_jax", ("obs",), "action", "reward", ends=("done",))
D4RL = Layout(
    "D4RL or OGBench", ("observations",), "actions", "rewards", ends=("terminals", "timeouts"), optional=True
)  # fmt: skip


def read_npz(path: Path, observations: Sequence[str], actions: str) -> tuple[Experience, Layout]:
    """Read a NumPy file; nothing is unpickled. Raise ArtifactError for anything else."""
    with reading(path), path.open("rb") as file:
        if file.read(2) != b"PK":
            raise ArtifactError(f"{path}: expected an .npz file as np.savez writes it, got another kind of file")
        file.seek(0)
        with np.load(file, allow_pickle=False) as archive:
            place = Place(path)
            layout = flat_layout(place, archive, observations, actions)
            return read_arrays(place, _Opened(archive), layout), layout


def flat_layout(place: Place, group: Any, observations: Sequence[str], actions: str) -> Layout:
    """Return the layout that the names of flat arrays tell, with the chosen observations and actions."""
    layout = next((layout for layout in (OWN, D4RL) if set(layout.ends) & set(group)), None)
    if layout is None:
        names = [*OWN.ends, *D4RL.ends]
        expected = f"expected the ends of episodes, {', '.join(names)}, or groups episode_0 or data/demo_0"
        raise place.refuse(f"{expected}, got {', '.join(map(str, group)) or 'none'}{nearest_name(names[1], group)}")
    return layout._replace(
        observations=tuple(observations) or layout.observations, actions=actions or layout.actions
    )  # fmt: skip


class _Opened(dict):
    """The arrays of an archive, each read once it is asked for, and none kept."""

    def __init__(self, archive: Any):
        super().__init__(dict.fromkeys(archive.files))
        self._archive = archive

    def __getitem__(self, name: str) -> np.ndarray:
        return self._archive[name]
