"""The contracts of a task, `Env`, and of the physics behind it, `Physics`: pure unbatched functions on arrays."""

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jax import Array
from jaxtyping import Float, Key

from taic_jax.envs.errors import ModelError
from taic_jax.envs.views import Views, one_view


class PhysicsState(struct.PyTreeNode):
    """The whole memory of a MuJoCo simulation between two ticks, and what its sensors read."""

    qpos: Array  # [nq] generalised positions
    qvel: Array  # [nv] generalised velocities
    qacc_warmstart: Array  # [nv] accelerations from which the constraint solver starts
    # None unless the model has activations, and unless the physics was made with sensors.
    act: Array | None = struct.field(default=None, kw_only=True)  # [na] activations of actuators
    sensordata: Array | None = struct.field(default=None, kw_only=True)  # [nsensordata] before the latest substep


class Physics(abc.ABC):
    """A model's dynamics on one backend; a tick has `substeps` engine steps.

    Equalities are as in the model, active or not. With `sensors` the state has what they read.

    Raises:
      ModelError: the model has state that `PhysicsState` cannot carry.
    """

    def __init__(self, model: mujoco.MjModel, substeps: int, sensors: bool = False):
        without_field = {
            "mocap bodies": model.nmocap, "plugins": model.nplugin, "delays": model.nhistory,
            "plastic deformation": model.nplastic, "sleep": model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP,
        }  # fmt: skip
        for content, present in without_field.items():
            if present:
                raise ModelError(model_name(model), f"got {content}, which the state of the physics cannot carry")
        self.model, self.substeps, self.sensors = model, substeps, sensors

    def init(self, qpos: Float[Array, " nq"], qvel: Float[Array, " nv"]) -> PhysicsState:
        """Make the state from which an episode starts; needs no forward pass: sensors read 0."""
        act = jnp.zeros(self.model.na) if self.model.na else None
        sensordata = jnp.zeros(self.model.nsensordata) if self.sensors else None
        return PhysicsState(qpos, qvel, jnp.zeros_like(qvel), act=act, sensordata=sensordata)

    @abc.abstractmethod
    def step(self, state: PhysicsState, ctrl: Float[Array, " nu"]) -> PhysicsState:
        """Advance by one tick, i.e. all its substeps, under constant controls."""


def model_name(model: mujoco.MjModel) -> str:
    """Return the name that the MJCF gives its model."""
    return model.names.partition(b"\0")[0].decode()


class State(struct.PyTreeNode):
    """A task at one tick; `reset` and `step` return the same structure, shapes and dtypes."""

    physics: Any  # the task's own small pytree, e.g. `PhysicsState`
    obs: Array  # [S] float32
    reward: Array  # [] float32, earned by the tick just made
    terminated: Array  # [] bool, the task ended
    truncated: Array  # [] bool, the time limit cut it
    metrics: dict[str, Array]  # [] float32 each: reward terms, distance to goal, success
    # None without the wrapper named.
    tick: Array = struct.field(default=None)  # [] int32, ticks since reset (`TimeLimit`)
    key: Array = struct.field(default=None)  # typed PRNG key of the resets to come (`AutoReset`)
    final_obs: Array = struct.field(default=None)  # [S] before a reset; equals obs if none happened (`AutoReset`)

    @classmethod
    def first(cls, physics: Any, obs: Float[Array, " S"], metrics: dict[str, Array]) -> "State":
        """Return an episode's first state, without reward and end."""
        no = jnp.zeros((), bool)
        return cls(physics, obs, jnp.zeros(()), terminated=no, truncated=no, metrics=metrics)


class Goals(NamedTuple):
    """A task's goals [Q], from observations alone: an optional part of the contract, for hindsight."""

    size: int  # Q
    achieved: Callable[[Array], Array]  # obs [S] -> the goal that it achieves [Q]
    aim: Callable[[Array, Array], Array]  # (obs [S], goal [Q]) -> the observation [S] with this goal
    reward: Callable[[Array, Array], tuple[Array, Array]]  # (achieved [Q], goal [Q]) -> (reward, terminated) of a tick


class Heading(NamedTuple):
    """Indices in the proprioceptive slice of a body that can face anywhere, and the seconds of a tick."""

    quaternion: int  # w, x, y, z of the root
    velocity: int  # m/s along the world's x, then y
    dt: float


class Env(abc.ABC):
    """A task: unbatched and pure, so the caller applies `jax.vmap` and `jax.jit`.

    With `discrete`, A is the number of actions, and an action is one-hot: 1 at the one chosen, 0 elsewhere.
    """

    name: str
    observation_size: int
    action_size: int
    proprioceptive_size: int  # the leading entries of obs that describe the body alone
    proprioception: str  # name of that slice; without it no other task shares the slice
    episode_length: int  # ticks
    dt: float  # seconds a tick
    discrete: bool = False  # whether an action is one of A, instead of a vector in [-1, 1]^A
    staggered: bool = False  # whether training begins at ticks apart, since the time limit alone ends episodes

    @property
    def views(self) -> Views:
        """Views of the body's motion: one, unless the body is symmetric."""
        return one_view(self.proprioceptive_size, self.action_size)

    @property
    def heading(self) -> Heading | None:
        """Heading of the body, None if it has none."""
        return None

    @property
    def evaluated(self) -> "Env":
        """The task in evaluation: this one, without the draws of training alone."""
        return self

    @property
    def goals(self) -> Goals | None:
        """How a tick's reward follows from a goal, if the task has goals and its observations tell them."""
        return None

    @abc.abstractmethod
    def reset(self, key: Key[Array, ""]) -> State:
        """Draw the first state of an episode; consumes the key."""

    def restart(self, key: Key[Array, ""], ended: Any) -> State:
        """Draw the first state of the episode after one that ended in physics `ended`; by default any first state.

        A task that changes from episode to episode overrides this. Where no episode ended, all bits of the key
        are ones, and the start is discarded.
        """
        return self.reset(key)

    @abc.abstractmethod
    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Advance by one tick under an action in [-1, 1]^A, which the caller has clipped; a discrete task takes its
        argmax."""

    @abc.abstractmethod
    def render(self, physics: Any, *, height: int = 240, width: int = 320) -> np.ndarray:
        """Draw a trajectory of `State.physics` with leading axis T as frames [T, height, width, 3] uint8."""
