"""Demonstrations of others as one column of experience, from NumPy's or Minari's files (docs/demonstrations.md)."""

import contextlib
import difflib
import json
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from taic_jax.envs.errors import MissingExtraError
from taic_jax.options.dataset import Experience
from taic_jax.runtime.checkpoint import ArtifactError

TOLERANCE = 1e-3  # actions are clipped if they exceed [-1, 1] by at most this; beyond, they have another scale
HDF5_SUFFIXES = (".hdf5", ".h5")
SUPPORTED = "an .npz file, an .hdf5 file, or a Minari dataset's folder with data_format hdf5"
MAIN_FILE = "main_data.hdf5"
NPZ_NAMES = ("obs", "action", "reward", "done")
HDF5_NAMES = ("observations", "actions", "rewards", "terminations", "truncations")
EPISODE = re.compile("episode_(0|[1-9][0-9]*)")


def read_demonstrations(path: Path, proprioceptive_size: int, action_size: int) -> Experience:
    """Read recorded episodes as experience [T, 1, ...]: one after another, in NumPy float32 and bool.

    `done` is true at every episode's last tick, also if the recording omits it. Of longer observations the first
    P = `proprioceptive_size` entries are taken: they must be in the task's own order. Actions are in [-1, 1].

    Layouts:
      `.npz`: flat arrays `obs` [N, P or more], `action` [N, A], `reward` [N] and `done` [N] bool, true at an episode's
        last tick. Other arrays are ignored.
      Minari: the dataset's folder, its `data` folder or the `.hdf5` file, with groups `episode_0`, `episode_1`, ...
        of `observations` [n+1, P or more], `actions` [n, A], `rewards`, `terminations` and `truncations` [n]. If
        `observations` is a group, its entry `observation` is taken. Needs h5py.

    Raises:
      ArtifactError: the path holds nothing, another layout, sizes that disagree, a number that is not finite, or an
        action beyond [-1, 1], or h5py is missing.
    """
    with _reading(path):
        path = _find_file(path)
    sizes = proprioceptive_size, action_size
    if path.suffix.lower() == ".npz":
        action_name, episodes = NPZ_NAMES[1], [_read_npz(path, sizes)]
    elif path.suffix.lower() in HDF5_SUFFIXES:
        action_name, episodes = HDF5_NAMES[1], _read_hdf5(path, sizes)
    else:
        raise ArtifactError(f"{path}: unknown kind of file {path.suffix!r}; supported: {SUPPORTED}")
    if sum(len(episode.reward) for episode in episodes) == 0:
        raise ArtifactError(f"{path}: expected demonstrations, got no tick")
    whole = jax.tree.map(lambda *parts: np.concatenate(parts)[:, None], *episodes)
    largest = whole.action.flat[np.argmax(np.abs(whole.action))]
    if abs(largest) > 1 + TOLERANCE:
        expected = f"expected actions in [-1, 1], got {largest:g}: scale them to [-1, 1]"
        raise ArtifactError(f"{path}: {action_name}: {expected}")
    return whole.replace(action=np.clip(whole.action, -1, 1))


def _find_file(path: Path) -> Path:
    """Return the file with the arrays: `path` itself, or Minari's main file in the folder `path`."""
    if not path.exists():
        raise ArtifactError(f"{path}: expected demonstrations, got nothing")
    if not path.is_dir():
        return path
    data = path / "data" if (path / "data").is_dir() else path
    metadata = data / "metadata.json"
    if metadata.exists():
        with _reading(metadata):
            stored = json.loads(metadata.read_bytes())
        layout = stored.get("data_format", "hdf5") if isinstance(stored, dict) else None
        if layout != "hdf5":
            raise ArtifactError(f"{metadata}: expected hdf5 at data_format, got {layout!r}; supported: {SUPPORTED}")
    if not (data / MAIN_FILE).exists():
        raise ArtifactError(f"{path}: expected {MAIN_FILE} or data/{MAIN_FILE} in it; supported: {SUPPORTED}")
    return data / MAIN_FILE


def _read_npz(path: Path, sizes: tuple[int, int]) -> Experience:
    """Return all ticks of a NumPy file, leading axis N."""
    with _reading(path), path.open("rb") as file:
        if file.read(2) != b"PK":
            raise ArtifactError(f"{path}: expected an .npz file as np.savez writes it, got another kind of file")
        file.seek(0)
        with np.load(file, allow_pickle=False) as archive:
            _require(path, NPZ_NAMES, archive.files)
            sources = {name: archive[name] for name in NPZ_NAMES}
    return _as_experience(f"{path}: ", sources, sizes)


