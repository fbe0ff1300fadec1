"""One tick of an agent under its mean options as a function, and as files that need no code of this package."""

import dataclasses
import io
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from taic_jax.envs.errors import MissingExtraError
from taic_jax.networks import SquashedParams
from taic_jax.options.execution import OptionExecutor
from taic_jax.rl.agent import Agent, advance
from taic_jax.rl.normalize import CLIP
from taic_jax.runtime.checkpoint import plain_arrays

FILES = {"jax": "agent.stablehlo", "onnx": "agent.onnx", "npz": "agent.npz"}
NETWORKS = ("actor", "values", "decoder", "encoder", "predictor")
IDLE = {"critic", "log_std", "epsilon", "count", "summed_variance", "estimator"}  # parts that do not act


def tick_of(agent: Agent) -> tuple[Callable[..., tuple[Array, ...]], dict[str, Any]]:
    """Return a tick (obs [S], *carry) -> (action [A], *next carry), and its arguments by name, all of zeros.

    A carry of zeros begins an episode: its `duration` is 0, with which an option begins.
    """
    executor: Any = agent.executor
    if isinstance(executor, OptionExecutor):  # without noise an end signal counts from one half on
        termination = dataclasses.replace(executor.termination, noise_size=0)
        executor = executor.replace(termination=termination, std=None)
    agent, obs = agent.replace(executor=executor), jnp.zeros(agent.observation_size)
    start = jax.tree.map(jnp.zeros_like, agent.start(obs).replace(noise=None))

    def tick(obs: Array, *carry: Array) -> tuple[Array, ...]:
        acting = jax.tree.unflatten(jax.tree.structure(start), carry).replace(noise=jnp.zeros(0))
        acting, action, _ = advance(agent, acting, obs)
        return action, *jax.tree.leaves(acting.replace(noise=None))

    named = {jax.tree_util.keystr(p, simple=True, separator="."): x for p, x in jax.tree.leaves_with_path(start)}
    return tick, {"obs": obs, **named}


def export(agent: Agent, formats: Sequence[str]) -> tuple[dict[str, bytes], dict[str, Any]]:
    """Return the files of an agent by name, and the description of the function that they hold.

    Raises:
      MissingExtraError: the formats include onnx, and that package is not installed.
    """
    (tick, inputs), files = tick_of(agent), {}
    arrays: dict[str, Any] = {name: x for name, x in plain_arrays(agent).items() if not IDLE & set(name.split("."))}
    if "jax" in formats:
        function = jax.export.export(jax.jit(tick), platforms=("cpu", "cuda"))(*inputs.values())
        files[FILES["jax"]] = bytes(function.serialize())
    if "onnx" in formats:
        try:
            from taic_jax.handles.onnx_graph import to_onnx
        except ModuleNotFoundError:
            raise MissingExtraError("onnx", "onnx") from None
        files[FILES["onnx"]] = to_onnx(tick, inputs, ["action", *(f"next.{name}" for name in [*inputs][1:])])
    if "npz" in formats:
        np.savez(buffer := io.BytesIO(), **arrays)
        files[FILES["npz"]] = buffer.getvalue()
    carry = [{"name": name, "shape": x.shape, "dtype": x.dtype.name, "start": 0} for name, x in inputs.items()][1:]
    layers = {x: {name.rpartition(".")[0] for name in arrays if f".{x}." in name} for x in NETWORKS}
    ordered = {x: sorted(names, key=lambda name: (len(name), name)) for x, names in layers.items()}
    about = {"observation_size": agent.observation_size, "actions": [-1, 1], "carry": carry, "layers": ordered}
    bound = float(agent.params.bound) if isinstance(agent.params, SquashedParams) else None
    about |= {"activation": "tanh", "clip": CLIP, "bound": bound, "length": agent.executor.length}
    return files, about | {"one_hot": agent.executor.discrete}
