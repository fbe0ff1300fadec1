"""Other people's data as one column of experience: each format by its own reader, then the same checks and scale."""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from taic_jax.data.arrays import Place, reading
from taic_jax.data.flat import read_npz
from taic_jax.data.hdf5 import read_hdf5, read_minari_groups
from taic_jax.data.lerobot import INFO, read_lerobot
from taic_jax.options.dataset import Experience
from taic_jax.runtime.checkpoint import ArtifactError

TOLERANCE = 1e-3  # actions are clipped if they exceed [-1, 1] by at most this; beyond, they have another scale
MOST_CLIPPED = 0.05  # share of an action's numbers beyond stated bounds; beyond, the bounds are wrong
QUANTILES = 0.01, 0.99
HDF5_SUFFIXES = (".hdf5", ".h5")
SUPPORTED = "an .npz file, an .hdf5 file, or the folder of a Minari or LeRobot dataset"
MAIN_FILE = "main_data.hdf5"


class Recording(NamedTuple):
    """Recorded episodes [T, ...], one after another, and where they are from, for messages."""

    experience: Experience
    path: Path
    layout: str
    actions: str  # the name of their array
    note: str = ""

    @property
    def sizes(self) -> tuple[int, int]:
        """Entries of an observation and of an action."""
        return self.experience.obs.shape[-1], self.experience.action.shape[-1]

    @property
    def summary(self) -> str:
        """What was read, in one line."""
        episodes, steps = int(self.experience.done.sum()), len(self.experience.done)
        low, high = self.experience.action.min(), self.experience.action.max()
        sizes = "{} observations, {} actions".format(*self.sizes)
        read = f"{episodes:,} episodes, {steps:,} steps, {sizes} in [{low:.4g}, {high:.4g}]"
        return f"{self.path}: {self.layout}, {read}{self.note}"

    def fitted(self, observation_size: int, action_size: int) -> "Recording":
        """Return the recording with the first so many observations, or raise ArtifactError for another body."""
        size, actions = self.sizes
        if size < observation_size or actions != action_size:
            expected = f"expected at least {observation_size} observations and {action_size} actions"
            raise ArtifactError(f"{self.path}: {expected}, as the body has; got {size} and {actions}")
        if size == observation_size:
            return self
        obs = np.ascontiguousarray(self.experience.obs[:, :observation_size])
        note = f"{self.note}, of observations the first {observation_size} of {size}"
        return self._replace(experience=self.experience.replace(obs=obs), note=note)

    def scaled(self, bounds: Sequence[float]) -> "Recording":
        """Return the recording with actions in [-1, 1], which stand for `bounds`; see `bounds_of`."""
        action, place = self.experience.action, Place(self.path, self.actions)
        if not bounds:
            largest = action.flat[np.argmax(np.abs(action))]
            if abs(largest) > 1 + TOLERANCE:
                hint = "state their --action-bounds LOW HIGH, or scale by --action-scale quantiles"
                raise place.refuse(f"expected actions in [-1, 1], got {largest:g}; {hint}")
            return self._replace(experience=self.experience.replace(action=np.clip(action, -1, 1)))
        low, high = bounds_of(place, bounds, action.shape[1])
        scaled = (action - (low + high) / 2) / ((high - low) / 2)
        beyond = np.mean(np.abs(scaled) > 1 + TOLERANCE, axis=0)
        if (worst := beyond.argmax()) >= 0 and beyond[worst] > MOST_CLIPPED:
            expected = f"expected entry {worst} in [{low[worst]:g}, {high[worst]:g}], as bounds say"
            raise place.refuse(
                f"{expected}; got {beyond[worst]:.0%} of its numbers beyond, e.g. {action[:, worst].max():g}"
            )
        note = f"{self.note}, scaled to [-1, 1] from stated bounds, {beyond.mean():.2%} clipped"
        return self._replace(experience=self.experience.replace(action=np.clip(scaled, -1, 1)), note=note)


