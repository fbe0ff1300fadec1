"""Artifacts of a run for other runs: folders of its option models or flat policies [K], and `description.json`."""

from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from taic_jax.config import OptionsConfig, PPOConfig
from taic_jax.envs.base import Env
from taic_jax.networks import PolicyParams
from taic_jax.options.model import OptionModel, Scale, init_params, make_networks
from taic_jax.rl import normalize
from taic_jax.rl.ppo import Agent, Policy
from taic_jax.runtime.checkpoint import ArtifactError, load_tree, save_tree
from taic_jax.runtime.files import DESCRIPTION, read_description, save_json

OPTIONS, POLICY = "options", "policy"

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


def check_description(folder: Path, kind: str, env: Env | Body, structure: dict[str, Any]) -> dict[str, Any]:
    """Return an artifact's description, or raise ArtifactError at its first difference from this body and structure."""
    description = read_description(folder)
    if description is None:
        raise ArtifactError(f"{folder}: expected a run that got this far, or its {kind}; got none")
    if not isinstance(description.get("seeds"), int):
        raise ArtifactError(f"{folder / DESCRIPTION}: expected the description of an artifact, got another file")
    body = {name: value for name, value in describe(env).items() if name != "env"}
    for name, value in {**body, **structure}.items():
        value = list(value) if isinstance(value, tuple) else value
        if description.get(name) != value:
            got, why = description.get(name), f"which {env.name} needs" if name in body else "as in this config"
            raise ArtifactError(f"{folder / DESCRIPTION}: {name}: expected {value!r}, {why}; got {got!r}")
    return description


def save_options(folder: Path, model: OptionModel, env: Env, config: OptionsConfig) -> None:
    """Save option models [K] of `env` as the artifact `folder`."""
    _save(folder, model, describe(env) | _structure(config) | {"seeds": len(model.delta)})


def load_options(source: Path, env: Env | Body, config: OptionsConfig, seeds: int) -> OptionModel:
    """Load option models [seeds] from a run or an artifact, or raise ArtifactError; seed k takes model k modulo K."""
    folder = source / OPTIONS if (source / OPTIONS).is_dir() else source
    description = check_description(folder, "option model", env, _structure(config))

    def empty() -> OptionModel:
        networks = make_networks(config, env.proprioceptive_size, env.action_size)
        params, zeros = init_params(networks, config, jax.random.key(0)), jnp.zeros(env.proprioceptive_size)
        return OptionModel(params, Scale(zeros, zeros), Scale(zeros, zeros), jnp.zeros(()), networks)

    return _load(folder, description["seeds"], seeds, empty)


def _structure(config: OptionsConfig) -> dict[str, Any]:
    return {f"options.{name}": getattr(config, name) for name in STRUCTURE}


def save_policy(folder: Path, agent: Agent, env: Env) -> None:
    """Save flat policies [K] with their observation statistics as the artifact `folder`."""
    description = describe(env) | {
        "observation_size": env.observation_size,
        "hidden_sizes": list(agent.policy.hidden_sizes),
        "seeds": len(agent.params.log_std),
    }
    _save(folder, (agent.params, agent.obs_statistics), description)


def load_policy(source: Path, env: Env, config: PPOConfig, seeds: int) -> tuple[PolicyParams, normalize.Statistics]:
    """Load flat policies [seeds] of a run on another task of the same body, or raise ArtifactError.

    Input weights of the proprioceptive slice are copied; other observations of `env` get zeros and new statistics.
    """
    folder = source / POLICY
    structure = {"hidden_sizes": list(config.hidden_sizes)}
    description = check_description(folder, "flat policy", env, structure)
    policy, size = Policy(env.action_size, tuple(config.hidden_sizes)), description["observation_size"]

    def empty() -> tuple[PolicyParams, normalize.Statistics]:
        return policy.init(jax.random.key(0), size, 0.0), normalize.init((size,))

    params, statistics = _load(folder, description["seeds"], seeds, empty)
    fit = jax.vmap(lambda p, s: _fit(p, s, env.proprioceptive_size, env.observation_size))
    return fit(params, statistics)


def _fit(
    params: PolicyParams, statistics: normalize.Statistics, shared: int, size: int
) -> tuple[PolicyParams, normalize.Statistics]:
    """Copy the weights of the first `shared` inputs of a policy into one of `size` inputs."""

    def widen(layers: dict) -> dict:
        first = layers["params"]["Dense_0"]
        kernel = jnp.zeros((size, first["kernel"].shape[1])).at[:shared].set(first["kernel"][:shared])
        return {"params": {**layers["params"], "Dense_0": {**first, "kernel": kernel}}}

    params = params.replace(actor=widen(params.actor), critic=widen(params.critic))
    return params, normalize.carry_over(statistics, shared, size)


def _save(folder: Path, tree: Any, description: dict[str, Any]) -> None:
    save_tree(folder, tree)
    save_json(folder / DESCRIPTION, description)


def _load(folder: Path, saved: int, seeds: int, empty: Any) -> Any:
    like = jax.tree.map(lambda x: jax.ShapeDtypeStruct((saved, *x.shape), x.dtype), jax.eval_shape(empty))
    return jax.tree.map(lambda x: x[jnp.arange(seeds) % saved], load_tree(folder, like))
