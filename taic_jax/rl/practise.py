"""Practice: D is refined on-policy on open ground, so that a code leads where it says from every start.

Codes from the prior are held for one or more options each. D acts through its own mean, and is learnt by flat PPO,
whose actor it is: its input is the observation of the task `Practising`. A code says where it leads by P, as learnt
before: the way that P predicts from the mean state.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Key

from taic_jax.config import OptionsConfig, PPOConfig, PractiseConfig
from taic_jax.envs.base import Env, State
from taic_jax.envs.wrappers import AutoReset, Wrapper
from taic_jax.networks import PolicyParams, apply
from taic_jax.options.dataset import Window, gather
from taic_jax.options.execution import make_executor
from taic_jax.options.learning import descend
from taic_jax.options.losses import adversarial_loss, prediction_loss
from taic_jax.options.model import OptionModel
from taic_jax.rl import refresh
from taic_jax.rl.rollout import rollout, start

METRICS = ("speed_along", "speed_across", "upright")
REFIT_ENVS, REFIT_OPTIONS = 64, 40
"""Environments, and options in each, from which E and P are refitted."""
SECTOR_CODES, OTHERS = 256, 32  # codes that measure the sector, and that one code is compared with


class PracticeState(struct.PyTreeNode):
    """The inner task, which resets itself, and the code that is practised; `obs` is the observation of both."""

    inner: State
    obs: Array
    code: Array  # [D]
    direction: Array  # [2] seen from the heading, of length 1
    first: Array  # [P] state in which the option began, in its view
    way: Array  # [2] m since then, seen from it
    sector: Any  # of all codes
    view: Array  # [] int32, in which D sees the state and acts; 0 without options by their way
    left: Array  # [] int32, options for which the code is still held
    tick: Array  # [] int32, within the option
    key: Array


class Practising(Wrapper):
    """A task whose observation is D's input: the state that D sees, a code from the prior, and the share of its ticks.

    The reward of a tick is the upward part of the body's own axis, less the costs of control and of change; and the
    speed in m/s in the code's direction, seen from the heading and up to `speed`, less half the speed across it, or at
    an option's end the information. Episodes end as those of the inner task, which resets itself: what resets a batch
    under `vmap` may not read a model of its own in each row.
    """

    def __init__(self, env: Env, options: OptionsConfig, config: PractiseConfig, model: OptionModel):
        super().__init__(AutoReset(env))
        self.model, self.options, self.config = model, options, config
        self.frame: Any = model.networks.frame
        self.name = f"practice of {env.name}"
        self.observation_size = self.proprioceptive_size = model.state_size + options.size + 1

    def reset(self, key: Key[Array, ""]) -> State:
        """Start the inner task, and draw a code."""
        key_inner, key = jax.random.split(key)
        zero, nothing = jnp.zeros((), jnp.int32), jnp.zeros(self.options.size)
        inner = self.env.reset(key_inner)
        obs, sector = jnp.zeros(self.observation_size), sector_of(self.model)
        first = inner.obs[: self.model.state_size]
        start = PracticeState(inner, obs, nothing, jnp.zeros(2), first, jnp.zeros(2), sector, zero, zero, zero, key)
        practice = self._draw(start)
        return State.first(practice, practice.obs, dict.fromkeys(METRICS, jnp.zeros(())))

    def restart(self, key: Key[Array, ""], ended: PracticeState) -> State:
        """Go on: the inner task has restarted already."""
        return State.first(ended, ended.obs, {})

    def step(self, state: State, action: Float[Array, " A"]) -> State:
        """Act in the inner task; at its end, or that of a code's last option, draw another code."""
        before: PracticeState = state.physics
        views = self.model.views
        inner = self.env.step(before.inner, views.action(views.back(before.view), action) if views else action)
        after, tick = self._state(before, inner.final_obs), before.tick + 1
        ended = tick >= self.options.length
        way = before.way + self.frame.way(after, before.first)
        reward, metrics = self._judge(before.replace(way=way), after, action)
        practice = before.replace(
            inner=inner,
            tick=jnp.where(ended, 0, tick),
            left=before.left - ended.astype(jnp.int32),
            first=jnp.where(ended, after, before.first),
            way=jnp.where(ended, 0.0, way),
        )
        left, practice = practice.left, practice.replace(obs=self._observe(practice, inner.obs))
        new = (left <= 0) | inner.terminated | inner.truncated
        practice = jax.tree.map(lambda x, y: jnp.where(new, x, y), self._draw(practice), practice)
        final = self._observe(before.replace(tick=tick), inner.final_obs)
        obs = jnp.where(inner.terminated | inner.truncated, final, practice.obs)
        flags = {"terminated": inner.terminated, "truncated": inner.truncated}
        return state.replace(physics=practice, obs=obs, reward=reward, metrics=metrics, **flags)

    def _draw(self, practice: PracticeState) -> PracticeState:
        """Begin an option of another code."""
        key, key_code, key_left, key_view = jax.random.split(practice.key, 4)
        code = jax.random.normal(key_code, (self.options.size,))
        left, tick = jax.random.randint(key_left, (), 1, self.config.hold + 1), jnp.zeros((), jnp.int32)
        practice = practice.replace(
            code=code, direction=direction(self.model, practice.sector, code), left=left, tick=tick, key=key,
            view=jax.random.randint(key_view, (), 0, _sides(self.model)), way=jnp.zeros(2),
        )  # fmt: skip
        first = self._state(practice, practice.inner.obs)
        return practice.replace(first=first, obs=self._observe(practice, practice.inner.obs))

    def _observe(self, practice: PracticeState, obs: Float[Array, " I"]) -> Float[Array, " S"]:
        state = self._state(practice, obs)
        share = practice.tick.astype(jnp.float32) / self.options.length
        return jnp.concatenate([self.model.see(state, state), practice.code, share[None]])

    def _state(self, practice: PracticeState, obs: Float[Array, " I"]) -> Float[Array, " P"]:
        state = obs[: self.model.state_size]
        return self.model.views.obs(practice.view, state) if self.model.views else state

    def _judge(
        self, before: PracticeState, state: Float[Array, " P"], action: Float[Array, " A"]
    ) -> tuple[Array, dict[str, Array]]:
        """Return reward and metrics of the tick; `before` has the way up to its end."""
        config, first = self.config, self._state(before, before.inner.obs)
        velocity = self.frame.way(state, first) / self.dt
        along = velocity @ before.direction
        across = jnp.abs(velocity[0] * before.direction[1] - velocity[1] * before.direction[0])
        at = self.frame.heading.quaternion
        upright = 1 - 2 * (state[at + 1] ** 2 + state[at + 2] ** 2)
        model, length = self.model, self.options.length
        inputs = before.code, model.see(first, first), before.tick, length
        as_learnt = apply(model.networks.decoder, model.params["decoder"], *inputs, method="at")
        reward = config.upright * upright - config.control_cost * jnp.sum(action**2)
        reward -= 0.5 * config.kl_weight * jnp.sum(jnp.square(action - as_learnt))
        if config.reward == "direction":
            reward += jnp.minimum(along, config.speed) - 0.5 * across
        else:
            reward += jnp.where(before.tick + 1 >= length, length * information(model, before), 0.0)
        return reward, dict(zip(METRICS, (along, across, upright), strict=True))


