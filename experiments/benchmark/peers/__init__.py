"""Other libraries' PPO at the work of ours, on Gymnasium's own models; each is imported when it is made.

A call of a peer trains for one iteration; `ticks` are those of a call.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import jax

from taic_jax.config import PPOConfig
from taic_jax.envs.adapters.admission import extra
from taic_jax.envs.errors import MissingExtraError
from taic_jax.envs.physics.mujoco import num_physical_cores
from taic_jax.experiments.benchmark.peers.brax_ppo import ticks_per_second
from taic_jax.experiments.benchmark.timing import seconds

# Our own ant has no observations of contact forces (78 entries, all but zero); theirs leaves them out too.
GYMNASIUM: dict[str, tuple[str, dict[str, Any]]] = {
    "half_cheetah": ("HalfCheetah-v5", {}),
    "hopper": ("Hopper-v5", {}),
    "walker2d": ("Walker2d-v5", {}),
    "ant": ("Ant-v5", {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0.0}),
}
ENVPOOL = {"half_cheetah": "HalfCheetah-v4", "ant": "Ant-v4"}
BRAX = {"half_cheetah": "halfcheetah", "ant": "ant"}
NO_TASK = "has no such task"


def fastest(make: Callable[[int], Any], counts: Iterable[int]) -> tuple[Any, str]:
    """Make a peer with each number of threads, close all but the one whose second iteration takes the least time, and
    return that and its setting."""
    made = {threads: make(threads) for threads in counts}
    for peer in made.values():
        peer()
    best = min(made, key=lambda threads: seconds(made[threads]))
    for threads in made.keys() - {best}:
        made[threads].close()
    return made[best], f"{best} threads"


def _make(name: str, task: str, config: PPOConfig, threads: int) -> Any:
    """Make a peer: of Stable-Baselines3 in one process, for with one per environment 64 do not fit in 24 GiB."""
    with extra("peers"):
        if name == "stable_baselines3":
            from taic_jax.experiments.benchmark.peers.stable_baselines import StableBaselines

            return StableBaselines(*GYMNASIUM[task], config, threads)
        from taic_jax.experiments.benchmark.peers.pytorch_ppo import EnvPoolPPO

        return EnvPoolPPO(ENVPOOL[task], config, num_physical_cores(), threads)


PEERS: Mapping[str, Mapping[str, Any]] = {"stable_baselines3": GYMNASIUM, "envpool_pytorch": ENVPOOL}


def loops(task: str, config: PPOConfig) -> tuple[dict[str, Any], dict[str, str]]:
    """Return the peers that run here, and a remark on each: its setting, or the reason why it does not run."""
    running, remarks, counts = {}, {}, sorted({1, num_physical_cores()})
    for name, tasks in PEERS.items():
        if task not in tasks:
            remarks[name] = NO_TASK
            continue
        try:
            running[name], remarks[name] = fastest(partial(_make, name, task, config), counts)
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
    except Exception as error:
        first = str(error).partition("\n")[0]
        return {}, {"brax": f"does not run on jax {jax.__version__}: {type(error).__name__}: {first}"}
    return rounds, dict.fromkeys(rounds, "takes no turns with the others")
