"""Refitting: E, P and F are learnt further from what the codes of a practised D do now; D stays."""

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Key

from taic_jax.config import OptionsConfig, PractiseConfig
from taic_jax.envs.base import Env
from taic_jax.envs.wrappers import AutoReset
from taic_jax.options.dataset import Window, gather
from taic_jax.options.execution import OptionExecutor, make_executor
from taic_jax.options.learning import descend
from taic_jax.options.losses import adversarial_loss, prediction_loss
from taic_jax.options.model import OptionModel
from taic_jax.rl import refresh
from taic_jax.rl.rollout import rollout, start

REFIT_ENVS, REFIT_OPTIONS = 64, 40
"""Environments, and options in each, from which E, P and F are refitted."""


def refit(
    options: OptionsConfig, config: PractiseConfig, env: Env, model: OptionModel, key: Key[Array, ""]
) -> tuple[OptionModel, dict[str, Array]]:
    """Learn E, P and F further from what codes of the prior do now, in any view, drawn anew for every option; D stays.

    E learns the likelihood of the code of its actions, since it shall still tell which option an action sequence is.
    Returns the model and the losses of every step.
    """
    key_start, key_run, key_steps = jax.random.split(key, 3)
    plain = make_executor(dataclasses.replace(options, termination="fixed", choose="code"), model)
    env, executor = AutoReset(env), AnyView(model, plain.termination, plain.length)
    begin = start(env, executor, REFIT_ENVS, key_start)
    ticks = REFIT_OPTIONS * options.length
    _, run = rollout(env, executor, lambda obs, noise: (noise, jnp.zeros(len(obs))), begin, key_run, ticks)
    own = refresh.own_options(run, model)
    recorded = own.windows.replace(views=model.views)

    def step(state: Any, key: Array) -> tuple[Any, dict[str, Array]]:
        which = jax.random.randint(key, (options.batch_size,), 0, own.windows.count)
        drawn = own.code[which]
        view = jax.vmap(partial(view_of, model))(drawn)
        windows = gather(recorded, which, own.duration[which], options.length, view)
        return descend(refit_loss, options, model, state, windows, drawn[:, :-1])

    learnt, losses = jax.lax.scan(
        step, refresh.init(options, model, key), jax.random.split(key_steps, config.refit_steps)
    )
    return model.replace(params=learnt.params), losses


class AnyView(OptionExecutor):
    """Options by their code, and a standard normal number, by which every view is as likely."""

    @property
    def option_size(self) -> int:
        """D + 1."""
        return super().option_size + 1

    def _chosen(self, option: Float[Array, " M"], state: Float[Array, " P"]) -> tuple[Float[Array, " D"], Any]:
        return option[:-1], view_of(self.model, option)


def view_of(model: OptionModel, option: Float[Array, " M"]) -> Int[Array, ""] | None:
    """Return the view of an option of `AnyView`, None for a model without views."""
    if not model.views:
        return None
    share = jax.scipy.stats.norm.cdf(option[-1])
    return jnp.minimum((share * model.sides).astype(jnp.int32), model.sides - 1)


def refit_loss(
    params: dict, model: OptionModel, options: OptionsConfig, windows: Window, codes: Float[Array, "N D"]
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Return the mean loss of E, P and F over N whole windows of these codes, and its terms."""
    model = model.replace(params=params)

    def one(window: Window, code: Float[Array, " D"]) -> dict[str, Array]:
        means, log_stds = model.encode(window.actions)
        z = (code - means[-1]) / jnp.exp(log_stds[-1])
        states = model.see(window.states, window.states[:1])
        change = model.changes(window.states)[-1]
        return {
            "encoder_loss": jnp.mean(0.5 * jnp.square(z) + log_stds[-1]),
            "prediction_loss": prediction_loss(model.predict(states[0], code), change),
            "adversarial_loss": adversarial_loss(model.estimate(code), states[0], states[-1]),
        }

    terms = jax.tree.map(jnp.mean, jax.vmap(one)(windows, codes))
    return sum(terms.values(), jnp.zeros(())), terms