def information(model: OptionModel, practice: PracticeState) -> Float[Array, ""]:
    """Return how much likelier the way of an option is by its own code than by others of the prior, in nats.

    The way is normal around P's prediction, with the standard deviation of all ways (eq. 8).
    """
    first, scale = model.see(practice.first, practice.first), model.change_scale
    way = (practice.way - scale.mean[-2:]) / scale.std[-2:]

    def log_likelihood(code: Float[Array, " D"]) -> Float[Array, ""]:
        return -0.5 * jnp.sum(jnp.square(model.predict(first, code)[-2:] - way))

    others = jax.random.normal(jax.random.key(1), (OTHERS, len(practice.code)))
    among = jax.nn.logsumexp(jax.vmap(log_likelihood)(others)) - jnp.log(float(OTHERS))
    return log_likelihood(practice.code) - among


class Sector(NamedTuple):
    """The ways that P predicts of codes from the mean state, as angles: their mean and standard deviation in rad."""

    middle: Array
    spread: Array


def sector_of(model: OptionModel) -> Sector:
    """Measure the sector over codes of the prior."""
    codes = jax.random.normal(jax.random.key(0), (SECTOR_CODES, model.networks.encoder.option_size))
    ways = jax.vmap(model.way)(codes)
    middle = jnp.arctan2(*jnp.mean(ways, axis=0)[::-1])
    return Sector(middle, jnp.std(jax.vmap(partial(angle_from, middle))(ways)))


