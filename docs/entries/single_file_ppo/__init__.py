"""An entry of EventPolicy-C in one file of PyTorch, in the manner of CleanRL: PPO on stacks of event images.

Run: python docs/entries/single_file_ppo/__init__.py, then
    evade bench docs/entries/single_file_ppo:policy bench.name=single_file_ppo
Expect: four minutes of training on an idle core; the weights lie beside this file.
"""

from functools import cache
from pathlib import Path

import gymnasium
import numpy as np
import torch
from torch import nn
from torch.distributions import Categorical

NAME = "envs.corridor:evade/Corridor-v0"
WORLD = {"scene": "poles", "observation": "event_image"}
WEIGHTS = Path(__file__).with_name("weights.pth")
STACK, STEPS, CORRIDORS, ROLLOUT = 3, 150_000, 16, 128
EPOCHS, MINIBATCH, LR, GAMMA, LAMBDA, CLIP, SCALE = 6, 256, 5e-4, 0.99, 0.95, 0.2, 0.05


class Network(nn.Module):
    """Logits of three actions and a value, from stacks of 64x64 pixels."""

    def __init__(self) -> None:
        """Make the layers with orthogonal weights."""
        super().__init__()
        layers = (nn.Conv2d(STACK, 16, 8, 4), nn.Conv2d(16, 32, 4, 2), nn.Linear(32 * 6 * 6, 128))
        self.actor, self.critic = nn.Linear(128, 3), nn.Linear(128, 1)
        gains = {**dict.fromkeys(layers, 2**0.5), self.actor: 0.01, self.critic: 1.0}
        for layer, gain in gains.items():
            nn.init.orthogonal_(layer.weight, gain)
            nn.init.zeros_(layer.bias)
        first, second, dense = layers
        self.body = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), nn.Flatten(), dense, nn.ReLU())

    def forward(self, stacks: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return logits (B, 3) and values (B,) of stacks uint8 (B, STACK, 64, 64)."""
        features = self.body(stacks.float() / 255.0)
        return self.actor(features), self.critic(features).squeeze(-1)


def pushed(stacks: torch.Tensor, images: np.ndarray, begins: torch.Tensor) -> torch.Tensor:
    """Return stacks with the newest image last; those of an episode that begins hold nothing else."""
    newest = torch.from_numpy(images[..., 0])[:, None]
    return torch.cat([stacks[:, 1:] * ~begins[:, None, None, None], newest], 1)


def train() -> None:
    """Train with seed 0, and write the weights."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    envs = gymnasium.make_vec(NAME, CORRIDORS, autoreset_mode="SameStep", **WORLD)
    network = Network()
    optimizer = torch.optim.Adam(network.parameters(), lr=LR, eps=1e-5)
    begins = torch.ones(CORRIDORS, dtype=torch.bool)
    stacks = pushed(torch.zeros(CORRIDORS, STACK, 64, 64, dtype=torch.uint8), envs.reset(seed=0)[0], begins)
    seen = torch.zeros(ROLLOUT, CORRIDORS, STACK, 64, 64, dtype=torch.uint8)
    actions, numbers = (
        torch.zeros(ROLLOUT, CORRIDORS, dtype=torch.long),
        torch.zeros(4, ROLLOUT + 1, CORRIDORS),
    )
    log_p, values, rewards, over = numbers  # over[k]: the step before k ended an episode
    rollouts = STEPS // (ROLLOUT * CORRIDORS)
    for rollout in range(rollouts):
        optimizer.param_groups[0]["lr"] = LR * (1.0 - rollout / rollouts)
        over[0] = 0.0
        with torch.no_grad():
            for k in range(ROLLOUT):
                logits, values[k] = network(stacks)
                chosen = Categorical(logits=logits)
                seen[k], actions[k] = stacks, chosen.sample()
                log_p[k] = chosen.log_prob(actions[k])
                images, reward, terminated, truncated, _ = envs.step(actions[k].numpy())
                begins = torch.from_numpy(terminated | truncated)
                rewards[k], over[k + 1] = SCALE * torch.from_numpy(reward), begins
                stacks = pushed(stacks, images, begins)
            values[ROLLOUT] = network(stacks)[1]
            advantages, ahead = torch.zeros(ROLLOUT, CORRIDORS), torch.zeros(CORRIDORS)
            for k in reversed(range(ROLLOUT)):
                goes_on = 1.0 - over[k + 1]
                error = rewards[k] + GAMMA * values[k + 1] * goes_on - values[k]
                ahead = advantages[k] = error + GAMMA * LAMBDA * goes_on * ahead
        rows = (
            seen.flatten(0, 1),
            actions.flatten(),
            log_p[:-1].flatten(),
            advantages.flatten(),
            values[:-1].flatten(),
        )
        learn(network, optimizer, *rows)
    envs.close()
    torch.save(network.state_dict(), WEIGHTS)


def learn(network, optimizer, stacks, actions, log_p, advantages, values) -> None:
    """Take the gradient steps of one rollout: the clipped objective of PPO, and the error of the value."""
    returns = advantages + values
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(actions)).split(MINIBATCH):
            logits, value = network(stacks[rows])
            chosen = Categorical(logits=logits)
            ratio, gain = (chosen.log_prob(actions[rows]) - log_p[rows]).exp(), advantages[rows]
            gain = (gain - gain.mean()) / (gain.std() + 1e-8)
            clipped = torch.minimum(ratio * gain, ratio.clamp(1.0 - CLIP, 1.0 + CLIP) * gain)
            loss = 0.5 * (value - returns[rows]).square().mean() - clipped.mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(network.parameters(), 0.5)
            optimizer.step()


@cache
def trained() -> Network:
    """Load the weights once in each process."""
    network = Network()
    network.load_state_dict(torch.load(WEIGHTS, weights_only=True))
    return network


def policy(seed):
    """Begin an episode; return a function from an event image, uint8 (64, 64, 1), to an action."""
    stack, begins = torch.zeros(1, STACK, 64, 64, dtype=torch.uint8), torch.zeros(1, dtype=torch.bool)

    @torch.inference_mode()
    def act(image):
        nonlocal stack
        stack = pushed(stack, image[None], begins)
        return trained()(stack)[0].argmax()

    return act


if __name__ == "__main__":
    train()
