"""Configuration of an experiment: frozen, typed and closed; one dataclass per stage.

Every `float` field is a leaf: it may be swept and vmapped without compiling again. Every other field is
static: it sets shapes or code paths. This module imports no JAX, so that the command line answers at once.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_type_hints

from taic_jax.config.base import (
    TINY,
    USUAL_BOUNDS,
    Bounds,
    ConfigError,
    Learner,
    Natural,
    Positive,
    Shard,
    Share,
    Track,
    impossible,
)
from taic_jax.config.learners import DQNConfig, FineTuneConfig, PPOConfig, PractiseConfig, ReplayConfig, SACConfig

__all__ = [
    "COLLECT", "CONFIG_CLASSES", "METHOD_LABELS", "PRACTISE", "TAIC", "TINY", "USUAL_BOUNDS", "Bounds",
    "CollectConfig", "Config", "ConfigError", "DQNConfig", "EnvConfig", "EvaluateConfig", "FineTuneConfig", "Learner",
    "Natural", "OptionsConfig", "PPOConfig", "Positive", "PractiseConfig", "ReplayConfig", "SACConfig", "Shard",
    "Share", "Track", "TrainConfig", "collector_is_baseline", "experience_ticks", "field_types", "impossible",
    "method_label", "needs_collect", "replace", "settings_of", "walk",
]  # fmt: skip


@dataclass(frozen=True)
class EnvConfig:
    """The environment and the engine that runs its physics."""

    name: str = "nav2d"
    """Environment: a task of this package, another's (gymnasium:ID, brax:NAME ...), FILE.py:CLASS or MODULE:CLASS."""
    backend: Literal["auto", "mujoco", "mjx", "warp"] = "auto"
    """Physics engine; auto takes mujoco (C, all cores) on CPU and mjx (JAX) elsewhere."""
    num_threads: Natural = 0
    """Threads of the mujoco backend; 0 takes the physical cores."""
    pipeline: str = "spring"
    """Physics pipeline of the brax:NAME environments."""
    model: Literal["brax", "gym"] = "brax"
    """MJCF and rules of half_cheetah, ant, hopper and walker2d: Brax's, or Gymnasium's own."""
    body: Literal["gym", "hiro"] = "gym"
    """Ant of ant, ant_headings and the arenas: Gym's, or HIRO's, which is weaker and acts half as often."""
    contacts: Literal["feet", "body"] = "feet"
    """Contacts of ant with the ground: those of its feet alone, or of its whole body, as in the arenas."""
    goal: Literal["fixed", "near", "uniform", "mixed"] = "fixed"
    """Goal of an arena: behind its obstacles; in ant_maze at the end of the first corridor; or drawn in each episode of
    training (uniform), or in half of them, and the start in half of them, too (mixed)."""
    change_after: Natural = 0
    """Episodes of each environment after which the room of nav2d changes; 0 for never."""


@dataclass(frozen=True)
class CollectConfig:
    """Stage collect: a flat policy, whose ticks in training become the experience."""

    env: str = ""
    """Environment to collect in; empty takes env.name."""
    ticks: int = 1_000_000
    """Budget of interactions per seed."""
    capacity: Natural = 0
    """Newest ticks of experience to keep, per seed; 0 keeps all."""
    learner: Learner = "ppo"
    """Learner of the flat policies, those of the baselines too: ppo or sac; with discrete actions ppo or dqn."""
    ppo: PPOConfig = PPOConfig()
    sac: SACConfig = SACConfig()
    dqn: DQNConfig = DQNConfig()


