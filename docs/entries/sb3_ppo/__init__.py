"""An entry of EventPolicy-C by Stable-Baselines3: PPO on stacks of three event images.

Run: python docs/entries/sb3_ppo/__init__.py, then
    evade bench docs/entries/sb3_ppo:policy bench.name=sb3_ppo
Expect: four minutes of training on an idle core; the weights lie beside this file.
"""

from collections import deque
from functools import cache
from pathlib import Path

import numpy as np
import torch
from gymnasium.spaces import Box, Discrete, Space
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.policies import ActorCriticCnnPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize
from torch import nn

NAME = "envs.corridor:evade/Corridor-v0"
WORLD = {"scene": "poles", "observation": "event_image"}
WEIGHTS = Path(__file__).with_name("weights.pth")
STACK, STEPS, CORRIDORS, ROLLOUT = 3, 150_000, 16, 128


class SmallCnn(BaseFeaturesExtractor):
    """Two convolutions and a dense layer: a quarter of the work of Stable-Baselines3's NatureCNN."""

    def __init__(self, observation_space: Space, features_dim: int = 128) -> None:
        """Make the layers for stacks of 64x64 pixels, channels first."""
        super().__init__(observation_space, features_dim)
        channels = observation_space.shape[0]
        self.layers = nn.Sequential(
            *(nn.Conv2d(channels, 16, 8, 4), nn.ReLU(), nn.Conv2d(16, 32, 4, 2), nn.ReLU()),
            *(nn.Flatten(), nn.Linear(32 * 6 * 6, features_dim), nn.ReLU()),
        )

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Return features (B, features_dim) of images in 0..1 (B, C, 64, 64)."""
        return self.layers(images)


def train() -> None:
    """Train with seed 0, and write the weights."""
    torch.set_num_threads(1)
    corridors = make_vec_env(NAME, CORRIDORS, seed=0, env_kwargs=WORLD)
    stacked = VecNormalize(VecFrameStack(corridors, STACK), norm_obs=False)
    model = PPO(
        "CnnPolicy",
        stacked,
        learning_rate=lambda remaining: 5e-4 * remaining,
        n_steps=ROLLOUT,
        batch_size=256,
        n_epochs=6,
        policy_kwargs={"features_extractor_class": SmallCnn},
        seed=0,
        verbose=1,
        device="cpu",
    )
    model.learn(STEPS, log_interval=10)
    torch.save(model.policy.state_dict(), WEIGHTS)


@cache
def trained() -> ActorCriticCnnPolicy:
    """Load the weights once in each process."""
    images, actions = Box(0, 255, (STACK, 64, 64), np.uint8), Discrete(3)
    loaded = ActorCriticCnnPolicy(images, actions, lambda _: 0.0, features_extractor_class=SmallCnn)
    loaded.load_state_dict(torch.load(WEIGHTS, weights_only=True))
    return loaded


def policy(seed):
    """Begin an episode; return a function from an event image, uint8 (64, 64, 1), to an action."""
    images = deque([np.zeros((64, 64, 1), np.uint8)] * STACK, STACK)

    def act(image):
        images.append(image)
        return trained().predict(np.concatenate(images, axis=-1), deterministic=True)[0]

    return act


if __name__ == "__main__":
    train()
