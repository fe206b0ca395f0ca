"""A small network over a set of events, trained end to end: the rival of a frozen encoder.

In the spirit of FLEET (Gottwald et al.): Fourier features of a pixel's place, time as a gate on
what an event says, and pooling over the set. A window is thinned to at most `EVENTS` events,
evenly over their order in time; of fewer, the rest of the rows is empty.
"""

import math
from collections.abc import Sequence

import numba
import numpy as np
import torch
from torch import Tensor, nn

EVENTS = 256  # of a window that the network sees
TIMES = 1024  # steps into which a window's time is rounded
OCTAVES = 5  # of the Fourier features: waves of 2 images down to 1/8 of one
WIDTH = 64  # features of an event
OUTPUTS = 128  # of the trunk
EMPTY, FIRST_OFF = 0, 2  # rows: [1 + p > 0, t, x, y]; the first number 0: no event


@numba.njit(cache=True, error_model="numpy")
def thinned(address: np.ndarray, width: int, height: int) -> np.ndarray:
    """At most `EVENTS` events of a window, int16 (EVENTS, 4): [kind, time, x, y] each.

    Args:
        address: int32 (2, N) of `models.batch`, with `TIMES` time bins, in time order.
        width: Pixels.
        height: Pixels.

    Returns:
        kind is 1 for ON, 2 for OFF, 0 for no event; time is the bin. Of N > EVENTS events the
        one in the middle of each of EVENTS equal parts is kept.
    """
    rows = np.zeros((EVENTS, 4), np.int16)
    count = address.shape[1]
    kept = min(count, EVENTS)
    for k in range(kept):
        n = ((2 * k + 1) * count) // (2 * kept)
        code = address[0, n]
        rows[k, 0] = 1 if code >= width * height else FIRST_OFF
        rows[k, 1] = address[1, n]
        rows[k, 2], rows[k, 3] = code % width, code // width % height
    return rows


class EventSet(nn.Module):
    """Features of sets of events: float32 (B, OUTPUTS) of stacks int16 (B, stack, EVENTS, 4)."""

    def __init__(self, stack: int, size: Sequence[int]) -> None:
        """Make it for stacks of `stack` windows of a sensor of `size` (width, height) pixels."""
        super().__init__()
        self.scales = [2.0 / max(side - 1, 1) for side in size]
        self.place = nn.Sequential(
            nn.Linear(4 * OCTAVES + 3, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU()
        )
        self.gate = nn.Sequential(nn.Linear(1, WIDTH), nn.Sigmoid())
        self.join = nn.Sequential(nn.Linear(stack * (2 * WIDTH + 1), OUTPUTS), nn.ReLU())

    def forward(self, stacks: Tensor) -> Tensor:
        """Each event's features times its gate; maximum, mean and number over each window."""
        kind, time = stacks[..., :1], stacks[..., 1:2].float() / TIMES
        place = [stacks[..., axis + 2].float() * scale - 1.0 for axis, scale in enumerate(self.scales)]
        waves = [math.pi * 2.0 ** (octave - 1) for octave in range(OCTAVES)]
        phases = torch.stack([wave * along for along in place for wave in waves], -1)
        on = (kind == 1).float() - (kind == FIRST_OFF).float()
        there = (kind != EMPTY).float()
        inputs = torch.cat([torch.stack(place, -1), on, phases.sin(), phases.cos()], dim=-1)
        features = self.place(inputs) * self.gate(time) * there
        number = there.sum(-2)
        mean = features.sum(-2) / number.clamp_min(1.0)
        pooled = torch.cat([features.amax(-2), mean, number / EVENTS], dim=-1)
        return self.join(pooled.flatten(1))
