"""Episodes of a Gymnasium environment on the host, as pure functions of a seed and actions.

By Gymnasium's rules a seed and actions repeat an episode. So programs carry these, and the environments, whose inside
no array can hold, are a cache: each is at the tick whose name, a hash of seed and actions, stands beside it. If a
row has another name, as after a resume or where one state is stepped twice, its episode is repeated from the seed.
"""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from taic_jax.envs.errors import AdapterError
from taic_jax.envs.physics.mujoco import num_physical_cores

WORDS = 4  # in a seed and in a name, which begins as the seed: numbers below 2^16, which float32 holds exactly
Sent, Returned = Float[np.ndarray, "*batch n"], Float[np.ndarray, "*batch m"]


class _Batch(NamedTuple):
    """The environments of the rows of a call, and their names [N, W]."""

    envs: list[Any]
    names: np.ndarray


class Episodes:
    """Environments of one kind, stepped in any number of rows a call, by any number of callers.

    Raises:
      AdapterError: a seed and actions do not repeat an episode.
    """

    def __init__(self, name: str, make: Callable[[], Any]):
        self._name, self._make, self._lock = name, make, threading.Lock()
        self._idle: dict[int, list[_Batch]] = {}  # by their number of rows; the least recently used first
        self._num_threads = max(1, num_physical_cores() // jax.local_device_count())
        self._threads = ThreadPoolExecutor(self._num_threads)
        self.env, other = make(), make()
        self.action_size = self.env.action_space.low.size
        still = np.zeros((1, self.action_size), np.float32)
        self.obs, info = self.play(self.env, 0, still)
        self.play(other, 1, still)
        if not np.array_equal(self.obs, self.play(other, 0, still)[0], equal_nan=True):
            raise AdapterError(f"{name}: expected a seed and actions to repeat an episode, got another observation")
        self.metrics = sorted(key for key, value in info.items() if np.ndim(value) == 0 and np.isrealobj(value))

    def start(self, sent: Sent, after: Returned) -> None:
        """Reset: rows of 1, or 0 to do nothing, the seed, and the name of the episode before; to obs [S]."""
        wanted, seeds, before = np.split(sent.reshape(-1, 1 + 2 * WORDS), [1, 1 + WORDS], axis=1)

        def one(env: Any, _: bool, result: np.ndarray, wanted: np.ndarray, seed: np.ndarray) -> None:
            result[:] = flat(env.reset(seed=as_seed(seed))[0]) if wanted else 0.0

        self._each(one, before, wanted != 0, seeds, after, wanted, seeds)

    def step(self, sent: Sent, past: Float[np.ndarray, "*batch T A"], after: Returned) -> None:
        """Make a tick: rows of seed, name, obs [S], tick and action [A], beside all actions before; to name, obs,
        reward, terminated, truncated and metrics."""
        sent, size = sent.reshape(-1, sent.shape[-1]), WORDS + self.obs.size
        seeds, names, obs, ticks, actions = np.split(sent, np.cumsum([WORDS, WORDS, self.obs.size, 1]), axis=1)
        past, after = past.reshape(-1, *past.shape[-2:]), after.reshape(-1, after.shape[-1])
        after[:, :WORDS] = following(names, actions)

        def one(env: Any, ready: bool, result: np.ndarray, control: np.ndarray, *episode: np.ndarray) -> None:
            if not ready:
                self._repeat(env, *episode)
            obs, *outcome, info = env.step(control)
            result[WORDS:size] = flat(obs)
            result[size:] = *outcome, *[info.get(key, 0.0) for key in self.metrics]

        self._each(
            one,
            names,
            True,
            after[:, :WORDS],
            after,
            self._controls(actions),
            seeds,
            obs,
            ticks,
            past.reshape(-1, *past.shape[-2:]),
        )

    def _repeat(self, env: Any, seed: np.ndarray, obs: np.ndarray, tick: np.ndarray, past: np.ndarray) -> None:
        """Repeat the ticks of an episode, or raise `AdapterError` at another last observation."""
        count = int(tick[0])
        repeated, _ = self.play(env, as_seed(seed), past[:count])
        if not np.array_equal(repeated, obs, equal_nan=True):
            problem = f"tick {count} of an episode, repeated, has another observation"
            raise AdapterError(f"{self._name}: {problem}: a run in it cannot be resumed")

    def play(self, env: Any, seed: int | None, actions: Float[np.ndarray, "t A"]) -> tuple[np.ndarray, dict[str, Any]]:
        """Step an environment, reset first if there is a seed; return the last observation [S] and info."""
        obs, info = (None, {}) if seed is None else env.reset(seed=seed)
        for control in self._controls(actions):
            obs, *_, info = env.step(control)
        return flat(obs).astype(np.float32), info

    def _controls(self, actions: Float[np.ndarray, "t A"]) -> np.ndarray:
        """Scale actions in [-1, 1]^A to the limits and the shape of Gymnasium's."""
        space, actions = self.env.action_space, actions.reshape(-1, *self.env.action_space.shape)
        middle, half = (space.high + space.low) / 2, (space.high - space.low) / 2
        return np.clip(middle + half * actions, space.low, space.high).astype(space.dtype)

    def _each(
        self, one: Callable[..., None], names: np.ndarray, moved: Any, then: np.ndarray, after: np.ndarray, *rows: Any
    ) -> None:  # fmt: skip
        """Call a function on every row with its environment and whether that has the row's name; those moved have the
        next ones then.

        The environments are those that have most of the names. If none has any, a program begins: it gets new ones,
        unless twice as many batches as devices wait, of which it takes the oldest.
        """
        with self._lock:
            idle = self._idle.setdefault(len(names), [])
            ready = [np.all(batch.names == names, axis=1) for batch in idle]
            best = max(range(len(idle)), key=lambda i: ready[i].sum(), default=0)
            known = idle and (ready[best].any() or len(idle) >= 2 * jax.local_device_count())
            batch = idle.pop(best) if known else _Batch([self._make() for _ in names], np.full_like(names, -1))
        columns = (
            batch.envs,
            ready[best].tolist() if known else [False] * len(names),
            after.reshape(len(names), -1),
            *rows,
        )

        def some(first: int) -> None:
            for row in zip(*(column[first :: self._num_threads] for column in columns), strict=True):
                one(*row)

        list(self._threads.map(some, range(self._num_threads)))
        idle.append(_Batch(batch.envs, np.where(moved, then, batch.names)))


def following(names: Float[np.ndarray, "N W"], actions: Float[np.ndarray, "N A"]) -> np.ndarray:
    """Return the names after one more action, by a hash like FNV-1a, of words in place of bytes."""
    state = names.astype(np.uint16).view(np.uint64)[:, 0]
    for column in np.ascontiguousarray(actions).view(np.uint32).T:
        state = (state ^ column) * np.uint64(0x100000001B3)
        state ^= state >> np.uint64(32)
    return state[:, None].view(np.uint16)


def flat(obs: Any) -> np.ndarray:
    """Return an observation as one vector [S]; of one in parts `observation` first, then the others by name."""
    if not isinstance(obs, dict):
        return np.ravel(obs)
    return np.concatenate([flat(obs[name]) for name in sorted(obs, key=lambda name: (name != "observation", name))])


def as_seed(words: Float[np.ndarray, " W"]) -> int:
    """Return Gymnasium's seed."""
    return int.from_bytes(words.astype(np.uint16).tobytes(), "little")
