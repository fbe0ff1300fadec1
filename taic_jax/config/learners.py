"""The configuration of the learners: of a policy over options or actions, and of D's practice and fine-tuning."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from taic_jax.config.base import Bounds, LogStd, Natural, Positive, Share


@dataclass(frozen=True)
class PPOConfig:
    """Proximal policy optimisation over decisions, with semi-Markov advantages (eq. 11-13)."""

    num_envs: int = 16
    """Environments that run side by side."""
    rollout_length: int = 512
    """Ticks per environment between two updates."""
    epochs: int = 10
    """Passes over the decisions of one rollout."""
    minibatch_size: int = 128
    """Decisions per gradient step."""
    hidden_sizes: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of actor and critic."""
    learning_rate: float = 3e-4
    """Step size of Adam."""
    learning_rate_decay: bool = True
    """Let the step size fall linearly to zero over the stage."""
    gamma: Share = 0.99
    """Discount per tick."""
    lambda_: Share = 0.95
    """Decay of the advantage estimate per decision."""
    clip: Positive = 0.2
    """Half-width of the interval that clips the probability ratio."""
    value_weight: float = 0.5
    """Weight of the critic's loss."""
    entropy_weight: float = 0.0
    """Weight of the entropy bonus."""
    prior_weight: float = 0.0
    """Weight of the KL divergence of the policy from N(0, I), or of discrete options from the uniform one."""
    max_grad_norm: Positive = 0.5
    """Global norm at which gradients are clipped."""
    log_std_init: LogStd = -0.916
    """Initial log standard deviation of the policy; exp(-0.916) = 0.4."""
    reset_at_change: bool = False
    """Set it to log_std_reset as soon as the task has changed (env.change_after) in half of the environments."""
    log_std_reset: LogStd = 0.0
    """Log standard deviation of the policy after that reset."""
    normalize_advantage: bool = True
    """Standardise the advantages of each minibatch."""
    normalize_reward: bool = True
    """Divide rewards by the running standard deviation of the return."""


@dataclass(frozen=True)
class ReplayConfig:
    """Learning from a replay buffer of decisions, with semi-Markov targets."""

    num_envs: int = 16
    """Environments that run side by side."""
    rollout_length: int = 128
    """Ticks per environment between two log lines."""
    update_every: int = 4
    """Ticks per environment between two updates."""
    updates_per_decision: float = 1.0
    """Gradient steps for each decision that ended."""
    warmup: Natural = 10_000
    """Ticks of uniformly random options, without updates, before the first one."""
    capacity: int = 1_000_000
    """Newest decisions to keep, per seed."""
    batch_size: int = 256
    """Decisions per gradient step."""
    hidden_sizes: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers of actor and critics."""
    layer_norm: bool = True
    """Normalise the layers of the critics."""
    relabel: Natural = 0
    """Transitions with another goal for each one with its own, where the task has goals: one that is achieved later in
    the episode (hindsight)."""
    horizon: int = 50
    """Most decisions between a transition and the later one whose achievement becomes its goal."""
    learning_rate: float = 3e-4
    """Step size of Adam."""
    learning_rate_decay: bool = False
    """Let the step size fall linearly to zero over the stage."""
    gamma: Share = 0.99
    """Discount per tick."""
    reward_scale: Positive = 1.0
    """Factor of rewards in targets: the critics' step size limits how fast values of thousands are learnt."""
    tau: Share = 0.005
    """Share of the critics that their targets take over at each gradient step."""


@dataclass(frozen=True)
class SACConfig(ReplayConfig):
    """Soft actor-critic over decisions, with twin critics."""

    bound: Positive = 3.0
    """Greatest entry of an option code; an action's is 1."""
    temperature: Positive = 1.0
    """Initial temperature, the weight of the entropy, which is learnt."""
    target_entropy: Annotated[float, Bounds(-math.inf)] = -1.0
    """Entropy of the policy that the temperature is learnt for, per dimension, of options in units of their bound."""
    pessimism: Share = 1.0
    """The lower of both critics' values counts at 1, their mean at 0: over a long discount the gap adds up."""
    prior_weight: float = 0.0
    """Weight of the KL divergence of the policy from N(0, I), in place of temperature and entropy; 0 for these."""


@dataclass(frozen=True)
class DQNConfig(ReplayConfig):
    """Double DQN over decisions of discrete options or actions."""

    epsilon: Share = 0.05
    """Share of random options at the end of the fall."""
    epsilon_steps: Positive = 10_000.0
    """Gradient steps over which the share of random options falls from 1."""


@dataclass(frozen=True)
class FineTuneConfig:
    """Fine-tuning of D by PPO on its actions, in turns with the policy over options; off unless epochs is set."""

    epochs: Natural = 0
    """Passes over the ticks of each iteration that update D; 0 leaves D unchanged."""
    minibatch_size: int = 512
    """Ticks per gradient step of D."""
    learning_rate: float = 5e-4
    """Step size of Adam for D; it decays like the policy's."""
    std: Positive = 0.2
    """Standard deviation of the noise on D's actions while training."""
    kl_weight: float = 0.0
    """Weight of the KL divergence from the learnt D."""


@dataclass(frozen=True)
class PractiseConfig:
    """Stage practise: D of a body with a heading learns by acting to go where codes say; off unless it has ticks."""

    ticks: Natural = 0
    """Budget of interactions per seed; 0 leaves D as learnt."""
    hold: int = 6
    """Most options for which a code from the prior is held."""
    reward: Literal["direction", "information"] = "direction"
    """Reward: the speed in a code's direction; or the mutual information of code and way (eq. 8)."""
    speed: Positive = 2.0
    """Speed in m/s in a code's direction beyond which more earns nothing: fast ants fall."""
    control_cost: float = 0.1
    """Weight of |action|^2 in the reward."""
    kl_weight: float = 0.0
    """Weight of half the squared change of D's actions since it was learnt: a KL divergence under noise of 1."""
    upright: float = 1.0
    """Weight in the reward of the upward part of the torso's own axis; half of it at first, all from half-time on."""
    refit_steps: int = 1000
    """Gradient steps at the end that refit E, P and F to D."""
    # Hidden layers are those of D.
    sac: SACConfig = SACConfig(
        warmup=0, update_every=8, updates_per_decision=0.5, batch_size=64, learning_rate=1e-3, temperature=0.1,
        target_entropy=-0.5, learning_rate_decay=True,
    )  # fmt: skip
