"""Advantages and shaped rewards of episodes, and the sequences that a recurrent network learns from."""

import numpy as np
import torch
from torch import Tensor

STARTS = "step_of_piece"  # column: number of a step in its piece of an episode, int64
FIRST_ROW = "first_row"  # of sequences (C, L, ...): row of each sequence's first step, int64 (C,)
TAKEN = "taken"  # of sequences: True for real steps, False for padding, bool (C, L)


def advantages(
    values: np.ndarray, rewards: np.ndarray, terminated: bool, gamma: float, lambda_: float
) -> np.ndarray:
    """Return generalised advantage estimates of a piece of an episode (Schulman et al. 2016), float64 (T,).

    Args:
        values: Values of the T + 1 observations, (T + 1,).
        rewards: Rewards of the T steps, (T,).
        terminated: Whether the episode terminated; its last observation then has the value 0.
        gamma: Discount per step.
        lambda_: Weight of longer estimates.
    """
    values = values.astype(np.float64)
    values[-1] *= not terminated
    errors = rewards + gamma * values[1:] - values[:-1]
    estimate, estimates = 0.0, []
    for error in reversed(errors.tolist()):
        estimate = error + gamma * lambda_ * estimate
        estimates.append(estimate)
    return np.array(estimates[::-1])


def shaping(potentials: np.ndarray, terminated: bool, gamma: float) -> np.ndarray:
    """Return the potential-based shaping of a piece's rewards (Ng, Harada and Russell 1999), (T,).

    Args:
        potentials: Potentials of the T + 1 places, (T + 1,).
        terminated: Whether the episode terminated; its last place then has the potential 0.
        gamma: Discount per step.
    """
    after = potentials[1:].copy()
    after[-1] *= not terminated
    return gamma * after - potentials[:-1]


def sequences(rows: dict[str, Tensor], most: int) -> dict[str, Tensor]:
    """Cut rows of successive steps into sequences of at most `most` steps of one piece of an episode.

    Args:
        rows: Columns (N, ...), among them `STARTS`.
        most: Most steps of a sequence.

    Returns:
        Columns (C, most, ...), `FIRST_ROW` and `TAKEN`; of "recurrent_state" only the state before each
        sequence's first step, (C, S).
    """
    steps = rows[STARTS]
    first = torch.nonzero(steps % most == 0)[:, 0]
    ends = torch.cat([first[1:], torch.tensor([len(steps)])])
    places = first[:, None] + torch.arange(most)
    taken = places < ends[:, None]
    places = torch.minimum(places, ends[:, None] - 1)
    parts = {name: column[places] for name, column in rows.items() if name != "recurrent_state"}
    return {**parts, "recurrent_state": rows["recurrent_state"][first], FIRST_ROW: first, TAKEN: taken}


def mean_over(taken: Tensor | None, values: Tensor) -> Tensor:
    """Return the mean of values; for sequences, the mean over the real steps."""
    return values.mean() if taken is None else values[taken].mean()
