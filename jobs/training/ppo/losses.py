"""Advantages and shaped rewards of episodes, and the sequences that a recurrent network learns from."""

import numpy as np
import torch
from torch import Tensor

STARTS = "step_of_piece"  # column: number of a step in its piece of an episode, int64
FIRST_ROW = "first_row"  # of sequences (C, L, ...): the row of the first step of each, int64 (C,)
TAKEN = "taken"  # of sequences: which steps are real, bool (C, L); the others fill the last sequences


def advantages(
    values: np.ndarray, rewards: np.ndarray, terminated: bool, gamma: float, lambda_: float
) -> np.ndarray:
    """Return generalised advantage estimates of a piece of an episode (Schulman et al. 2016), float64 (T,).

    Args:
        values: Of its T + 1 observations, (T + 1,).
        rewards: Of its T steps, (T,).
        terminated: Whether it ended for good, so that its last observation has no value.
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
    """Return the shaping of a piece's rewards by a potential (Ng, Harada and Russell 1999), (T,).

    Args:
        potentials: Of its T + 1 places, (T + 1,).
        terminated: Whether it ended for good; its last place then has the potential 0.
        gamma: Discount per step.
    """
    after = potentials[1:].copy()
    after[-1] *= not terminated
    return gamma * after - potentials[:-1]


def sequences(rows: dict[str, Tensor], most: int) -> dict[str, Tensor]:
    """Cut rows of successive steps into sequences of at most `most` steps of one piece of an episode.

    Args:
        rows: Columns (N, ...), among them `STARTS`.
        most: Steps.

    Returns:
        Columns (C, most, ...), `FIRST_ROW` and `TAKEN`; the recurrent state, as every column named
        "recurrent_state", is that of the first step alone, (C, S).
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
    """Return the mean of values, of sequences that over the real steps."""
    return values.mean() if taken is None else values[taken].mean()
