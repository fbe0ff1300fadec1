"""Arrays of other people's files, checked: numbers, ends of episodes, and errors in one line that name the place."""

import contextlib
import difflib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taic_jax.envs.errors import MissingExtraError
from taic_jax.options.dataset import Experience
from taic_jax.runtime.checkpoint import ArtifactError


class Place(NamedTuple):
    """A place in a file, for messages: its path, and the names of the groups and the array inside."""

    path: Path
    inside: str = ""

    def __truediv__(self, name: str) -> "Place":
        return Place(self.path, f"{self.inside}/{name}".lstrip("/"))

    def __str__(self) -> str:
        return f"{self.path}: {self.inside}" if self.inside else str(self.path)

    def refuse(self, message: str) -> ArtifactError:
        """Return the error with this place in front."""
        return ArtifactError(f"{self}: {message}")


class Layout(NamedTuple):
    """A format, and the names of its arrays; a name may lead through groups, as in `obs/object`.

    Rewards may be missing if `optional`. Of several `ends` those that are there count, at least one. `num_last` is the
    number of observations after an episode's last action.
    """

    name: str
    observations: tuple[str, ...]
    actions: str
    rewards: str
    ends: tuple[str, ...] = ()
    optional: bool = False
    num_last: int = 0


def read_arrays(place: Place, group: Any, layout: Layout) -> Experience:
    """Read consecutive steps as experience [T, ...] in float32 and bool; the last one ends an episode in any case.

    Several observations are joined in the order of their names. Raise ArtifactError for a missing array, another type
    or shape, or a number that is not finite.
    """
    action = _entry(place, group, layout.actions)
    shape = getattr(action, "shape", None) or ()
    if _kind(action) in "iub" or len(shape) != 2:
        why = ": discrete actions, where continuous ones are wanted" if _kind(action) in "iub" else ""
        raise (place / layout.actions).refuse(f"expected continuous actions [steps, entries], got {_show(action)}{why}")
    count = shape[0]
    obs = [
        _numbers(place / name, _entry(place, group, name), (count + layout.num_last, None))[:count]
        for name in layout.observations
    ]
    rewards = np.zeros(count, np.float32)
    if not layout.optional or layout.rewards in group:
        rewards = _numbers(place / layout.rewards, _entry(place, group, layout.rewards), (count,))
    ends = [name for name in layout.ends if name in group] or layout.ends[:1]
    done = np.zeros(count, bool)
    for name in ends if layout.optional else layout.ends:
        done |= _flags(place / name, _entry(place, group, name), count)
    done[-1:] = True
    actions = _numbers(place / layout.actions, action, (count, None))
    return Experience(obs[0] if len(obs) == 1 else np.concatenate(obs, axis=1), actions, rewards, done)


def read_episodes(groups: Iterable[tuple[Place, Any]], layout: Layout) -> Experience:
    """Read episodes, each a group of arrays, one after another; raise ArtifactError where their sizes differ."""
    episodes: list[Experience] = []
    for place, group in groups:
        if not hasattr(group, "keys"):
            raise place.refuse("expected a group, got an array")
        episodes.append(read_arrays(place, group, layout))
        sizes = [(e.obs.shape[1], e.action.shape[1]) for e in (episodes[0], episodes[-1])]
        if sizes[0] != sizes[1]:
            expected, got = ("{} observations and {} actions".format(*size) for size in sizes)
            raise place.refuse(f"expected {expected}, as the first episode has; got {got}")
    names = list(vars(episodes[0])) if episodes else []
    return Experience(*(np.concatenate([vars(episode)[name] for episode in episodes]) for name in names))


def _entry(place: Place, group: Any, name: str) -> Any:
    """Return the array of this name, or raise ArtifactError with the nearest name that is there."""
    if name in group:
        return group[name]
    first, _, rest = name.partition("/")
    if rest and first in group and hasattr(group[first], "keys"):
        return _entry(place / first, group[first], rest)
    raise place.refuse(f"expected {name} in it, got nothing{nearest_name(name, group)}")


def nearest_name(name: str, names: Iterable[str]) -> str:
    """Return the end of a message with the name that is most like `name`, empty without any."""
    match = difflib.get_close_matches(name, list(names), n=1, cutoff=0.0)
    return f"; the nearest name is {match[0]!r}" if match else ""


def _numbers(place: Place, source: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return an array of NumPy or HDF5 as finite float32 of this shape, None standing for any number."""
    actual: tuple[int, ...] = getattr(source, "shape", None) or ()
    fits = len(actual) == len(shape) and all(n in (None, m) for n, m in zip(shape, actual, strict=True))
    if _kind(source) not in "fiub" or not fits or 0 in actual[1:]:
        sizes = ", ".join("entries" if n is None else str(n) for n in shape)
        raise place.refuse(f"expected numbers [{sizes}], got {_show(source)}")
    with np.errstate(over="ignore"):  # numbers too large for float32 are counted below
        array = np.asarray(source[...], np.float32)
    if wrong := array.size - np.count_nonzero(np.isfinite(array)):
        raise place.refuse(f"expected finite numbers, got {wrong} of {array.size} that are NaN or infinite")
    return array


def _flags(place: Place, source: Any, count: int) -> np.ndarray:
    """Return the ends of episodes [N] as bool, which some formats write as numbers."""
    if _kind(source) in "fiub" and source.shape == (count,):
        flags = np.asarray(source[...])
        if np.isin(flags, (0, 1)).all():
            return flags.astype(bool)
    raise place.refuse(f"expected bool [{count}], or 0 and 1, got {_show(source)}")


def _kind(source: Any) -> str:
    """Return the letter of an array's dtype in NumPy, or a blank for a group."""
    return source.dtype.kind if hasattr(source, "dtype") else " "


def _show(source: Any) -> str:
    if not hasattr(source, "dtype"):
        return "a group" if hasattr(source, "keys") else "no array"
    return f"{source.dtype} [{', '.join(map(str, source.shape or ()))}]"


@contextlib.contextmanager
def reading(path: Path, package: str = "") -> Iterator[None]:
    """Turn any error of reading into one line; `package` is the one that reads, which the extra `data` installs."""
    try:
        yield
    except ArtifactError:
        raise
    except ImportError as error:
        raise ArtifactError(f"{path}: {MissingExtraError(error.name or package, 'data')}") from None
    except Exception as error:  # damaged bytes fail in as many ways as zip, zlib, NumPy, HDF5 and Arrow have
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ArtifactError(f"{path}: damaged, or another kind of file ({reason})") from None
