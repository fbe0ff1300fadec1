"""Folders as runs leave them, written by hand: no training, and every number is known."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image
from tiny_runs import CONFIG

from taic_jax.analysis.statistics import summarize
from taic_jax.artifacts.experience import EXPERIENCE, ExperienceStore
from taic_jax.artifacts.models import OPTIONS, describe, save_options
from taic_jax.config import Config
from taic_jax.config.files import to_yaml
from taic_jax.envs import make_env
from taic_jax.experiments.evidence.table import append_row
from taic_jax.options.dataset import Experience
from taic_jax.options.model import OptionModel, Scale, init_params, make_networks

SEEDS = (1.0, 3.0)
TICKS = 1000
"""Of a row of the table of finished runs."""


def rows(iterations: int = 3) -> list[dict]:
    """Return rows of every stage: the return of iteration i is i times 1 and 3, and 10 more over options."""
    result = []
    for stage, more in (("collect", 0.0), ("train", 10.0)):
        for i in range(1, iterations + 1):
            row = {"stage": stage, "ticks": 16 * i, "time": 1e9 + i}
            row |= {f"{stage}/return": [i * seed + more for seed in SEEDS], f"{stage}/entropy": [2 - i, -i]}
            row |= {"train/durations": [[1, 3], [1, 3]]} if stage == "train" else {}
            result.append(row)
        result.append({"stage": "evaluate", "ticks": 48, "time": 1e9, f"evaluate/{stage}/return": list(SEEDS)})
        if stage == "collect":
            result.append({"stage": "learn", "steps": 4, "time": 1e9, "learn/kl_loss": [0.5, None]})
    return result


def method(*returns: float) -> dict:
    """Return what a summary tells of a method."""
    told = summarize(np.array(returns)) | {"first_per_seed": [0.0] * len(returns)}
    duration = summarize(np.full(len(returns), 1.75)) | {"histogram": [0.25, 0.75]}
    return {"return": told, "return_mean_option": told, "duration": duration, "metrics": {}}


def write_run(
    folder: Path, config: Config = CONFIG, *, finished: bool = True, written: list[dict] | None = None
) -> Path:
    """Write config, rows and, of a finished run, the summary and a video."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(to_yaml(config))
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in written or rows()))
    (folder / "clock.json").write_text(json.dumps({"compile": 1.0, "run": 2.0, "ticks": 192}))
    if finished:
        summary = {"ticks": 192, "seconds": {"compile": 1.0, "run": 2.0}, "stopped": {}, "commit": "0123456789abcdef"}
        methods = {"taic": method(11.0, 13.0), "flat": method(*SEEDS)}
        (folder / "summary.json").write_text(json.dumps(summary | {"methods": methods, "versions": {"jax": "1"}}))
        frames = [Image.new("RGB", (8, 6), colour) for colour in ("red", "blue")]
        frames[0].save(folder / "video.webp", save_all=True, append_images=frames[1:])
    return folder


def write_options(folder: Path, config: Config = CONFIG, *, experience: bool = True) -> None:
    """Add options as random as they were drawn and, if asked for, experience whose state i changes by i + 1 a tick."""
    env, options = make_env(config.env.name), config.options
    networks = make_networks(options, env.proprioceptive_size, env.action_size)
    ones = jnp.ones(env.proprioceptive_size)
    scale = Scale(0 * ones, ones)
    model = OptionModel(init_params(networks, options, jax.random.key(0)), scale, scale, jnp.zeros(()), networks)
    save_options(folder / OPTIONS, jax.tree.map(lambda x: jnp.stack([x, x]), model), env, options)
    if experience:
        obs = np.arange(32.0)[:, None, None] * np.arange(1.0, len(ones) + 1)
        obs = np.broadcast_to(obs.astype(np.float32), (2, 32, 4, len(ones)))
        action = np.random.default_rng(0).uniform(-1, 1, (2, 32, 4, env.action_size)).astype(np.float32)
        block = Experience(obs, action, action[..., 0], np.zeros((2, 32, 4), bool))
        ExperienceStore(folder / EXPERIENCE, 1, describe(env) | {"seeds": 2}).write(0, block)


def made_row(task: str, method: str, seed: int, seeds: int, level: float, **changes) -> dict:
    """Return a row of seeds whose returns rise to level + 0, 1, 2..."""
    grid = np.arange(1, 51) * (TICKS // 50)
    last = level + np.arange(seeds)
    curves = {"return": np.outer(last, grid / TICKS).tolist()}
    numbers = {"first": np.zeros(seeds).tolist(), "last": last.tolist(), "mean_option": (-last).tolist()}
    row = {
        "task": task, "method": method, "seed": seed, "seeds": seeds, "ticks": TICKS, "pretraining": 0,
        "config": "a", "versions": {"jax": "1"}, "stopped": {}, "grid": grid.tolist(), "curves": curves,
        "numbers": numbers,
    }  # fmt: skip
    return row | changes


def written(table: Path, *rows: dict) -> str:
    """Write rows to a table and return its name."""
    for row in rows:
        append_row(table, row)
    return str(table)