def read_data(
    path: str | Path,
    observations: Sequence[str] = (),
    actions: str = "",
    bounds: Sequence[float] = (),
    sizes: tuple[int, int] | None = None,
) -> Experience:
    """Read recorded episodes as experience [T, 1, ...], in NumPy float32 and bool, and say so on standard error.

    `done` is true at every episode's last step, also if the recording omits it. See docs/skills_from_your_logs.md.

    Args:
      path: a file or folder of a supported format.
      observations: names of the arrays that are joined to observations; by default those usual in the format.
      actions: name of the array of actions.
      bounds: lowest and highest action, of all entries or of each: see `bounds_of`. They become -1 and 1.
      sizes: entries of a body's observation, the first of which are taken, and of its action.

    Raises:
      ArtifactError: the path holds nothing, another layout, sizes that disagree, a number that is not finite, or an
        action beyond the bounds, or a package is missing.
    """
    recording = read_recording(Path(path), observations, actions)
    recording = (recording.fitted(*sizes) if sizes else recording).scaled(bounds)
    print(f"taic_jax: {recording.summary}", file=sys.stderr)
    return as_column(recording.experience)


def read_recording(path: Path, observations: Sequence[str] = (), actions: str = "") -> Recording:
    """Read recorded episodes as they are, actions in their own scale, or raise ArtifactError."""
    with reading(path):
        if not path.exists():
            raise ArtifactError(f"{path}: expected recorded data, got nothing")
        if path.is_dir() and (path / INFO).exists():
            experience, layout = read_lerobot(path, observations, actions)
        elif path.is_dir():
            experience, layout = _read_minari(path, observations, actions)
        elif path.suffix.lower() == ".npz":
            experience, layout = read_npz(path, observations, actions)
        elif path.suffix.lower() in HDF5_SUFFIXES:
            experience, layout = read_hdf5(path, observations, actions)
        else:
            raise ArtifactError(f"{path}: unknown kind of file {path.suffix!r}; supported: {SUPPORTED}")
    if not len(experience.done):
        raise ArtifactError(f"{path}: expected recorded data, got no step")
    return Recording(experience, path, layout.name, layout.actions)


def _read_minari(path: Path, observations: Sequence[str], actions: str):
    """Read a Minari dataset by its folder or its `data` folder: HDF5 as files are, other formats by Minari."""
    folder = path / "data" if (path / "data").is_dir() else path
    metadata = folder / "metadata.json"
    with reading(metadata):
        stored = json.loads(metadata.read_bytes()) if metadata.exists() else {}
        data_format = stored.get("data_format", "hdf5")
    if data_format == "hdf5":
        if not (folder / MAIN_FILE).exists():
            raise ArtifactError(f"{path}: expected {MAIN_FILE} or data/{MAIN_FILE} in it; supported: {SUPPORTED}")
        return read_hdf5(folder / MAIN_FILE, observations, actions)
    with reading(path, "minari"):
        import minari

        dataset = minari.MinariDataset(folder)
        groups = [(Place(path, f"episode_{episode.id}"), vars(episode)) for episode in dataset.iterate_episodes()]
    experience, layout = read_minari_groups(groups, observations, actions)
    if len(experience.done) != dataset.total_steps:
        expected = f"{dataset.total_steps} steps as total_steps says"
        raise ArtifactError(f"{metadata}: expected {expected}, got {len(experience.done)} in the episodes")
    return experience, layout


def as_column(experience: Experience) -> Experience:
    """Return consecutive steps [T, ...] as the ticks of one environment [T, 1, ...]."""
    return Experience(*(array[:, None] for array in vars(experience).values()))


def bounds_of(place: Place, bounds: Sequence[float], size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest action [A] each, from a pair for all entries, or all lows and then all highs."""
    if len(bounds) not in (2, 2 * size):
        expected = f"2 bounds, or {2 * size}, {size} lows and then {size} highs"
        raise place.refuse(f"expected {expected}, for its {size} entries; got {len(bounds)}")
    low, high = (np.broadcast_to(x, (size,)) for x in np.asarray(bounds, np.float32).reshape(2, -1))
    if not (low < high).all():
        raise place.refuse(f"expected each lower bound below its upper one, got {', '.join(map(str, bounds))}")
    return low, high


def quantile_bounds(recordings: Sequence[Recording]) -> tuple[float, ...]:
    """Return the quantiles 0.01 and 0.99 of each entry of the actions in all recordings: all lows, then all highs."""
    low, high = np.quantile(np.concatenate([x.experience.action for x in recordings]), QUANTILES, axis=0)
    half = np.where(high > low, (high - low) / 2, 1.0)  # an entry that never changes becomes 0
    middle = (low + high) / 2
    return tuple(float(f"{bound:.6g}") for bound in np.concatenate([middle - half, middle + half]))
