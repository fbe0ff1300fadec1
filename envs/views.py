"""Views of a symmetric body: the same motion from another of its sides."""

import jax.numpy as jnp
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import Float, Int


class Views(struct.PyTreeNode):
    """V views, each a signed permutation of the proprioceptive slice [P] and of the action [A].

    The first changes nothing. A motion possible in one view is possible in all: a simulation commutes with them.
    """

    obs_order: Array  # [V, P]
    obs_sign: Array
    action_order: Array  # [V, A]
    action_sign: Array

    def __len__(self) -> int:
        """V, the number of views."""
        return self.obs_order.shape[-2]

    def directions(self, direction: Float[Array, " 2"]) -> Float[Array, "V 2"]:
        """Return a horizontal direction as each view sees it: equal sides lie around the vertical."""
        x, y = direction
        angle = 2 * np.pi / len(self) * np.arange(len(self))
        c, s = np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)
        return jnp.stack([c * x - s * y, s * x + c * y], axis=-1)

    def back(self, view: Int[Array, ""]) -> Int[Array, ""]:
        """Return the view that undoes a view: all are turns by the same angle."""
        return jnp.where(view == 0, 0, len(self) - view)

    def obs(self, view: Int[Array, ""], obs: Float[Array, "*batch P"]) -> Float[Array, "*batch P"]:
        """Return proprioceptive slices in a view."""
        return obs[..., self.obs_order[view]] * jnp.broadcast_to(self.obs_sign[view], obs.shape)

    def all(self, obs: Float[Array, " P"]) -> Float[Array, "V P"]:
        """Return a proprioceptive slice in every view."""
        return obs[self.obs_order] * self.obs_sign

    def action(self, view: Int[Array, ""], action: Float[Array, "*batch A"]) -> Float[Array, "*batch A"]:
        """Return actions in a view."""
        return action[..., self.action_order[view]] * jnp.broadcast_to(self.action_sign[view], action.shape)


Signed = tuple[tuple[int, int], ...]  # For each entry the index of the one that takes its place, and its sign.


def one_view(obs_size: int, action_size: int, count: int = 1) -> Views:
    """Return the view of a body that looks different from every side, `count` times."""
    obs, action = (tuple((i, 1) for i in range(size)) for size in (obs_size, action_size))
    return make_views(obs, action, count)


def make_views(obs: Signed, action: Signed, count: int) -> Views:
    """Return `count` views, each one turn after the previous."""
    arrays = []
    for turn in (obs, action):
        order, sign = (np.array(column) for column in zip(*turn, strict=True))
        orders, signs = [np.arange(len(order))], [np.ones(len(order))]
        for _ in range(count - 1):
            orders.append(orders[-1][order])
            signs.append(sign * signs[-1][order])
        arrays += [jnp.array(np.stack(orders), jnp.int32), jnp.array(np.stack(signs), jnp.float32)]
    return Views(*arrays)
