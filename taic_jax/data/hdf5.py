"""HDF5 files through h5py: D4RL's flat arrays, and a group per episode as Minari and robomimic write it."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from taic_jax.data.arrays import Layout, Place, read_arrays, read_episodes, reading
from taic_jax.data.flat import flat_layout
from taic_jax.options.dataset import Experience

MINARI = Layout(
    "Minari", ("observations",), "actions", "rewards", ends=("terminations", "truncations"), num_last=1
)  # fmt: skip
# robomimic's `dones` are not ends: they may also mark every tick of success.
ROBOMIMIC = Layout("robomimic", (), "actions", "rewards", optional=True)


def read_hdf5(path: Path, observations: Sequence[str], actions: str) -> tuple[Experience, Layout]:
    """Read one file whose layout its groups tell, or raise ArtifactError."""
    with reading(path, "h5py"):
        import h5py

        with h5py.File(path, "r") as file:
            place = Place(path)
            if numbers := _numbered("episode", file):
                names = [f"episode_{n}" for n in numbers]
                return read_minari_groups([(place / name, file[name]) for name in names], observations, actions)
            if hasattr(data := file.get("data"), "keys"):
                return _read_robomimic(place / "data", data, observations, actions)
            layout = flat_layout(place, file, observations, actions)
            return read_arrays(place, file, layout), layout


def read_minari_groups(
    groups: Sequence[tuple[Place, Any]], observations: Sequence[str], actions: str
) -> tuple[Experience, Layout]:
    """Read the episodes of a Minari dataset, groups of HDF5 or dicts of arrays.

    Of observations that are a group the entry `observation` is taken unless others are chosen.
    """
    layout = MINARI._replace(actions=actions or MINARI.actions)
    for place, group in groups[:1]:
        if "observations" in group and hasattr(group["observations"], "keys"):
            names = tuple(f"observations/{name}" for name in observations or ("observation",))
            layout = layout._replace(observations=names)
        elif observations:
            raise place.refuse(f"expected observations in a group with {', '.join(observations)}, got one array")
    return read_episodes(groups, layout), layout


def _read_robomimic(place: Place, data: Any, observations: Sequence[str], actions: str) -> tuple[Experience, Layout]:
    demos = [(place / f"demo_{n}", data[f"demo_{n}"]) for n in _numbered("demo", data)]
    if not demos:
        raise place.refuse("expected groups demo_0, demo_1, ..., got none")
    there = list(demos[0][1].get("obs", ()))
    if not observations and len(there) != 1:
        expected = "expected a choice by --observations KEY..." if there else "expected observations in group obs"
        raise demos[0][0].refuse(f"{expected}, got {', '.join(there) or 'none'}")
    names = tuple(f"obs/{name}" for name in observations or there)
    layout = ROBOMIMIC._replace(observations=names, actions=actions or ROBOMIMIC.actions)
    return read_episodes(demos, layout), layout


def _numbered(prefix: str, group: Any) -> list[int]:
    """Return the numbers of the entries `prefix_0`, `prefix_1`, ... in order."""
    pattern = re.compile(f"{prefix}_(0|[1-9][0-9]*)")
    return sorted(int(match[1]) for name in map(str, group) if (match := pattern.fullmatch(name)))