def angle_from(middle: Float[Array, ""], way: Float[Array, " 2"]) -> Float[Array, ""]:
    """Return the angle of a way to the left of the middle."""
    c, s = jnp.cos(middle), jnp.sin(middle)
    return jnp.arctan2(c * way[1] - s * way[0], c * way[0] + s * way[1])


def direction(model: OptionModel, sector: Sector, code: Float[Array, " D"]) -> Float[Array, " 2"]:
    """Return where a code shall lead, seen from the heading; of length 1.

    Codes keep their order by P, and spread evenly over the part of the circle that one view has to cover: P, a mean,
    predicts ways that differ less than they do, and an ant that turns to where it goes sees them all ahead.
    """
    share = jax.scipy.stats.norm.cdf(angle_from(sector.middle, model.way(code)) / sector.spread)
    angle = sector.middle + jnp.pi / _sides(model) * (2.0 * share - 1.0)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def _sides(model: OptionModel) -> int:
    return len(model.views) if model.views else 1


def settings(config: PractiseConfig, options: OptionsConfig) -> PPOConfig:
    """Return the settings of PPO, whose actor has the hidden layers of D."""
    return dataclasses.replace(config.ppo, hidden_sizes=options.decoder_sizes)


def actor_of(decoder: Any, fresh: PolicyParams) -> PolicyParams:
    """Return fresh parameters of PPO whose actor is a closed-loop D without its end logit."""
    layers = dict(decoder["params"]["mlp"])
    last = f"Dense_{len(layers) - 1}"
    layers[last] = jax.tree.map(lambda x: x[..., :-1], layers[last])
    return fresh.replace(actor={"params": layers})


def decoder_of(actor: Any, decoder: Any) -> Any:
    """Return D with the layers of an actor, and its own end logit."""
    layers = dict(actor["params"])
    last, own = f"Dense_{len(layers) - 1}", decoder["params"]["mlp"]
    joined = jax.tree.map(lambda new, old: jnp.concatenate([new, old[..., -1:]], axis=-1), layers[last], own[last])
    return {"params": {"mlp": layers | {last: joined}}}


def refit(
    options: OptionsConfig, config: PractiseConfig, env: Env, model: OptionModel, key: Key[Array, ""]
) -> tuple[OptionModel, dict[str, Array]]:
    """Learn E, P and F further from what codes of the prior do now, drawn anew for every option; D stays.

    E learns the likelihood of the code of its actions, since it shall still tell which option an action sequence is.
    Returns the model and the losses of every step.
    """
    key_start, key_run, key_steps = jax.random.split(key, 3)
    env, executor = (
        AutoReset(env),
        make_executor(dataclasses.replace(options, termination="fixed", choose="code"), model),
    )
    begin = start(env, executor, REFIT_ENVS, key_start)
    ticks = REFIT_OPTIONS * options.length
    _, run = rollout(env, executor, lambda obs, noise: (noise, jnp.zeros(len(obs))), begin, key_run, ticks)
    own = refresh.own_options(run, model)

    def step(state: Any, key: Array) -> tuple[Any, dict[str, Array]]:
        which = jax.random.randint(key, (options.batch_size,), 0, own.windows.count)
        windows = gather(own.windows, which, own.duration[which], options.length)
        return descend(refit_loss, options, model, state, windows, own.code[which])

    learnt, losses = jax.lax.scan(
        step, refresh.init(options, model, key), jax.random.split(key_steps, config.refit_steps)
    )
    return model.replace(params=learnt.params), losses


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
