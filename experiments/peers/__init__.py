"""Other libraries' PPO at the work of ours, on Gymnasium's own models; each is imported when it is made.

A peer is a callable that trains for one iteration, and counts its `ticks` and `gradient_steps`.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, Protocol

from taic_jax.config import PPOConfig
from taic_jax.envs.adapters.admission import extra
from taic_jax.envs.physics.mujoco import num_physical_cores
from taic_jax.experiments.turns import seconds

# Where our own ant leaves something out, theirs does too: observations of contact forces (78 entries, all but zero).
GYMNASIUM: dict[str, tuple[str, dict[str, Any]]] = {
    "half_cheetah": ("HalfCheetah-v5", {}),
    "ant": ("Ant-v5", {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0.0}),
}
ENVPOOL = {"half_cheetah": "HalfCheetah-v4", "ant": "Ant-v4"}
BRAX = {"half_cheetah": "halfcheetah", "ant": "ant"}


class Peer(Protocol):
    """What trains for an iteration when it is called."""

    ticks: int

    @property
    def gradient_steps(self) -> int:
        """How many gradient steps it has taken so far."""
        ...

    def __call__(self) -> None: ...

    def close(self) -> None:
        """Let go of its environments."""
        ...


class Tuned(NamedTuple):
    """The fastest of a peer's settings, and which it is."""

    peer: Any
    setting: str


def fastest(candidates: Iterable[tuple[str, Callable[[], Any]]]) -> Tuned:
    """Make each candidate in turn, warm it up, measure an iteration, and keep the fastest; the others are closed."""
    best, least = None, float("inf")
    for setting, make in candidates:
        peer = make()
        peer()
        taken = seconds(peer)
        if taken < least:
            best, peer, least = Tuned(peer, setting), best and best.peer, taken
        if peer is not None:
            peer.close()
    assert best, "there is at least one candidate"
    return best


def make_stable_baselines(task: str, config: PPOConfig) -> Tuned:
    """Return Stable-Baselines3's PPO, with one thread of PyTorch's or as many as cores.

    In one process: its other way is a process per environment, and 64 of them do not fit in 24 GiB.

    Raises:
      MissingExtraError: it is not installed.
    """
    with extra("peers"):
        from taic_jax.experiments.peers.stable_baselines import StableBaselines

    return fastest(
        (f"{threads} threads", lambda t=threads: StableBaselines(*GYMNASIUM[task], config, t))
        for threads in thread_counts()
    )


def make_envpool(task: str, config: PPOConfig) -> Tuned:
    """Return a PPO in PyTorch on EnvPool, with one thread of PyTorch's or as many as cores.

    Raises:
      MissingExtraError: it is not installed.
    """
    with extra("peers"):
        from taic_jax.experiments.peers.pytorch_ppo import EnvPoolPPO

    cores = num_physical_cores()
    return fastest(
        (f"{threads} threads", lambda t=threads: EnvPoolPPO(ENVPOOL[task], config, cores, t))
        for threads in thread_counts()
    )


def thread_counts() -> list[int]:
    """List the numbers of threads that a peer may choose from: one, and those that we use."""
    return sorted({1, num_physical_cores()})