def _read_hdf5(path: Path, sizes: tuple[int, int]) -> list[Experience]:
    """Return the episodes of a Minari file in the order of their numbers, each with leading axis n."""
    try:
        import h5py
    except ImportError:
        raise ArtifactError(f"{path}: {MissingExtraError('h5py', 'data')}") from None
    with _reading(path), h5py.File(path, "r") as file:
        numbers = sorted(int(name[8:]) for name in map(str, file) if EPISODE.fullmatch(name))
        if not numbers:
            raise ArtifactError(f"{path}: expected groups episode_0, episode_1, ..., got none")
        return [_read_episode(f"{path}: episode_{n}", file[f"episode_{n}"], sizes) for n in numbers]


def _read_episode(label: str, group: Any, sizes: tuple[int, int]) -> Experience:
    if not hasattr(group, "keys"):
        raise ArtifactError(f"{label}: expected a group, got an array")
    _require(label, HDF5_NAMES, group.keys())
    obs_name, *others = HDF5_NAMES
    obs = group[obs_name]
    if hasattr(obs, "keys"):
        _require(f"{label}/{obs_name}", ["observation"], obs.keys())
        obs_name, obs = f"{obs_name}/observation", obs["observation"]
    return _as_experience(f"{label}/", {obs_name: obs, **{name: group[name] for name in others}}, sizes, num_last=1)


def _as_experience(label: str, sources: dict[str, Any], sizes: tuple[int, int], num_last: int = 0) -> Experience:
    """Check and join observations, without the `num_last` after the last tick, actions, rewards and ends, by name."""
    obs, action, reward, *ends = ((f"{label}{name}", source) for name, source in sources.items())
    shape = getattr(action[1], "shape", None)
    count = shape[0] if shape else 0  # the checks refuse any other source
    actions = _numbers(*action, (count, sizes[1]))
    states = _numbers(*obs, (count + num_last, sizes[0]), longer=True)
    rewards = _numbers(*reward, (count,))
    for name, source in ends:
        if _kind(source) != "b" or source.shape != (count,):
            raise ArtifactError(f"{name}: expected bool [{count}], got {_show(source)}")
    done = np.logical_or.reduce([source[...] for _, source in ends])
    done[-1:] = True
    return Experience(states[:count], actions, rewards, done)


def _require(label: str | Path, required: Sequence[str], present: Iterable[str]) -> None:
    names = list(present)
    for name in (name for name in required if name not in names):
        nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.0)
        hint = f"; the nearest name is {nearest[0]!r}" if nearest else ""
        raise ArtifactError(f"{label}: expected {name} in it, got nothing{hint}")


def _numbers(label: str, source: Any, shape: tuple[int, ...], longer: bool = False) -> np.ndarray:
    """Return an array of NumPy or HDF5 as finite float32 of this shape; cut its rows if they may be `longer`."""
    sizes = ", ".join(map(str, shape)) + (" or more" if longer else "")
    actual: tuple[int, ...] = getattr(source, "shape", None) or ()
    cut = longer and actual[:-1] == shape[:-1] and actual[-1:] > shape[-1:]
    if _kind(source) not in "fiub" or not (actual == shape or cut):
        raise ArtifactError(f"{label}: expected numbers [{sizes}], got {_show(source)}")
    with np.errstate(over="ignore"):  # numbers too large for float32 are counted below
        array = np.asarray(source[..., : shape[-1]]).astype(np.float32)
    if wrong := np.count_nonzero(~np.isfinite(array)):
        raise ArtifactError(f"{label}: expected finite numbers, got {wrong} of {array.size} that are NaN or infinite")
    return array


def _kind(source: Any) -> str:
    """Return the letter of an array's dtype in NumPy, or a blank for a group."""
    return source.dtype.kind if hasattr(source, "dtype") else " "


def _show(source: Any) -> str:
    if not hasattr(source, "dtype"):
        return "a group" if hasattr(source, "keys") else "no array"
    return f"{source.dtype} [{', '.join(map(str, source.shape or ()))}]"


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn any error of reading into one line."""
    try:
        yield
    except ArtifactError:
        raise
    except Exception as error:  # damaged bytes fail in as many ways as zip, zlib, NumPy and HDF5 have
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ArtifactError(f"{path}: damaged, or another kind of file ({reason})") from None
