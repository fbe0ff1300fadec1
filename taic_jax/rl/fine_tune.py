"""Fine-tuning D: PPO on primitive actions through the decoder, in turns with the policy over options (§5).

D's actions are drawn around its output, so that PPO has the gradient of their likelihood. From the same ticks first the
policy learns which option to choose, then D learns its actions; E, P and F do not change. A KL term can hold D near the
learnt one.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int, Key

from taic_jax.config import FineTuneConfig, PPOConfig
from taic_jax.envs.base import Env
from taic_jax.networks import apply
from taic_jax.nonfinite import earliest, first_nonfinite
from taic_jax.options.execution import Decoding, OptionExecutor
from taic_jax.options.model import OptionModel
from taic_jax.rl import ppo
from taic_jax.rl.returns import Judgement, semi_markov_advantages
from taic_jax.rl.rollout import Rollout
from taic_jax.rl.update import descend, make_optimizer, shuffled
from taic_jax.types import Scalar


class Tuned(struct.PyTreeNode):
    """Parameters of the D in use, and the state of its optimiser."""

    decoder: Any
    optimizer: optax.OptState


class Actions(struct.PyTreeNode):
    """R ticks, the input of D's loss: D's inputs, the action before clipping, its likelihood and its advantage.

    `tick` counts from 0 at the option's start.
    """

    option: Array
    state: Array
    tick: Array
    action: Array
    log_prob: Array
    advantage: Array


def init(config: PPOConfig, executor: OptionExecutor) -> Tuned:
    """Return the learnt D, and a fresh state of its optimiser."""
    decoder = executor.model.params["decoder"]
    return Tuned(decoder, make_optimizer(config).init(decoder))


def tuned_executor(executor: OptionExecutor, decoder: Any) -> OptionExecutor:
    """Return the executor with another D."""
    return executor.replace(model=executor.model.with_decoder(decoder))


def fill_options(option: Float[Array, "T B D"], decision: Bool[Array, "T B"], first: Float[Array, "B D"]) -> Array:
    """Return the running option of each tick [T, B, D]: that of the last decision, or `first` before the first one."""

    def tick(running: Array, step: tuple[Array, Array]) -> tuple[Array, Array]:
        chosen, decides = step
        running = jnp.where(decides[:, None], chosen, running)
        return running, running

    return jax.lax.scan(tick, first, (option, decision))[1]


def mean_action(
    model: OptionModel, length: int, option: Float[Array, " D"], state: Float[Array, " P"], tick: Int[Array, ""]
) -> Float[Array, " A"]:
    """Return D's output at the option's `tick`-th action of `length`, counted from 0, in this normalised state."""
    return apply(model.networks.decoder, model.params["decoder"], option, state, tick, length, method="at")


def decoder_loss(
    decoder: Any, executor: OptionExecutor, batch: Actions, config: PPOConfig, fine: FineTuneConfig
) -> tuple[Float[Array, ""], tuple[Array, Array]]:
    """Return PPO's clipped loss of M actions plus the weighted KL to the executor's D, and both terms."""
    tuned, learnt = executor.model.with_decoder(decoder), executor.model
    means, anchors = (
        jax.vmap(partial(mean_action, model, executor.length))(batch.option, batch.state, batch.tick)
        for model in (tuned, learnt)
    )
    ratio = jnp.exp(_log_prob(batch.action, means, fine.std) - batch.log_prob)
    clipped = jnp.clip(ratio, 1.0 - config.clip, 1.0 + config.clip)
    surrogate = -jnp.mean(jnp.minimum(ratio * batch.advantage, clipped * batch.advantage))
    kl = jnp.mean(jnp.sum(jnp.square(means - anchors), axis=-1)) / (2.0 * fine.std**2)
    return surrogate + fine.kl_weight * kl, (surrogate, kl)


def _log_prob(action: Float[Array, "M A"], mean: Float[Array, "M A"], std: Scalar) -> Float[Array, " M"]:
    # Up to a constant, which the ratio drops.
    return -jnp.sum(jnp.square(action - mean), axis=-1) / (2.0 * std**2)


def iterate(
    config: PPOConfig,
    fine: FineTuneConfig,
    env: Env,
    executor: OptionExecutor,
    num_iterations: int,
    state: ppo.TrainState,
    tuned: Tuned,
) -> tuple[ppo.TrainState, Tuned, dict[str, Array]]:
    """Run one iteration: one of PPO over options with noise on D's actions, then D's epochs on the same ticks.

    `config` is of PPO; its `clip`, `gamma`, `lambda_` and `max_grad_norm` apply to D too. `fine` has its other
    settings, `executor` the learnt options. Returns the next state, D, and the metrics of both.
    """
    noisy = tuned_executor(executor, tuned.decoder).replace(std=fine.std)
    after, metrics, ticks, judgement = ppo.iterate(config, env, noisy, num_iterations, state)
    rows = _rows(config, noisy, state.running.option, ticks, judgement)
    learning_rate = ppo.step_size(config, fine.learning_rate, state.iteration, num_iterations)
    epoch = partial(_epoch, config, fine, learning_rate, executor, rows)
    key, key_update = jax.random.split(after.key)
    tuned, losses = jax.lax.scan(epoch, tuned, jax.random.split(key_update, fine.epochs))
    metrics |= {
        "decoder_loss": jnp.mean(losses[0]),
        "decoder_kl": losses[1][-1, -1],
        "nonfinite": earliest(jnp.stack([metrics["nonfinite"], first_nonfinite(loss=losses, gradient=tuned)])),
    }
    return after.replace(key=key), tuned, metrics


def _rows(config: PPOConfig, noisy: OptionExecutor, running: Decoding, ticks: Rollout, judgement: Judgement) -> Actions:
    """Return every tick as a row, with the advantage of its action; `running` are the options at the first tick."""
    advantage = semi_markov_advantages(judgement, jnp.ones_like(ticks.ended), config.gamma, config.lambda_)
    model, tick = noisy.model, ticks.duration - 1
    option = fill_options(noisy.code(ticks.option), ticks.decision, running.option)
    states = ticks.obs[..., : model.state_size]
    first = None if running.first is None else fill_options(states, ticks.decision, running.first)
    proprioception = model.see(states, first)
    means = jax.vmap(jax.vmap(partial(mean_action, model, noisy.length)))(option, proprioception, tick)
    action = means + noisy.std * ticks.noise[..., -means.shape[-1] :]
    log_prob = jax.vmap(partial(_log_prob, std=noisy.std))(action, means)
    rows = Actions(option, proprioception, tick, action, log_prob, ppo.standardize(advantage))
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), rows)


def _epoch(
    config: PPOConfig,
    fine: FineTuneConfig,
    learning_rate: Scalar,
    executor: OptionExecutor,
    rows: Actions,
    tuned: Tuned,
    key: Key[Array, ""],
) -> tuple[Tuned, tuple[Array, Array]]:
    """Pass once over all ticks in random order, except for a rest that fills no minibatch."""
    count = len(rows.advantage) // fine.minibatch_size
    order = shuffled(jnp.ones(len(rows.advantage), bool), key)[: count * fine.minibatch_size]
    batches = jax.tree.map(lambda x: x[order].reshape((count, fine.minibatch_size, *x.shape[1:])), rows)

    def minibatch(tuned: Tuned, batch: Actions) -> tuple[Tuned, tuple[Array, Array]]:
        gradient, terms = jax.grad(decoder_loss, has_aux=True)(tuned.decoder, executor, batch, config, fine)
        return Tuned(*descend(config, learning_rate, gradient, tuned.decoder, tuned.optimizer)), terms

    return jax.lax.scan(minibatch, tuned, batches)
