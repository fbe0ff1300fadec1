"""The frame in which options see the body, and the way it goes: parts of the state change that a code tells (eq. 4-8).

In the world's axes the same motion looks different from every heading. In the frame of the heading it does not, so that
a code's effect depends on the start alone through the body (eq. 5).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from taic_jax.config import OptionsConfig
from taic_jax.envs.base import Heading


class Frame(NamedTuple):
    """What networks see of a body with a heading.

    With `turns` states are seen from a heading; without, in the world's axes. The way counts as `weight` entries of the
    state; 0 leaves it out.
    """

    heading: Heading
    turns: bool
    weight: int

    @property
    def way_size(self) -> int:
        """Entries of the way: 2, or none."""
        return 2 if self.weight else 0

    def seen(self, states: Float[Array, "*batch P"], first: Float[Array, "*#batch P"]) -> Float[Array, "*batch P"]:
        """Return states as seen from the heading of `first`."""
        if not self.turns:
            return states
        at, v = self.heading.quaternion, self.heading.velocity
        c, s = _half_yaw(first[..., at], first[..., at + 3])
        w, x, y, z = (states[..., at + i] for i in range(4))
        turned = c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w
        sign = jnp.where(turned[0] < 0.0, -1.0, 1.0)  # a quaternion and its negative are the same rotation
        velocity = self.turned(states[..., v : v + 2], first)
        entries = {at + i: sign * q for i, q in enumerate(turned)} | {v: velocity[..., 0], v + 1: velocity[..., 1]}
        return jnp.stack([entries.get(i, states[..., i]) for i in range(states.shape[-1])], axis=-1)

    def way(self, states: Float[Array, "*batch P"], first: Float[Array, "*#batch P"]) -> Float[Array, "*batch 2"]:
        """Return the way in m that the body goes in the tick after each state, seen from the first."""
        v = self.heading.velocity
        return self.heading.dt * self.turned(states[..., v : v + 2], first)

    def change(
        self, states: Float[Array, "*batch P"], first: Float[Array, "*#batch P"], way: Float[Array, "*batch 2"]
    ) -> Float[Array, "*batch C"]:
        """Return the changes from the first state to these, and the way between, all seen from the first."""
        change = self.seen(states, first) - self.seen(first, first)
        return jnp.concatenate([change, way], axis=-1) if self.weight else change

    def changes(self, states: Float[Array, "T P"]) -> Float[Array, "T-1 C"]:
        """Return the change from the first state to each later one."""
        first = states[:1]
        return self.change(states[1:], first, jnp.cumsum(self.way(states[:-1], first), axis=0))

    def turned(self, vector: Float[Array, "*batch 2"], first: Float[Array, "*#batch P"]) -> Float[Array, "*batch 2"]:
        """Return horizontal vectors of the world as seen from the heading of `first`."""
        if not self.turns:
            return vector
        at = self.heading.quaternion
        half_c, half_s = _half_yaw(first[..., at], first[..., at + 3])
        c, s = jnp.square(half_c) - jnp.square(half_s), 2 * half_c * half_s
        x, y = vector[..., 0], vector[..., 1]
        return jnp.stack([c * x + s * y, c * y - s * x], axis=-1)


def _half_yaw(w: Array, z: Array) -> tuple[Array, Array]:
    """Return cosine and sine of half the yaw: of the rotation about the vertical that is left without the tilt."""
    norm = jnp.sqrt(jnp.square(w) + jnp.square(z) + 1e-12)  # it is zero for a body exactly on its back
    return w / norm, z / norm


def make_frame(config: OptionsConfig, heading: Heading | None) -> Frame | None:
    """Return the config's frame for a body with this heading; None for the world's axes without the way.

    Raises:
      ValueError: the config needs a heading, and the body has none.
    """
    turns = config.frame == "heading"
    if not turns and not config.way_weight:
        return None
    if heading is None:
        raise ValueError("options.frame: heading and options.way_weight need a body with a heading, as ant; got none")
    return Frame(heading, turns, config.way_weight)
