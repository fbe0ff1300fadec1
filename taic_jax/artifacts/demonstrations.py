"""Demonstrations: what others recorded, read as one column of experience.

Two layouts are read: a NumPy file of flat arrays, and Minari's HDF5 (docs/demonstrations.md).
"""

import contextlib
import difflib
import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

from taic_jax.envs.errors import MissingExtraError
from taic_jax.options.dataset import Experience
from taic_jax.runtime.checkpoint import ArtifactError

TOLERANCE = 1e-3  # how far an action may stand outside [-1, 1] and is clipped; farther, its scale is another
HDF5_SUFFIXES = (".hdf5", ".h5")
SUPPORTED = "an .npz file, an .hdf5 file, or a Minari dataset's folder with data_format hdf5"
MAIN_FILE = "main_data.hdf5"
EPISODE = re.compile("episode_(0|[1-9][0-9]*)")


def read_demonstrations(path: Path, proprioceptive_size: int, action_size: int) -> Experience:
    """Read recorded episodes as experience [T, 1, ...]: one after another, in NumPy float32 and bool.

    `done` is true at every episode's last tick, whether or not the recording says so. Observations may have more
    than P = `proprioceptive_size` entries, of which the first P are taken: they must stand in the task's own order.
    Actions are in [-1, 1], as the task takes them.

    Layouts:
      `.npz`: flat arrays `obs` [N, P or more], `action` [N, A], `reward` [N] and `done` [N] bool, which is true at
        the tick after which an episode ended; the last tick ends one in any case. Other arrays are ignored.
      Minari: the dataset's folder, its `data` folder or the `.hdf5` file, with groups `episode_0`, `episode_1`, ...
        of `observations` [n+1, P or more], `actions` [n, A], `rewards`, `terminations` and `truncations` [n]. Where
        `observations` is a group, its entry `observation` is taken. Needs h5py.

    Raises:
      ArtifactError: nothing is there, it has another layout, sizes disagree, a number is not finite, an action is
        beyond [-1, 1], or h5py is missing.
    """
    with _reading(path):
        path = _find_file(path)
    if path.suffix.lower() == ".npz":
        action_name, episodes = "action", [_read_npz(path, proprioceptive_size, action_size)]
    elif path.suffix.lower() in HDF5_SUFFIXES:
        action_name, episodes = "actions", _read_hdf5(path, proprioceptive_size, action_size)
    else:
        raise ArtifactError(f"{path}: unknown kind of file {path.suffix!r}; supported: {SUPPORTED}")
    if sum(len(episode.reward) for episode in episodes) == 0:
        raise ArtifactError(f"{path}: expected demonstrations, got no tick")
    whole = jax.tree.map(lambda *parts: np.concatenate(parts)[:, None], *episodes)
    return whole.replace(action=_in_bounds(f"{path}: {action_name}", whole.action))


def _find_file(path: Path) -> Path:
    """Return the file that holds the arrays: `path` itself, or Minari's main file in the folder `path`."""
    if not path.exists():
        raise ArtifactError(f"{path}: expected demonstrations, got nothing")
    return _main_file(path) if path.is_dir() else path


def _main_file(folder: Path) -> Path:
    data = folder / "data" if (folder / "data").is_dir() else folder
    metadata = data / "metadata.json"
    if metadata.exists():
        with _reading(metadata):
            stored = json.loads(metadata.read_bytes())
        layout = stored.get("data_format", "hdf5") if isinstance(stored, dict) else None
        if layout != "hdf5":
            raise ArtifactError(f"{metadata}: expected hdf5 at data_format, got {layout!r}; supported: {SUPPORTED}")
    if not (data / MAIN_FILE).exists():
        raise ArtifactError(f"{folder}: expected {MAIN_FILE} or data/{MAIN_FILE} in it; supported: {SUPPORTED}")
    return data / MAIN_FILE


def _read_npz(path: Path, proprioceptive_size: int, action_size: int) -> Experience:
    """Return all ticks of a NumPy file, leading axis N."""
    stored: dict[str, np.ndarray] = {}
    with _reading(path), path.open("rb") as file:
        if file.read(2) != b"PK":
            raise ArtifactError(f"{path}: expected an .npz file as np.savez writes it, got another kind of file")
        file.seek(0)
        with np.load(file, allow_pickle=False) as archive:
            for name in ("obs", "action", "reward", "done"):
                _require(path, name, archive.files)
                stored[name] = archive[name]
    action = _numbers(f"{path}: action", stored["action"], (_length(stored["action"]), action_size))
    obs = _numbers(f"{path}: obs", stored["obs"], (len(action), proprioceptive_size), longer=True)
    reward = _numbers(f"{path}: reward", stored["reward"], (len(action),))
    done = _flags(f"{path}: done", stored["done"], len(action))
    done[-1:] = True
    return Experience(obs, action, reward, done)


