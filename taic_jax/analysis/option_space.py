"""Effects of options executed from chosen states, and the order of the option space by these effects (§4.2.1)."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, Int, Key

from taic_jax.analysis import measures
from taic_jax.config import OptionsConfig
from taic_jax.envs.base import Env, State
from taic_jax.envs.wrappers import AutoReset
from taic_jax.options.dataset import Dataset, Experience, Window, gather, make_dataset
from taic_jax.options.execution import Executor, make_executor
from taic_jax.options.frame import Frame
from taic_jax.options.learning import total_loss
from taic_jax.options.model import OptionModel
from taic_jax.rl.rollout import rollout, start
from taic_jax.types import as_arrays

WARM_UP = 100  # ticks of random options before a measure from many states: these are then states options lead to


class Effects(struct.PyTreeNode):
    """N options, the proprioceptive slices they began and ended in, the ticks they took, and the way of a body with a
    heading in m, seen from its heading at the start."""

    option: Array
    start: Array
    end: Array
    ticks: Array
    way: Array | None  # [N, 2]


def execute(
    env: Env, executor: Executor, option: Float[Array, "N D"], key: Key[Array, ""], many: bool = False
) -> Effects:
    """Execute each option once in `env`, not wrapped to reset itself, until its rule or the episode ends it.

    With `many`, each begins in another state, reached by random options; else all begin in the same first state.
    """
    key_start, key_warm_up, key_noise = jax.random.split(key, 3)
    env, num_options = AutoReset(env), len(option)
    begin = start(env, executor, num_options, key_start)
    if many:
        begin, _ = rollout(env, executor, lambda obs, noise: always(noise, obs, noise), begin, key_warm_up, WARM_UP)
        begin = begin.replace(ended=jnp.ones_like(begin.ended))
    else:
        first = jax.tree.map(lambda x: jnp.broadcast_to(x[:1], x.shape), begin.env.replace(key=None))
        begin = begin.replace(env=first.replace(key=begin.env.key))
    _, ticks = rollout(env, executor, partial(always, option), begin, key_noise, executor.length)
    last, size = jnp.argmax(ticks.ended, axis=0), env.proprioceptive_size
    end = jnp.take_along_axis(ticks.final_obs, last[None, :, None], axis=0)[0]
    states, way = ticks.obs[..., :size], None
    if env.heading:
        steps = Frame(env.heading, turns=True, weight=1).way(states, states[:1])
        way = jnp.sum(steps, axis=0, where=(jnp.arange(executor.length)[:, None] <= last[None])[..., None])
    return Effects(option, states[0], end[:, :size], last + 1, way)


def replay(
    env: AutoReset, executor: Executor, state: State, option: Float[Array, "N D"], key: Key[Array, ""], times: Any,
    most: int,
) -> tuple[State, Int[Array, " N"]]:  # fmt: skip
    """Execute each of N options `times` <= `most` times in a row, all from one state.

    Returns:
      The states [T + 1, N, ...], T = most * L, from this one on, and the ticks [N] after which they stay the same, as
      the options have ended or the next tick ends the episode.
    """
    count, ticks = len(option), most * executor.length
    same = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), state)
    begin = start(env, executor, count, key).replace(env=same)
    _, run = rollout(env, executor, partial(always, option), begin, key, ticks, lambda state: state)
    over = jnp.cumsum(run.terminated | run.truncated, axis=0) > 0  # the state is already of the next episode
    last = jnp.sum((jnp.cumsum(run.decision, axis=0) <= times) & ~over, axis=0)
    tick, rows = jnp.minimum(jnp.arange(ticks + 1)[:, None], last[None]), jnp.arange(count)
    return jax.tree.map(lambda x, later: jnp.concatenate([x[None], later])[tick, rows], same, run.extras), last


def always(option: Float[Array, "B D"], obs: Float[Array, "B S"], noise: Array) -> tuple[Array, Array]:
    """Decide on these options for any observation: with them bound, a `DecideFn`."""
    return option, jnp.zeros(len(option))


def prior_effects(
    env: Env, config: OptionsConfig, model: OptionModel, key: Key[Array, ""], count: int = 500, many: bool = False
) -> Effects:
    """Execute options from the prior, see `execute`."""
    key_prior, key_run = jax.random.split(key)
    executor = make_executor(as_arrays(config), model)
    option = jax.random.normal(key_prior, (count, executor.option_size))
    run = jax.jit(execute, static_argnums=(0, 4))  # one program for all models
    return jax.device_get(run(env, executor, option, key_run, many))


def order(env: Env, config: OptionsConfig, model: OptionModel, key: Key[Array, ""], count: int = 500) -> float:
    """Return the distance correlation of options from the prior and the changes they cause in one state."""
    effects = prior_effects(env, config, model, key, count)
    change = np.asarray(effects.end) - np.asarray(effects.start)
    return measures.distance_correlation(effects.option, measures.standardized(change, change))


class WindowCodes(struct.PyTreeNode):
    """Codes of N windows, mean and log standard deviation of q(o|a), the actions, and the states at both ends."""

    mean: Array
    log_std: Array
    actions: Array
    start: Array
    end: Array


@partial(jax.jit, static_argnames="count")
def encode_windows(
    config: OptionsConfig,
    model: OptionModel,
    experience: Experience | Sequence[Experience],
    key: Key[Array, ""],
    count: int,
) -> WindowCodes:
    """Encode `count` windows of `config.length` ticks, drawn from the selection."""
    return _encode(model, _draw(config, make_dataset(experience, config), key, count))


def _draw(config: OptionsConfig, dataset: Dataset, key: Key[Array, ""], count: int) -> Window:
    drawn = jax.random.randint(key, (count,), 0, dataset.count)
    return gather(dataset, drawn, jnp.full(count, config.length), config.length)


def _encode(model: OptionModel, windows: Window) -> WindowCodes:
    means, log_stds = jax.vmap(model.encode)(windows.actions)
    return WindowCodes(means[:, -1], log_stds[:, -1], windows.actions, windows.states[:, 0], windows.states[:, -1])


def measure_windows(
    config: OptionsConfig, model: OptionModel, dataset: Dataset, key: Key[Array, ""], count: int = 1000
) -> dict[str, float]:
    """Measure one seed's option model by `count` windows drawn from a dataset, without an environment.

    Returns:
      The losses of D, P and F by `window_losses` at the mean codes; `active_dimensions`, `kl` and `window/NAME` as
      `measure`.
    """
    key_windows, key_data = jax.random.split(key)
    windows = jax.jit(_draw, static_argnames="count")(config, dataset, key_windows, count=count)
    codes = jax.device_get(jax.jit(_encode)(model, windows))
    _, losses = jax.jit(total_loss)(model.params, model, config, windows, jnp.zeros(codes.mean.shape))
    names = "reconstruction_loss", "prediction_loss", "adversarial_loss"
    return {name: float(losses[name]) for name in names} | _measure_codes(codes, _sample(codes, key_data))


def _sample(codes: WindowCodes, key: Key[Array, ""]) -> Array:
    """Draw a code [N, D] of each window from its q(o|a)."""
    return codes.mean + jnp.exp(codes.log_std) * jax.random.normal(key, codes.mean.shape)


def _measure_codes(codes: WindowCodes, option: Array) -> dict[str, float]:
    measured = measures.measure_option_space(option, codes.start, codes.end)
    return {
        "active_dimensions": float(measures.active_dimensions(codes.mean)),
        "kl": float(measures.kl_per_dimension(codes.mean, codes.log_std).sum()),
        **{f"window/{name}": value for name, value in measured.items()},
    }


def measure(
    env: Env, config: OptionsConfig, model: OptionModel, experience: Experience, key: Key[Array, ""], count: int = 1000
) -> dict[str, float]:
    """Measure one seed's option model by N = `count` options from the prior and from data, from one state and many.

    Returns:
      Every measure of `measure_option_space` and the mean duration `ticks` under `prior|data/one|many/NAME`; the
      measures of the windows with their recorded states under `window/NAME`; and `active_dimensions` and `kl`, in
      nats, of the windows' codes.
    """
    config = as_arrays(config)
    key_prior, key_windows, key_data, *keys = jax.random.split(key, 7)
    windows = jax.device_get(encode_windows(config, model, experience, key_windows, count))
    data = _sample(windows, key_data)
    prior = jax.random.normal(key_prior, data.shape)
    executor = make_executor(config, model)
    run = jax.jit(partial(execute, env), static_argnames="many")
    result = _measure_codes(windows, data)
    cases = [(kind, option, many) for kind, option in (("prior", prior), ("data", data)) for many in (False, True)]
    for (kind, option, many), key_run in zip(cases, keys, strict=True):
        effects = jax.device_get(run(executor, option, key_run, many=many))
        measured = measures.measure_option_space(effects.option, effects.start, effects.end)
        measured["ticks"] = float(effects.ticks.mean())
        # From one state the start is constant, and the end is the change.
        names = [name for name in measured if many or not name.endswith(("/start", "/end"))]
        result |= {f"{kind}/{'many' if many else 'one'}/{name}": measured[name] for name in names}
    return result
