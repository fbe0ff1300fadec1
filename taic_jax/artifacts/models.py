"""Artifacts of a run for other runs: their descriptions in `description.json`, and folders of option models [K]."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from taic_jax.config import OptionsConfig
from taic_jax.envs.base import Env
from taic_jax.options.model import OptionModel, Scale, init_params, make_networks
from taic_jax.runtime.checkpoint import ArtifactError, Tree, load_tree, save_tree
from taic_jax.runtime.files import DESCRIPTION, read_description, save_json

OPTIONS = "options"

# The fields in which a frozen option model must agree with the config that uses it: its shapes and their meaning.
STRUCTURE = ("decoder", "size", "length", "termination", "hidden_size", "mlp_sizes", "decoder_sizes")


class Body(NamedTuple):
    """The environment of an artifact by its description: enough to read the artifact without the environment."""

    name: str
    proprioception: str
    proprioceptive_size: int
    action_size: int


def read_body(folder: Path) -> Body:
    """Return the body in an artifact's description, or raise ArtifactError without one."""
    description = read_description(folder) or {}
    try:
        return Body(description["env"], *(description[name] for name in Body._fields[1:]))
    except KeyError:
        raise ArtifactError(f"{folder / DESCRIPTION}: expected the description of an artifact, got none") from None


def describe(env: Env | Body) -> dict[str, Any]:
    """Return the description of a body: the name and size of its slice, and the number of its actions."""
    return {
        "env": env.name,
        "proprioception": getattr(env, "proprioception", env.name),
        "proprioceptive_size": env.proprioceptive_size,
        "action_size": env.action_size,
    }


def check_description(folder: Path, kind: str, env: Env | Body, fields: dict[str, Any]) -> dict[str, Any]:
    """Return an artifact's description, or raise ArtifactError where it differs from this body and these fields."""
    description = read_description(folder)
    if description is None:
        raise ArtifactError(f"{folder}: expected a run that got this far, or its {kind}; got none")
    if not isinstance(description.get("seeds"), int):
        raise ArtifactError(f"{folder / DESCRIPTION}: expected the description of an artifact, got another file")
    body = {name: value for name, value in describe(env).items() if name != "env"}
    for name, value in {**body, **fields}.items():
        value = list(value) if isinstance(value, tuple) else value
        if description.get(name) != value:
            got, why = description.get(name), f"which {env.name} needs" if name in body else "as in this config"
            raise ArtifactError(f"{folder / DESCRIPTION}: {name}: expected {value!r}, {why}; got {got!r}")
    return description


def save_options(folder: Path, model: OptionModel, env: Env, config: OptionsConfig) -> None:
    """Save option models [K] of `env` as the artifact `folder`."""
    save_tree(folder, model)
    save_json(folder / DESCRIPTION, describe(env) | structure(config) | {"seeds": len(model.delta)})


def load_options(source: Path, env: Env | Body, config: OptionsConfig, seeds: int) -> OptionModel:
    """Load option models [seeds] from a run or an artifact, or raise ArtifactError; seed k takes model k modulo K."""
    folder = source / OPTIONS if (source / OPTIONS).is_dir() else source
    description = check_description(folder, "option model", env, structure(config))
    return for_seeds(seeds, load_tree(folder, rows_like(description["seeds"], partial(empty_model, env, config))))


def for_seeds(seeds: int, rows: Tree) -> Tree:
    """Return rows [seeds], of which the k-th is row k modulo their number."""
    return jax.tree.map(lambda x: x[jnp.arange(seeds) % len(x)], rows)


def empty_model(env: Env | Body, config: OptionsConfig) -> OptionModel:
    """Return an option model of this structure, whose numbers are not meaningful."""
    networks = make_networks(config, env.proprioceptive_size, env.action_size)
    params, zeros = init_params(networks, config, jax.random.key(0)), jnp.zeros(env.proprioceptive_size)
    return OptionModel(params, Scale(zeros, zeros), Scale(zeros, zeros), jnp.zeros(()), networks)


def rows_like(count: int, make: Callable[[], Any]) -> Any:
    """Return the shapes of `count` rows of a tree."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((count, *x.shape), x.dtype), jax.eval_shape(make))


def structure(config: OptionsConfig) -> dict[str, Any]:
    """Return the fields of STRUCTURE by dotted name, for a description."""
    return {f"options.{name}": getattr(config, name) for name in STRUCTURE}