def _read_hdf5(path: Path, proprioceptive_size: int, action_size: int) -> list[Experience]:
    """Return the episodes of a Minari file in the order of their numbers, each with leading axis n."""
    try:
        import h5py
    except ImportError:
        raise ArtifactError(f"{path}: {MissingExtraError('h5py', 'data')}") from None
    with _reading(path), h5py.File(path, "r") as file:
        numbers = sorted(int(name[8:]) for name in map(str, file) if EPISODE.fullmatch(name))
        if not numbers:
            raise ArtifactError(f"{path}: expected groups episode_0, episode_1, ..., got none")
        return [
            _read_episode(f"{path}: episode_{number}", file[f"episode_{number}"], proprioceptive_size, action_size)
            for number in numbers
        ]


def _read_episode(where: str, group: Any, proprioceptive_size: int, action_size: int) -> Experience:
    if not hasattr(group, "keys"):
        raise ArtifactError(f"{where}: expected a group, got an array")
    for name in ("observations", "actions", "rewards", "terminations", "truncations"):
        _require(where, name, group.keys())
    obs, obs_name = group["observations"], "observations"
    if hasattr(obs, "keys"):
        _require(f"{where}/observations", "observation", obs.keys())
        obs, obs_name = obs["observation"], "observations/observation"
    action = _numbers(f"{where}/actions", group["actions"], (_length(group["actions"]), action_size))
    obs = _numbers(f"{where}/{obs_name}", obs, (len(action) + 1, proprioceptive_size), longer=True)
    reward = _numbers(f"{where}/rewards", group["rewards"], (len(action),))
    done, cut = [_flags(f"{where}/{name}", group[name], len(action)) for name in ("terminations", "truncations")]
    done |= cut
    done[-1:] = True
    return Experience(obs[:-1], action, reward, done)  # the state after the last tick starts no tick


def _length(source: Any) -> int:
    """Return the leading size of an array; 0 of anything else, which the checks refuse."""
    shape = getattr(source, "shape", None)
    return shape[0] if shape else 0


def _require(where: str | Path, name: str, names: Iterable[str]) -> None:
    names = list(names)
    if name not in names:
        nearest = difflib.get_close_matches(name, names, n=1, cutoff=0.0)
        hint = f"; the nearest name is {nearest[0]!r}" if nearest else ""
        raise ArtifactError(f"{where}: expected {name} in it, got nothing{hint}")


def _numbers(where: str, source: Any, shape: tuple[int, ...], longer: bool = False) -> np.ndarray:
    """Return an array of NumPy or HDF5 as finite float32 of this shape; its rows may be `longer`, and are cut."""
    sizes = ", ".join(map(str, shape)) + (" or more" if longer else "")
    got: tuple[int, ...] = getattr(source, "shape", None) or ()
    cut = longer and got[:-1] == shape[:-1] and got[-1:] > shape[-1:]
    if _kind(source) not in "fiub" or not (got == shape or cut):
        raise ArtifactError(f"{where}: expected numbers [{sizes}], got {_show(source)}")
    with np.errstate(over="ignore"):  # what is too large for float32 is counted below
        array = np.asarray(source[..., : shape[-1]]).astype(np.float32)
    wrong = np.count_nonzero(~np.isfinite(array))
    if wrong:
        raise ArtifactError(f"{where}: expected finite numbers, got {wrong} of {array.size} that are NaN or infinite")
    return array


def _flags(where: str, source: Any, num_ticks: int) -> np.ndarray:
    """Return an array of NumPy or HDF5 as bool [num_ticks]."""
    if _kind(source) != "b" or source.shape != (num_ticks,):
        raise ArtifactError(f"{where}: expected bool [{num_ticks}], got {_show(source)}")
    return np.array(source[...])


def _in_bounds(where: str, action: np.ndarray) -> np.ndarray:
    """Return actions clipped to [-1, 1], of which they may stand out by rounding only."""
    largest = action.flat[np.argmax(np.abs(action))]
    if abs(largest) > 1 + TOLERANCE:
        raise ArtifactError(f"{where}: expected actions in [-1, 1], got {largest:g}: scale them to [-1, 1]")
    return np.clip(action, -1, 1)


def _kind(source: Any) -> str:
    """Return the letter of an array's dtype, as NumPy has them, or a blank for a group."""
    return source.dtype.kind if hasattr(source, "dtype") else " "


def _show(source: Any) -> str:
    if not hasattr(source, "dtype"):
        return "a group" if hasattr(source, "keys") else "no array"
    return f"{source.dtype} [{', '.join(map(str, source.shape or ()))}]"


@contextlib.contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Turn whatever reading raises into one line."""
    try:
        yield
    except ArtifactError:
        raise
    except Exception as error:  # damaged bytes fail in as many ways as zip, zlib, NumPy and HDF5 have
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ArtifactError(f"{path}: damaged, or another kind of file ({reason})") from None
