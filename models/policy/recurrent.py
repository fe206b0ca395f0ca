"""A gated recurrent unit (GRU, Cho et al. 2014) that policy and value share, trained on sequences.

    r, z = sigmoid(W x + U h),   n = tanh(W x + r * U h),   h <- n + z (h - n)

The state h is zero at the start of each episode. A sequence is computed step by step, in the order in which
a policy acts, so its logits equal the logits of single steps, apart from the order of sums in a batch.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from models.encoder.products import Linear
from models.kinds import PolicySpec
from models.policy.networks import Network, Run


class GatedUnit(nn.Module):
    """One GRU over the stacks of an episode's steps, flattened."""

    def __init__(self, inputs: int, units: int) -> None:
        """Build the unit for `inputs` inputs and a state of `units` numbers."""
        super().__init__()
        self.units = units
        self.inward = Linear(inputs, 3 * units)
        self.inner = Linear(units, 3 * units)

    def forward(self, stacks: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Compute the states after each step.

        Args:
            stacks: float32 (B, T, depth, ...), T successive steps of B episodes.
            state: float32 (B, units), before the first step.

        Returns:
            States after each step (B, T, units), and after the last (B, units).
        """
        states = []
        for given in self.inward(stacks.flatten(2)).unbind(1):
            reset, update, new = given.split(self.units, 1)
            own_reset, own_update, own_new = self.inner(state).split(self.units, 1)
            news = torch.tanh(new + torch.sigmoid(reset + own_reset) * own_new)
            state = news + torch.sigmoid(update + own_update) * (state - news)
            states.append(state)
        return torch.stack(states, 1), state


def gru(shape: Sequence[int], spec: PolicySpec) -> tuple[nn.Module, ...]:
    """Build a GRU over the stack, and a linear layer each for policy and value."""
    units = state_size(spec)
    return GatedUnit(math.prod(shape), units), Linear(units, spec.num_actions), Linear(units, 1)


def state_size(spec: PolicySpec) -> int:
    """Return the size of the state."""
    return int(spec.model.units)  # type: ignore[attr-defined]


def by_steps(trunk: nn.Module, pi: nn.Module) -> Run:
    """Return a function that runs a recurrent network for one step of each episode."""

    def run(stacks: np.ndarray, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        with torch.inference_mode():
            _, after = trunk(torch.from_numpy(stacks)[:, None], torch.from_numpy(state))
            return pi(after).numpy(), after.numpy()

    return run


GRU = Network(gru, by_steps, state=state_size)