@dataclass(frozen=True)
class OptionsConfig:
    """Stage learn: the option model, networks E, D, P and F (sections 3.2 to 3.4)."""

    source: str = ""
    """Run or artifact whose option model is used (--options for short); empty learns one."""
    experience: tuple[str, ...] = ()
    """Sources to learn from: collect, folders of other runs, other people's data; empty takes collect."""
    observations: tuple[str, ...] = ()
    """Arrays of other people's data that are joined to observations; empty takes those usual in the format."""
    actions: str = ""
    """Array of the actions in such data; empty takes the usual one."""
    action_bounds: tuple[float, ...] = ()
    """Bounds of the actions in such data, which become -1 and 1: low and high, or one low an entry and then one high;
    empty if they are -1 and 1."""
    length: int = 5
    """Ticks of a window and of an option under termination fixed; otherwise the greatest number."""
    size: int = 6
    """Dimensions of the option code o."""
    hidden_size: int = 64
    """Units of the LSTMs of E and D."""
    mlp_sizes: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of P and F."""
    decoder: Literal["open", "closed"] = "open"
    """D in open loop, an LSTM that never looks at the state (the paper's), or in closed loop, pi(a|o,s)."""
    decoder_sizes: tuple[int, ...] = (128, 128)
    """Widths of the hidden layers of a closed-loop D."""
    squash: bool = False
    """Bound the actions of a closed-loop D by tanh, as SAC does; practice needs it."""
    termination: Literal["fixed", "output", "predict"] = "fixed"
    """End of an option: after length ticks, at D's end signal, or when P is surprised (section 3.4)."""
    shortest: int = 1
    """Fewest ticks of the windows that termination output learns from."""
    end_signal: Literal["sampled", "threshold"] = "sampled"
    """Meaning of D's end signal under termination output: a probability, or yes above one half."""
    delta: Positive = 0.5
    """Threshold on P's error at which termination predict ends an option (Algorithm 1)."""
    delta_unit: Literal["error", "quantile"] = "quantile"
    """Unit of delta: P's error itself, or the share of held-out predictions whose error is smaller."""
    steps: Natural = 2000
    """Gradient steps; 0 leaves the option model random."""
    batch_size: int = 128
    """Windows per gradient step."""
    learning_rate: float = 3e-3
    """Step size of Adam for E, D and P."""
    learning_rate_estimator: float = 1e-3
    """Step size of Adam for the state estimator F."""
    lambda_kl: float = 0.01
    """Weight of L_KL, which keeps the codes near a standard normal."""
    lambda_adv: float = 0.1
    """Weight of L_adv, which hides the state from the code."""
    lambda_pred: float = 1.0
    """Weight of L_pred, which makes the code's effect predictable."""
    lambda_end: float = 0.1
    """Weight of the end signal's cross-entropy under termination output."""
    max_grad_norm: Positive = 1.0
    """Global norm at which gradients are clipped."""
    since: Share = 0.0
    """Share of the experience before the first window."""
    until: Share = 1.0
    """Share of the experience before the last window."""
    parts: int = 1
    """Equal parts of that span; select takes its share of each: 3 mixes early, middle and late."""
    select: Literal["random", "top"] = "top"
    """Windows to learn from: all of these, or those with the greatest reward."""
    fraction: Annotated[float, Bounds(TINY, 1)] = 0.5
    """Share of the windows that select top takes."""
    views: Literal["one", "all"] = "one"
    """Views of a window: the recorded one, or those of all the body's equal sides: the ant has four."""
    frame: Literal["world", "heading"] = "world"
    """Axes in which E, D, P and F see a body that can face anywhere: the world's, or those of its heading at the
    option's first tick."""
    choose: Literal["code", "way"] = "code"
    """Entries by which a policy chooses an option: its code, or the way that it shall lead in the world's axes; then
    the code and the side of the body as front are those of which P predicts that they lead farthest along it."""
    way_weight: Natural = 0
    """Entries of the state for which each of the two of the way counts in L_pred: where the body went, as a part of
    the state change; 0 leaves the way out."""
    state_noise: float = 0.0
    """Standard deviation of noise on the state that a closed-loop D learns from, so that it depends on the code; the
    unit is each entry's own standard deviation."""
    codes: Natural = 0
    """Options of a code book, the centres of the codes of windows, for a policy over discrete options; 0 for codes
    of any value."""
    sample_actions: bool = False
    """Draw discrete actions by the probabilities that D gives them; otherwise take the most probable."""
    refresh_every: Natural = 0
    """Iterations of stage train after which E, D, P and F are learnt further from the policy's own options; 0 never."""
    refresh_steps: int = 100
    """Gradient steps of a refresh."""
    refresh_weight: float = 1.0
    """Weight of the mean squared change that a refresh makes to D's actions, for the codes in use."""


@dataclass(frozen=True)
class TrainConfig:
    """Stage train: the policy that acts by choosing options (section 3.5)."""

    ticks: int = 1_000_000
    """Budget of interactions per seed."""
    baselines: tuple[Literal["flat", "repeat", "total", "transfer"], ...] = ("flat",)
    """Flat PPO beside it: on the task alone; with each action held for options.length ticks; with the ticks of collect
    as well; or from the flat policy of the run that options.source names."""
    init: str = ""
    """Run whose policy over options is trained further, with its options (--init for short); empty for a new policy."""
    learner: Learner = "ppo"
    """Learner of the policy over options: ppo or sac; with options.codes ppo or dqn."""
    ppo: PPOConfig = PPOConfig(log_std_init=0.0)
    sac: SACConfig = SACConfig()
    dqn: DQNConfig = DQNConfig()
    fine_tune: FineTuneConfig = FineTuneConfig()


@dataclass(frozen=True)
class EvaluateConfig:
    """Stage evaluate: the trained policies, with and without exploration."""

    episodes: int = 10
    """Episodes per seed."""
    video_ticks: Natural = 200
    """Ticks in the video; 0 makes none."""


@dataclass(frozen=True)
class Config:
    """One experiment: a run is a pure function of its config and a key."""

    env: EnvConfig = EnvConfig()
    collect: CollectConfig = CollectConfig()
    options: OptionsConfig = OptionsConfig()
    practise: PractiseConfig = PractiseConfig()
    train: TrainConfig = TrainConfig()
    evaluate: EvaluateConfig = EvaluateConfig()
    seed: Annotated[int, Bounds(0, 2**31 - 1)] = 0
    """Seed of the PRNG key, the source of all randomness."""
    seeds: int = 1
    """Independent repeats, trained side by side in one program."""


CONFIG_CLASSES = (
    EnvConfig, PPOConfig, ReplayConfig, SACConfig, DQNConfig, CollectConfig, OptionsConfig, PractiseConfig,
    FineTuneConfig, TrainConfig, EvaluateConfig, Config,
)  # fmt: skip

COLLECT, PRACTISE = "collect", "practise"
"""Stages by name; that of this run's own experience also in `options.experience`."""

TAIC = "taic"
METHOD_LABELS = {
    TAIC: "options (TAIC)",
    "flat": "flat PPO",
    "repeat": "flat PPO, held actions",
    "total": "flat PPO, ticks of both stages",
    "transfer": "flat PPO from the source's policy",
}
"""The methods of a summary in words: options, and the flat baselines by their names in `train.baselines`."""


def method_label(method: str, learner: str) -> str:
    """Return a method in words, with the flat learner's name."""
    return METHOD_LABELS.get(method, method).replace("PPO", learner.upper())


def settings_of(group: CollectConfig | PractiseConfig | TrainConfig) -> PPOConfig | SACConfig | DQNConfig:
    """Return the settings of the group's learner."""
    if isinstance(group, PractiseConfig):
        return group.sac
    return {"ppo": group.ppo, "sac": group.sac, "dqn": group.dqn}[group.learner]


def experience_ticks(config: CollectConfig) -> int:
    """Return the ticks of experience that stage collect leaves per seed, up to the rest of an iteration."""
    return min(config.capacity or config.ticks, config.ticks)


def needs_collect(config: Config) -> bool:
    """Return whether another stage, or a baseline, uses the results of stage collect."""
    learns = not config.options.source and (not config.options.experience or COLLECT in config.options.experience)
    return learns or ("flat" in config.train.baselines and collector_is_baseline(config))


def collector_is_baseline(config: Config) -> bool:
    """Return whether flat PPO of stage collect is the flat baseline too: on the same task for as many ticks."""
    return config.collect.env in ("", config.env.name) and config.collect.ticks == config.train.ticks


def walk(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield `(dotted name, value)` of every field that is not itself a group of fields."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from walk(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value


def field_types(group: Any = Config, prefix: str = "", *, bounds: bool = False) -> dict[str, Any]:
    """Return the types of these fields by dotted name, Annotated by their `Bounds` on request."""
    types = {}
    for name, kind in get_type_hints(group, include_extras=bounds).items():
        is_group = dataclasses.is_dataclass(kind)
        types |= field_types(kind, f"{prefix}{name}.", bounds=bounds) if is_group else {prefix + name: kind}
    return types


def replace(config: Any, name: str, value: Any) -> Any:
    """Return the config with another value in the field of this dotted name."""
    first, _, rest = name.partition(".")
    return dataclasses.replace(config, **{first: replace(getattr(config, first), rest, value) if rest else value})
