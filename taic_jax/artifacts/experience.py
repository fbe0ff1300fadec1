"""Experience: flat PPO's training trajectories, on disk as a bounded number of files, one per iteration.

A file holds the T ticks of one iteration, of every environment and seed: a killed run loses at most one iteration, and
a resumed one writes the same files again.
"""

import dataclasses
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from taic_jax.artifacts.models import Body, check_description
from taic_jax.config import CollectConfig, OptionsConfig, experience_ticks, impossible, settings_of
from taic_jax.data.read import Recording, as_column, read_recording
from taic_jax.envs.base import Env
from taic_jax.options.dataset import Experience
from taic_jax.options.execution import IdentityExecutor
from taic_jax.rl.agent import Agent
from taic_jax.rl.learner import learner_of, num_iterations
from taic_jax.rl.rollout import Rollout
from taic_jax.runtime.checkpoint import ArtifactError
from taic_jax.runtime.files import DESCRIPTION, atomic_file, save_json, writing
from taic_jax.types import as_arrays

EXPERIENCE, USUAL = "experience", OptionsConfig()


def as_experience(ticks: Rollout, proprioceptive_size: int) -> Experience:
    """Return the part of a rollout that option learning needs."""
    done = ticks.terminated | ticks.truncated
    return Experience(ticks.obs[..., :proprioceptive_size], ticks.action, ticks.reward, done)


def collect(config: CollectConfig, env: Env, key: Key[Array, ""]) -> tuple[Agent, dict[str, Array], Experience]:
    """Train a flat policy in `env`; pure, so keys may be vmapped.

    Return the agent, the metrics of every iteration, and the newest experience [T, B, ...], within the capacity.
    """
    config = as_arrays(config)
    executor = IdentityExecutor(env.action_size, discrete=env.discrete)
    settings = settings_of(config)
    learner, count = learner_of(settings), num_iterations(settings, config.ticks)
    late = min(num_blocks(config), count)

    def step(keep: bool, state: Any, _: Any) -> tuple[Any, Any]:
        state, metrics, ticks, *_ = learner.iterate(settings, env, executor, count, state)
        return state, (metrics, as_experience(ticks, env.proprioceptive_size) if keep else None)

    first = learner.init(settings, env, executor, key)
    state, (early, _) = jax.lax.scan(partial(step, False), first, None, count - late)
    state, (last, blocks) = jax.lax.scan(partial(step, True), state, None, late)
    metrics = jax.tree.map(lambda *parts: jnp.concatenate(parts), early, last)
    experience = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), blocks)
    return learner.as_agent(settings, executor, state), metrics, experience


def num_blocks(config: CollectConfig) -> int:
    """Return the number of iterations in the experience, at least one."""
    return max(num_iterations(settings_of(config), experience_ticks(config)), 1)


def experience_bytes(env: Env, ticks: int) -> int:
    """Return the bytes that `ticks` ticks of experience of one seed take, on disk and in memory."""
    return ticks * (4 * (env.proprioceptive_size + env.action_size + 1) + 1)


class ExperienceStore:
    """A folder, made if missing, of the latest `capacity` blocks [K, T, B, ...] and their description."""

    def __init__(self, folder: Path, capacity: int, description: dict):
        self.folder, self.capacity = folder, capacity
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        save_json(folder / DESCRIPTION, description)

    def write(self, iteration: int, block: Experience) -> None:
        """Save the block of one iteration atomically, or raise SaveError, and drop the oldest beyond the capacity."""
        path = self.folder / f"{iteration:06d}.npz"
        with atomic_file(path) as file:
            np.savez(file, **vars(block))
        with writing(path):
            (self.folder / f"{iteration - self.capacity:06d}.npz").unlink(missing_ok=True)


def read_experience(folder: Path, seed: int) -> Experience:
    """Return one seed's blocks in time order as NumPy arrays [T, B, ...], or raise ArtifactError."""
    paths = sorted(folder.glob("[0-9]*.npz"))
    if not paths:
        raise ArtifactError(f"{folder} holds no experience: no file like 000000.npz in it")
    blocks = []
    for path in paths:
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as block:
                blocks.append(Experience(*(block[field.name][seed] for field in dataclasses.fields(Experience))))
        except (OSError, EOFError, ValueError, KeyError, IndexError, zipfile.BadZipFile) as error:
            raise ArtifactError(f"{path} is no block of experience with seed {seed}: {error}") from None
    return jax.tree.map(lambda *parts: np.concatenate(parts), *blocks)


def gather_experience(
    source: Path,
    env: Env | Body,
    seeds: int,
    config: OptionsConfig = USUAL,
    say: Callable[[str], object] = lambda line: None,
) -> Experience:
    """Return the experience [K, T, B, ...] of a run, or other people's data, for the body of `env`.

    Seed k takes the run's seed k modulo their number; data are every seed's. `config` names the arrays of data and
    their bounds, and `say` gets a line on what was read.

    Raises:
      ArtifactError: there is none, or it is of another body.
      ConfigError: the config selects windows by rewards, and the data have none.
    """
    folder = source / EXPERIENCE if (source / EXPERIENCE).is_dir() else source
    if not (folder / DESCRIPTION).is_file():
        if not source.exists() or (source / "config.yaml").is_file():
            raise ArtifactError(f"{source}: expected a run that collected experience, or recorded data; got none")
        recording = read_recording(source, config.observations, config.actions)
        recording = recording.fitted(env.proprioceptive_size, env.action_size).scaled(config.action_bounds)
        say(recording.summary)
        return of_every_seed(recording, config, seeds)
    description = check_description(folder, "experience", env, {})
    columns = [read_experience(folder, seed % description["seeds"]) for seed in range(seeds)]
    return jax.tree.map(lambda *x: jnp.stack(x), *columns)


def of_every_seed(recording: Recording, config: OptionsConfig, seeds: int) -> Experience:
    """Return recorded data as the experience [K, T, 1, ...] of every seed; ConfigError if the config wants rewards."""
    if config.select == "top" and not recording.experience.reward.any():
        raise impossible("options.select", "top", f"random for {recording.path}, which has no rewards", "random")
    column = as_column(recording.experience)
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (seeds, *x.shape)), column)
