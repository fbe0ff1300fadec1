"""Other libraries' PPO at the work of ours, on Gymnasium's own models; each is imported when it is made.

A peer is a callable that trains for one iteration, and counts its `ticks` and `gradient_steps`.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from taic_jax.config import PPOConfig
from taic_jax.envs.adapters.admission import extra
from taic_jax.envs.errors import MissingExtraError
from taic_jax.envs.physics.mujoco import num_physical_cores
from taic_jax.experiments.benchmark.peers.brax_ppo import DoesNotRunError, ticks_per_second
from taic_jax.experiments.benchmark.timing import seconds

# Where our own ant leaves something out, theirs does too: observations of contact forces (78 entries, all but zero).
GYMNASIUM: dict[str, tuple[str, dict[str, Any]]] = {
    "half_cheetah": ("HalfCheetah-v5", {}),
    "ant": ("Ant-v5", {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0.0}),
}
ENVPOOL = {"half_cheetah": "HalfCheetah-v4", "ant": "Ant-v4"}
BRAX = {"half_cheetah": "halfcheetah", "ant": "ant"}
NO_TASK = "has no such task"


class Tuned(NamedTuple):
    """The fastest of a peer's settings, and which it is."""

    peer: Any
    setting: str


def fastest(make: Callable[[int], Any], counts: Iterable[int]) -> Tuned:
    """Make a peer with each number of threads, warm it up, measure an iteration, and close all but the fastest."""
    best, least = None, float("inf")
    for threads in counts:
        peer = make(threads)
        peer()
        taken = seconds(peer)
        if taken < least:
            best, peer, least = Tuned(peer, f"{threads} threads"), best and best.peer, taken
        if peer is not None:
            peer.close()
    assert best, "there is at least one candidate"
    return best


def _stable_baselines(task: str, config: PPOConfig, threads: int) -> Any:
    """Make Stable-Baselines3's PPO, in one process: with one per environment, 64 do not fit in 24 GiB."""
    with extra("peers"):
        from taic_jax.experiments.benchmark.peers.stable_baselines import StableBaselines
    return StableBaselines(*GYMNASIUM[task], config, threads)


def _envpool(task: str, config: PPOConfig, threads: int) -> Any:
    """Make a PPO in PyTorch on EnvPool, which itself has a thread a core."""
    with extra("peers"):
        from taic_jax.experiments.benchmark.peers.pytorch_ppo import EnvPoolPPO
    return EnvPoolPPO(ENVPOOL[task], config, num_physical_cores(), threads)


PEERS: Mapping[str, tuple[Mapping[str, Any], Callable[[str, PPOConfig, int], Any]]] = {
    "stable_baselines3": (GYMNASIUM, _stable_baselines),
    "envpool_pytorch": (ENVPOOL, _envpool),
}


def loops(task: str, config: PPOConfig) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the peers that run here, and a remark on each: its setting, or why it does not run."""
    running, remarks, counts = {}, {}, sorted({1, num_physical_cores()})
    for name, (tasks, make) in PEERS.items():
        if task not in tasks:
            remarks[name] = NO_TASK
            continue
        try:
            running[name], remarks[name] = fastest(partial(make, task, config), counts)
        except MissingExtraError as error:
            remarks[name] = str(error)
    return running, remarks


def brax_rounds(
    task: str, config: PPOConfig, pipelines: Sequence[str]
) -> tuple[dict[str, list[float]], dict[str, str]]:
    """Return the ticks per second of Brax's PPO on each pipeline, if it runs, and the remarks on them."""
    if task not in BRAX:
        return {}, {"brax": NO_TASK}
    try:
        rounds = {f"brax/{pipeline}": ticks_per_second(BRAX[task], pipeline, config) for pipeline in pipelines}
    except DoesNotRunError as error:
        return {}, {"brax": str(error)}
    return rounds, dict.fromkeys(rounds, "takes no turns with the others")
