"""Practice: D is refined by acting on open ground, so that a code leads where it says from every start.

Codes from the prior are held for one or more options each. D is the mean of the actor of flat SAC: its input is the
observation of the task `Practising`. A code says where it leads by P, as learnt before: the way that P predicts from
the mean state.
"""

import dataclasses
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct
from jaxtyping import Array, Float, Key

from taic_jax.config import OptionsConfig, PractiseConfig, SACConfig
from taic_jax.envs.base import Env, State
from taic_jax.envs.orientation import upright
from taic_jax.envs.wrappers import AutoReset, Wrapper
from taic_jax.networks import SquashedParams, apply
from taic_jax.options.model import OptionModel

STD = 0.3  # of the actor's noise before it is squashed, at the start of practice
METRICS = ("speed_along", "speed_across", "upright")
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
    age: Array  # [] int32, ticks since practice began
    key: Array


class Practising(Wrapper):
    """A task whose observation is D's input: the state that D sees, a code from the prior, and the share of its ticks.

    The reward of a tick is the upward part of the body's own axis, weighed half at first and in full from half of
    practice on, less the costs of control and of change; and the speed in m/s in the code's direction, up to `speed`,
    less half the speed across it, or at an option's end the information. Directions are seen from the heading in which
    the option began. Episodes end as those of the inner task, which resets itself: what resets a batch under `vmap`
    may not read a model of its own in each row.
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
        zero, nothing, still = jnp.zeros((), jnp.int32), jnp.zeros(self.options.size), jnp.zeros(2)
        inner = self.env.reset(key_inner)
        obs, sector = jnp.zeros(self.observation_size), sector_of(self.model)
        first = inner.obs[: self.model.state_size]
        start = PracticeState(inner, obs, nothing, still, first, still, sector, zero, zero, zero, zero, key)
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
            age=before.age + 1,
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
            view=jax.random.randint(key_view, (), 0, self.model.sides), way=jnp.zeros(2),
        )  # fmt: skip
        practice = practice.replace(first=self._state(practice, practice.inner.obs))
        return practice.replace(obs=self._observe(practice, practice.inner.obs))

    def _observe(self, practice: PracticeState, obs: Float[Array, " I"]) -> Float[Array, " S"]:
        state = self._state(practice, obs)
        share = practice.tick.astype(jnp.float32) / self.options.length
        return jnp.concatenate([self.model.see(state, practice.first), practice.code, share[None]])

    def _state(self, practice: PracticeState, obs: Float[Array, " I"]) -> Float[Array, " P"]:
        state = obs[: self.model.state_size]
        return self.model.views.obs(practice.view, state) if self.model.views else state

    def _judge(
        self, before: PracticeState, state: Float[Array, " P"], action: Float[Array, " A"]
    ) -> tuple[Array, dict[str, Array]]:
        """Return reward and metrics of the tick; `before` has the way up to its end."""
        config, model, length, first = self.config, self.model, self.options.length, before.first
        velocity = self.frame.way(state, first) / self.dt
        along = velocity @ before.direction
        across = jnp.abs(velocity[0] * before.direction[1] - velocity[1] * before.direction[0])
        at = self.frame.heading.quaternion
        level = upright(state[at : at + 4])
        inputs = before.code, model.see(self._state(before, before.inner.obs), first), before.tick, length
        as_learnt = apply(model.networks.decoder, model.params["decoder"], *inputs, method="at")
        grown = jnp.minimum(1.0, 0.5 + before.age.astype(jnp.float32) * config.sac.num_envs / config.ticks)
        reward = config.upright * grown * level - config.control_cost * jnp.sum(action**2)
        reward -= 0.5 * config.kl_weight * jnp.sum(jnp.square(action - as_learnt))
        if config.reward == "direction":
            reward += jnp.minimum(along, config.speed) - 0.5 * across
        else:
            reward += jnp.where(before.tick + 1 >= length, length * information(model, before), 0.0)
        return reward, dict(zip(METRICS, (along, across, level), strict=True))


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
    ways = jax.vmap(partial(model.way, jnp.zeros(model.state_size)))(codes)
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
    way = model.way(jnp.zeros(model.state_size), code)
    share = jax.scipy.stats.norm.cdf(angle_from(sector.middle, way) / sector.spread)
    angle = sector.middle + jnp.pi / model.sides * (2.0 * share - 1.0)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


def settings(config: PractiseConfig, options: OptionsConfig) -> SACConfig:
    """Return the settings of SAC, whose actor has the hidden layers of D."""
    return dataclasses.replace(config.sac, hidden_sizes=options.decoder_sizes)


def actor_of(decoder: Any, fresh: SquashedParams) -> SquashedParams:
    """Return an actor whose mean is a squashed D, and whose deviation is `STD` everywhere."""
    layers, last = _layers(decoder["params"]["mlp"])
    means = jax.tree.map(lambda x: x[..., :-1], layers[last])
    stds = {"kernel": jnp.zeros_like(means["kernel"]), "bias": jnp.full_like(means["bias"], jnp.log(STD))}
    layers[last] = jax.tree.map(lambda *x: jnp.concatenate(x, axis=-1), means, stds)
    return fresh.replace(actor={"params": layers})


def decoder_of(actor: Any, decoder: Any) -> Any:
    """Return D with the layers of an actor's mean, and its own end logit."""
    layers, last = _layers(actor["params"])
    means = jax.tree.map(lambda x: jnp.split(x, 2, axis=-1)[0], layers[last])
    own = decoder["params"]["mlp"][last]
    layers[last] = jax.tree.map(lambda mean, old: jnp.concatenate([mean, old[..., -1:]], axis=-1), means, own)
    return {"params": {"mlp": layers}}


def _layers(params: Any) -> tuple[dict, str]:
    """Return a copy of the layers of an MLP, and the name of the last."""
    return dict(params), f"Dense_{len(params) - 1}"
