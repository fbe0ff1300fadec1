"""Refreshing options: E, D, P and F are learnt further from the policy's own options, in turns with it (§3.5, §5).

After so many iterations of the learner come gradient steps on the options that the policy took in them. Their losses
are those of stage learn, and a penalty on the change of D's actions for the codes in use, so that codes keep their
meaning. Scales and delta stay those of the model. The replay buffer of SAC goes on holding decisions over older
options, whose outcomes are those of the actions that D then took.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from taic_jax.config import OptionsConfig
from taic_jax.envs.base import Env
from taic_jax.envs.views import one_view
from taic_jax.nonfinite import earliest
from taic_jax.options.dataset import Dataset, Experience, Window, flatten, gather
from taic_jax.options.execution import OptionExecutor
from taic_jax.options.learning import LearnState, descend, draw_noise, make_optimizer, total_loss
from taic_jax.options.losses import reconstruction_loss
from taic_jax.options.model import OptionModel
from taic_jax.rl.learner import Settings, learner_of
from taic_jax.rl.rollout import Rollout


class OwnOptions(NamedTuple):
    """Whole options of a policy: their windows, ticks and codes, in the order of `windows.starts`."""

    windows: Dataset
    duration: Array
    code: Array


def init(config: OptionsConfig, model: OptionModel, key: Key[Array, ""]) -> LearnState:
    """Return the state of further learning, with a fresh state of the optimiser."""
    optimizer = make_optimizer(config).init(model.params)
    return LearnState(model.params, optimizer, model.delta, key, jnp.zeros((), jnp.int32), model.networks)


def refreshed_executor(executor: OptionExecutor, learnt: LearnState) -> OptionExecutor:
    """Return the executor with E, D, P and F as learnt so far."""
    return executor.replace(model=executor.model.replace(params=learnt.params))


def own_options(ticks: Rollout, model: OptionModel) -> OwnOptions:
    """Return the options that begin and end within these ticks [T, B].

    Those that end with an episode or at the last tick are left out: no tick has the state after them.
    """
    num_ticks, tick = len(ticks.ended), jnp.arange(len(ticks.ended))[:, None]
    done = ticks.terminated | ticks.truncated
    whole = ticks.ended & ~done & (ticks.duration <= tick + 1) & (tick < num_ticks - 1)
    last = jnp.argsort(~flatten(whole), stable=True)
    duration = flatten(ticks.duration)[last]
    starts, obs = last - duration + 1, ticks.obs[..., : model.state_size]
    rows = Experience(*(flatten(x) for x in (obs, ticks.action, ticks.reward, done)))
    count = jnp.sum(whole, dtype=jnp.int32)
    views = one_view(model.state_size, ticks.action.shape[-1])
    windows = Dataset(rows, starts, count, jnp.zeros_like(count), model.state_scale, model.change_scale, views)
    return OwnOptions(windows, duration, flatten(ticks.option)[starts])


def action_change(old: OptionModel, new: OptionModel, window: Window, code: Float[Array, " D"]) -> Float[Array, ""]:
    """Return the mean squared difference of two models' decoded actions for this code, in the window's own states."""
    states = old.see(window.states[:-1], window.states[:1])
    before, after = (model.decode(code, states)[0] for model in (old, new))
    return reconstruction_loss(after, before, window.mask)


def refresh_loss(
    params: dict, model: OptionModel, config: OptionsConfig, windows: Window, codes: Float[Array, "N D"], *noise: Array
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Return the loss of stage learn plus the weighted change from `model`, and the mean of each over N windows."""
    total, losses = total_loss(params, model, config, windows, *noise)
    change = jnp.mean(jax.vmap(partial(action_change, model, model.replace(params=params)))(windows, codes))
    return total + config.refresh_weight * change, losses | {"change": change}


def refresh(
    config: OptionsConfig, model: OptionModel, ticks: Rollout, learnt: LearnState
) -> tuple[LearnState, dict[str, Array]]:
    """Take the gradient steps of one refresh of `model`, that of `learnt`, which acted in these ticks [T, B].

    Returns the next state and the mean losses, of the change the last. Without a whole option nothing changes, and the
    losses are NaN.
    """
    own = own_options(ticks, model)

    def step(state: LearnState, _: None) -> tuple[LearnState, dict[str, Array]]:
        key, key_windows, key_noise = jax.random.split(state.key, 3)
        which = jax.random.randint(key_windows, (config.batch_size,), 0, own.windows.count)
        windows = gather(own.windows, which, own.duration[which], config.length)
        noise = draw_noise(config, windows, key_noise)
        return descend(refresh_loss, config, model, state.replace(key=key), windows, own.code[which], *noise)

    after, losses = jax.lax.scan(step, learnt, None, config.refresh_steps)
    code, found = earliest(losses.pop("nonfinite")), own.windows.count > 0
    means = jax.tree.map(jnp.mean, losses) | {"change": losses["change"][-1]}
    metrics = {f"refresh_{name}": jnp.where(found, x, jnp.nan) for name, x in means.items()}
    return jax.tree.map(partial(jnp.where, found), after, learnt), metrics | {"nonfinite": code}


def iterate(
    options: OptionsConfig,
    settings: Settings,
    env: Env,
    executor: OptionExecutor,
    num_iterations: int,
    policy: Any,
    learnt: LearnState,
) -> tuple[Any, LearnState, dict[str, Array]]:
    """Run `options.refresh_every` of the learner's `num_iterations`, then refresh the options with their ticks.

    `executor` has the options as they were before the first refresh. Returns the policy's next state, that of the
    options, and the metrics of both: means over the iterations.
    """
    acting = refreshed_executor(executor, learnt)

    def one(policy: Any, _: Any) -> tuple[Any, tuple[dict[str, Array], Rollout]]:
        policy, metrics, ticks, *_ = learner_of(settings).iterate(settings, env, acting, num_iterations, policy)
        return policy, (metrics, ticks)

    policy, (metrics, ticks) = jax.lax.scan(one, policy, None, options.refresh_every)
    ticks = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), ticks)
    ticks = ticks.replace(option=acting.code(ticks.option))
    learnt, losses = refresh(options, acting.model, ticks, learnt)
    code = earliest(jnp.append(metrics.pop("nonfinite"), losses.pop("nonfinite")))
    return policy, learnt, jax.tree.map(partial(jnp.nanmean, axis=0), metrics) | losses | {"nonfinite": code}
