"""Train one library on a robot of Gymnasium, and print each evaluation: a process of `experiments.benchmark.result`.

python -m taic_jax.experiments.benchmark.climbs taic_jax half_cheetah 0

A line has the ticks so far, the return of mean actions, and the seconds of all evaluations so far.
"""

import sys
import time
from collections.abc import Iterator
from functools import partial

TICKS, EVERY, EPISODES = 1_000_000, 40_960, 5  # a budget, the ticks between two evaluations, episodes of each
Climb = Iterator[tuple[int, float, float]]


def ours(task: str, seed: int) -> Climb:
    """Train flat PPO of the task's preset, on all cores; yield ticks, return, and seconds of evaluation."""
    import jax

    from taic_jax import envs
    from taic_jax.analysis.evaluate import evaluate
    from taic_jax.config.files import load_config
    from taic_jax.options.execution import IdentityExecutor
    from taic_jax.rl import ppo
    from taic_jax.rl.learner import num_iterations
    from taic_jax.runtime.devices import Devices
    from taic_jax.runtime.program_cache import keep_programs
    from taic_jax.types import as_arrays

    keep_programs()
    env, config = envs.make_env(task, model="gym"), load_config(task).collect.ppo
    executor, settings = IdentityExecutor(env.action_size), as_arrays(config)
    key_train, key_test = jax.random.split(jax.random.key(seed))
    state, iterations = jax.jit(partial(ppo.init, settings, env, executor))(key_train), num_iterations(config, TICKS)
    devices = Devices()
    iterate = partial(ppo.iterate, settings, env, executor, iterations)
    step = devices.compile(lambda state: iterate(state)[:2], state, donate=True)

    def score(state: ppo.TrainState) -> jax.Array:
        return evaluate(env, ppo.as_agent(settings, executor, state), key_test, EPISODES, 0.0)["return"]

    judge = devices.compile(score, state)
    ticks, spent = config.num_envs * config.rollout_length, 0.0
    for iteration in range(1, iterations + 1):
        state, _ = jax.block_until_ready(step(state))
        if iteration * ticks // EVERY > (iteration - 1) * ticks // EVERY:
            begun = time.perf_counter()
            returned = float(judge(state))
            spent += time.perf_counter() - begun
            yield iteration * ticks, returned, spent


def stable_baselines3(task: str, seed: int) -> Climb:
    """Train PPO of Stable-Baselines3 with the settings of its zoo; yield ticks, return, and seconds of evaluation."""
    from taic_jax.experiments.benchmark.peers import GYMNASIUM
    from taic_jax.experiments.benchmark.peers.stable_baselines import climb

    return climb(task, *GYMNASIUM[task], seed, ticks=TICKS, every=EVERY, episodes=EPISODES)


LIBRARIES = {"taic_jax": ours, "stable_baselines3": stable_baselines3}


if __name__ == "__main__":
    library, task, seed = sys.argv[1:]
    for point in LIBRARIES[library](task, int(seed)):
        print(*point, flush=True)
