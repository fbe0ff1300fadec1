"""A plain PPO in PyTorch on EnvPool, as people write it; imports both."""

import itertools
from typing import Any

import envpool
import numpy as np
import torch
from torch import Tensor, nn
from torch.distributions import Normal

from taic_jax.config import PPOConfig


class EnvPoolPPO:
    """PPO on EnvPool, which has threads of its own; observations and rewards are not normalised, which costs less."""

    def __init__(self, name: str, config: PPOConfig, env_threads: int, threads: int):
        self.ticks, self._threads, self._config = config.num_envs * config.rollout_length, threads, config
        make: Any = envpool.make
        self._envs = make(name, env_type="gymnasium", num_envs=config.num_envs, num_threads=env_threads)
        (S,), (A,) = self._envs.observation_space.shape, self._envs.action_space.shape
        self._actor, self._critic = _mlp(S, config.hidden_sizes, A, 0.01), _mlp(S, config.hidden_sizes, 1, 1.0)
        self._log_std = nn.Parameter(torch.full((A,), config.log_std_init))
        self._params = [*self._actor.parameters(), *self._critic.parameters(), self._log_std]
        self.optimizer = torch.optim.Adam(self._params, lr=config.learning_rate, eps=1e-5)
        self.obs = self._envs.reset()[0]

    def __call__(self) -> None:
        """Train for one iteration."""
        torch.set_num_threads(self._threads)
        self._update(self._rollout())

    def close(self) -> None:
        """End the threads of its environments."""
        self._envs.close()

    def _policy(self, obs: Tensor) -> Normal:
        return Normal(self._actor(obs), self._log_std.exp())

    @torch.no_grad()
    def _rollout(self) -> list[Tensor]:
        """Return obs, actions, log-probabilities, advantages and targets of T B ticks."""
        columns: list[list[Tensor]] = [[] for _ in range(6)]
        for _ in range(self._config.rollout_length):
            obs = torch.as_tensor(self.obs, dtype=torch.float32)
            policy = self._policy(obs)
            action = policy.sample()
            clipped = np.clip(action.numpy().astype(np.float64), -1.0, 1.0)
            self.obs, reward, terminated, truncated, _ = self._envs.step(clipped)
            done = torch.as_tensor(terminated | truncated, dtype=torch.float32)
            tick = (obs, action, policy.log_prob(action).sum(1), self._critic(obs)[:, 0],
                    torch.as_tensor(reward, dtype=torch.float32), done)  # fmt: skip
            for values, value in zip(columns, tick, strict=True):
                values.append(value)
        obs, action, log_prob, value, reward, done = (torch.stack(values) for values in columns)
        next_value, total = self._critic(torch.as_tensor(self.obs, dtype=torch.float32))[:, 0], torch.zeros(())
        advantage = torch.zeros_like(reward)
        for t in reversed(range(len(reward))):
            alive = self._config.gamma * (1.0 - done[t])
            total = reward[t] + alive * next_value - value[t] + alive * self._config.lambda_ * total
            advantage[t], next_value = total, value[t]
        return [x.flatten(0, 1) for x in (obs, action, log_prob, advantage, advantage + value)]

    def _update(self, rows: list[Tensor]) -> None:
        """Pass over the ticks in epochs of minibatches."""
        config = self._config
        for _ in range(config.epochs):
            for which in torch.randperm(self.ticks).split(config.minibatch_size):
                obs, action, log_prob, advantage, target = (x[which] for x in rows)
                policy = self._policy(obs)
                ratio = (policy.log_prob(action).sum(1) - log_prob).exp()
                advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
                clipped = ratio.clamp(1.0 - config.clip, 1.0 + config.clip)
                value_loss = 0.5 * (self._critic(obs)[:, 0] - target).square().mean()
                loss = config.value_weight * value_loss - torch.min(ratio * advantage, clipped * advantage).mean()
                loss = loss - config.entropy_weight * policy.entropy().sum(1).mean()
                self.optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(self._params, config.max_grad_norm)
                self.optimizer.step()


def _mlp(size: int, hidden_sizes: tuple[int, ...], outputs: int, scale: float) -> nn.Sequential:
    layers, gains = [], [2**0.5] * len(hidden_sizes) + [scale]
    for (inputs, width), gain in zip(itertools.pairwise((size, *hidden_sizes, outputs)), gains, strict=True):
        layer = nn.Linear(inputs, width)
        nn.init.orthogonal_(layer.weight, gain)
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.Tanh()]
    return nn.Sequential(*layers[:-1])
