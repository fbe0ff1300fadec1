"""Population-based training (Jaderberg et al., 2017) over the rows of one program.

Every so many steps the worst quarter of the points copies the weights of points of the best quarter, and their numbers
perturbed. Each seed has a population of its own, so that seeds stay independent repeats.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from operator import attrgetter, itemgetter
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Key

from taic_jax.config import Config, replace
from taic_jax.nonfinite import FINITE

SHARE = 4  # one in so many points is replaced, and one in so many is copied
FACTORS = (0.8, 1.25)
PREFIX, PARENT = "pbt", "pbt/parent"


class Members(struct.PyTreeNode):
    """The rows [G K]: their states, the configs they train with, their own keys, and the numbers of steps."""

    state: Any
    config: Config
    key: Array
    count: Array


@dataclass(frozen=True)
class Population:
    """The evolution of points: steps between copies, and `bounds` of each perturbed number by its dotted name."""

    every: int
    bounds: dict[str, tuple[float, float]]
    seeds: int

    def begin(self, state: Any, config: Config, key: Key[Array, " R"]) -> Members:
        """Return the rows before the first step, with keys apart from those of the stage."""
        return Members(state, config, jax.vmap(lambda k: jax.random.fold_in(k, 1))(key), jnp.zeros(len(key), jnp.int32))

    def evolving(self, step: Callable[..., tuple[Any, dict, Any]]) -> Callable[..., tuple[Members, dict, Any]]:
        """Return a step (members, rows) from one (states, rows) whose metrics hold `return`.

        The members' own configs replace those of the rows. Metrics hold the numbers of this step (`pbt/NAME`), and the
        row whose weights each row goes on with (`pbt/parent`).
        """

        def call(members: Members, rows: Any) -> tuple[Members, dict, Any]:
            state, metrics, extra = step(members.state, (members.config, *rows[1:]))
            count = members.count + 1
            key, key_donor, key_factor = jax.vmap(partial(jax.random.split, num=3), out_axes=1)(members.key)
            score = jnp.where(metrics["nonfinite"] == FINITE, metrics["return"], jnp.nan)
            parent = _parents(score.reshape(-1, self.seeds), key_donor)
            parent = jnp.where(count % self.every == 0, parent, jnp.arange(len(parent)))
            numbers = {f"{PREFIX}/{name}": attrgetter(name)(members.config) for name in self.bounds}
            # Each row keeps its own keys: children would draw the same numbers.
            state = jax.tree.map(lambda x: x if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x[parent], state)
            after = Members(state, self._explore(members.config, parent, key_factor), key, count)
            return after, metrics | numbers | {PARENT: parent.astype(jnp.float32)}, extra

        return call

    def _explore(self, config: Config, parent: Int[Array, " R"], key: Key[Array, " R"]) -> Config:
        """Return the parents' numbers, multiplied by one of the factors in rows with another row as parent."""
        moved = parent != jnp.arange(len(parent))
        up = jax.vmap(lambda k: jax.random.bernoulli(k, shape=(len(self.bounds),)))(key)
        for i, (name, (low, high)) in enumerate(self.bounds.items()):
            value = attrgetter(name)(config)[parent]
            perturbed = jnp.clip(value * jnp.where(up[:, i], FACTORS[1], FACTORS[0]), low, high)
            config = replace(config, name, jnp.where(moved, perturbed, value))
        return config


def _parents(score: Float[Array, "G K"], key: Key[Array, " R"]) -> Int[Array, " R"]:
    """Return for each row the row whose weights it goes on with: itself, or a better one of the same seed."""
    points, seeds = score.shape
    few = max(points // SHARE, 1)
    score = jnp.where(jnp.isnan(score), -jnp.inf, score)
    order = jnp.argsort(-score, axis=0)
    rank = jnp.argsort(order, axis=0)
    seed = jnp.broadcast_to(jnp.arange(seeds), score.shape)
    donor = order[jax.vmap(lambda k: jax.random.randint(k, (), 0, few))(key).reshape(score.shape), seed]
    worse: Bool[Array, "G K"] = (rank >= points - few) & (score < score[donor, seed])
    point = jnp.broadcast_to(jnp.arange(points)[:, None], score.shape)
    return (jnp.where(worse, donor, point) * seeds + seed).reshape(-1)


def schedule(rows: list[dict[str, Any]], names: list[str], row: int) -> list[tuple[int, dict[str, float]]]:
    """Return the history (first tick, values by dotted name) of the numbers behind the weights of one last `row`."""
    steps: list[tuple[int, dict[str, float]]] = []
    for i in reversed(range(len(rows))):
        row = int(rows[i][f"train/{PARENT}"][row])
        since = rows[i - 1]["ticks"] if i else 0
        steps.append((since, {name: rows[i][f"train/{PREFIX}/{name}"][row] for name in names}))
    return [next(same) for _, same in groupby(reversed(steps), key=itemgetter(1))]
