"""The number of points of a sweep that fit into memory at once, measured on the programs for one row."""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import psutil

from taic_jax.artifacts.experience import experience_bytes, num_blocks
from taic_jax.config import Config, ConfigError, experience_ticks, needs_collect, settings_of
from taic_jax.options.dataset import Experience, make_dataset
from taic_jax.sources import make_envs
from taic_jax.trainer import init_rows, make_trainer, step_rows
from taic_jax.types import as_rows

MIB = 2**20


def points_that_fit(config: Config, memory: int) -> int:
    """Return the number of points, with all seeds, that run in `memory` MiB (0: half of all), or raise ConfigError."""
    limit, used = (memory or machine_memory() // 2) * MIB, psutil.Process().memory_info().rss
    _, source = make_envs(config)
    ticks = experience_ticks(config.collect) if needs_collect(config) else 0
    least = 2 * experience_bytes(source, ticks) * config.seeds
    if used + least < limit and (count := int((limit - used) / (row_bytes(config) * config.seeds))):
        return count
    raise ConfigError(
        f"--memory: expected at least {(used + least) // MIB + 1:,} MiB for one point with {config.seeds} seeds, got "
        f"{limit // MIB:,}; fewer seeds or a smaller collect.capacity take less"
    )


def row_bytes(config: Config) -> int:
    """Return the most bytes of one row in flat PPO and in selecting windows: arguments, results and scratch."""
    env, source = make_envs(config)
    rows = as_rows([config], 1)
    keys = jax.random.split(jax.random.key(0), 1)
    sizes = [_step_bytes(rows, env, "flat", keys)]
    if needs_collect(config):
        sizes.append(_step_bytes(rows, source, "collect", keys))
    if not config.options.source:
        sizes.append(_program_bytes(jax.vmap(make_dataset), _experience(config, source), rows.options))
    return max(sizes)


def machine_memory() -> int:
    """Return the MiB that this process may use in all."""
    total = psutil.virtual_memory().total
    limit = Path("/sys/fs/cgroup/memory.max")
    text = limit.read_text().strip() if limit.exists() else "max"
    return min(total, int(text) if text.isdigit() else total) // MIB


def _step_bytes(rows: Config, env: Any, stage: str, keys: jax.Array) -> int:
    make, row = partial(make_trainer, stage, env), (rows, None)
    return _program_bytes(partial(step_rows, make), jax.eval_shape(partial(init_rows, make), row, keys), row)


def _experience(config: Config, env: Any) -> list[Experience]:
    """Return the shapes of the experience for learning options, one row of each source."""
    flat = settings_of(config.collect)
    ticks = min(num_blocks(config.collect) * flat.rollout_length, config.collect.ticks // flat.num_envs)
    shapes = [(1, ticks, flat.num_envs, *last) for last in ([env.proprioceptive_size], [env.action_size], [], [])]
    one = Experience(*map(jax.ShapeDtypeStruct, shapes, [jnp.float32] * 3 + [jnp.bool]))
    return [one] * max(len(config.options.experience), 1)


def _program_bytes(function: Any, *args: Any) -> int:
    sizes: Any = jax.jit(function).lower(*args).compile().memory_analysis()
    return sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes
