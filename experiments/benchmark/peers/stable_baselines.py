"""Stable-Baselines3's PPO on Gymnasium's environments; imports both, and PyTorch."""

import time
from collections.abc import Iterator
from typing import Any

import gymnasium
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from taic_jax.config import PPOConfig

# PPO's settings of RL Baselines3 Zoo that are not the library's own, and the widths of its networks.
_TUNED: dict[str, Any] = {
    "policy_kwargs": {
        "log_std_init": -2.0, "ortho_init": False, "activation_fn": torch.nn.ReLU,
        "net_arch": {"pi": [256, 256], "vf": [256, 256]},
    }
}  # fmt: skip
ZOO: dict[str, dict[str, Any]] = {
    "half_cheetah": _TUNED | {
        "batch_size": 64, "n_steps": 512, "gamma": 0.98, "learning_rate": 2.0633e-5, "ent_coef": 0.000401762,
        "clip_range": 0.1, "n_epochs": 20, "gae_lambda": 0.92, "max_grad_norm": 0.8, "vf_coef": 0.58096,
    },
    "hopper": _TUNED | {
        "batch_size": 32, "n_steps": 512, "gamma": 0.999, "learning_rate": 9.80828e-5, "ent_coef": 0.00229519,
        "clip_range": 0.2, "n_epochs": 5, "gae_lambda": 0.99, "max_grad_norm": 0.7, "vf_coef": 0.835671,
    },
    "walker2d": {
        "batch_size": 32, "n_steps": 512, "gamma": 0.99, "learning_rate": 5.05041e-5, "ent_coef": 0.000585045,
        "clip_range": 0.1, "n_epochs": 20, "gae_lambda": 0.95, "max_grad_norm": 1.0, "vf_coef": 0.871923,
    },
    "ant": {},
}  # fmt: skip


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


def climb(
    task: str, name: str, options: dict[str, Any], seed: int, *, ticks: int, every: int, episodes: int
) -> Iterator[tuple[int, float, float]]:
    """Train PPO with the zoo's settings, on normalised observations and rewards.

    Yield the ticks so far, the return of mean actions, and the seconds of evaluation so far, after each `every` ticks.
    """
    torch.set_num_threads(1)  # in the table of `throughput` one is the faster
    settings, spent = ZOO[task], 0.0
    trained = VecNormalize(DummyVecEnv([lambda: gymnasium.make(name, **options)]), gamma=settings.get("gamma", 0.99))
    tested = gymnasium.make(name, **options)
    model = PPO("MlpPolicy", trained, seed=seed, device="cpu", **settings)

    def score(episode: int) -> float:
        obs, total, ended = tested.reset(seed=episode)[0], 0.0, False
        while not ended:
            action = model.predict(trained.normalize_obs(obs), deterministic=True)[0]
            obs, reward, terminated, truncated, _ = tested.step(action)
            total, ended = total + float(reward), terminated or truncated
        return total

    while model.num_timesteps < ticks:
        model.learn(every, reset_num_timesteps=False)
        begun = time.perf_counter()
        returned = sum(map(score, range(episodes))) / episodes
        spent += time.perf_counter() - begun
        yield model.num_timesteps, returned, spent
