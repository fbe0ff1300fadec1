"""Stable-Baselines3's PPO on Gymnasium's environments; imports both, and PyTorch."""

from typing import Any

import gymnasium
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from taic_jax.config import PPOConfig


class StableBaselines:
    """PPO of Stable-Baselines3; observations and rewards are not normalised, which costs less.

    The environment's name and options are those of `gymnasium.make`, the threads PyTorch's.
    """

    def __init__(self, name: str, options: dict[str, Any], config: PPOConfig, threads: int):
        self.ticks, self._threads = config.num_envs * config.rollout_length, threads
        self._envs = DummyVecEnv([lambda: gymnasium.make(name, **options)] * config.num_envs)
        sizes = list(config.hidden_sizes)
        self.model = PPO(
            "MlpPolicy", self._envs, learning_rate=config.learning_rate, n_steps=config.rollout_length,
            batch_size=config.minibatch_size, n_epochs=config.epochs, gamma=config.gamma, gae_lambda=config.lambda_,
            clip_range=config.clip, ent_coef=config.entropy_weight, vf_coef=config.value_weight,
            max_grad_norm=config.max_grad_norm, device="cpu",
            policy_kwargs={"net_arch": {"pi": sizes, "vf": sizes}, "activation_fn": torch.nn.Tanh},
        )  # fmt: skip

    def __call__(self) -> None:
        """Train for one iteration."""
        torch.set_num_threads(self._threads)
        self.model.learn(self.ticks, reset_num_timesteps=False)

    def close(self) -> None:
        """End the processes of its environments."""
        self._envs.close()
