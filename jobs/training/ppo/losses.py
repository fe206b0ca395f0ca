"""Advantages and shaped rewards of episodes, and the sequences that a recurrent network learns from."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from jobs.training.sampling.env_runner import STATES

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
        rows: Columns (N, ...), among them `STARTS` and `STATES`.
        most: Most steps of a sequence.

    Returns:
        Columns (C, most, ...), `FIRST_ROW` and `TAKEN`; of `STATES` only the state before each
        sequence's first step, (C, S).
    """
    first = torch.nonzero(rows[STARTS] % most == 0)[:, 0]
    return {**windows(rows, 0, most), STATES: rows[STATES][first], FIRST_ROW: first}


def windows(rows: Mapping[str, Tensor], before: int, most: int) -> dict[str, Tensor]:
    """Cut rows of successive steps into windows that a recurrent network reads from a zero state.

    A window has up to `before` warm-up steps, which only build up the state, then up to `most` steps to learn
    from. A window with fewer warm-up steps is dropped, unless its piece is the start of an episode.

    Args:
        rows: Columns (N, ...), among them `STARTS`, and `STATES`, the state before each step.
        before: Most warm-up steps of a window.
        most: Most steps to learn from in a window.

    Returns:
        Columns (C, before + most, ...) without `STATES`, and `TAKEN`, True for the steps to learn from.
    """
    steps, states = rows[STARTS], rows[STATES]
    first = torch.nonzero(steps % most == 0)[:, 0]
    ends = torch.cat([first[1:], torch.tensor([len(steps)])])
    piece = first - steps[first]
    known = ~states[piece].any(1) | (steps[first] >= before)  # zero only at an episode's start
    first, ends, piece = first[known], ends[known], piece[known]
    places = torch.maximum(first - before, piece)[:, None] + torch.arange(before + most)
    taken = (places >= first[:, None]) & (places < ends[:, None])
    places = torch.minimum(places, ends[:, None] - 1)
    return {name: column[places] for name, column in rows.items() if name != STATES} | {TAKEN: taken}


def mean_over(taken: Tensor | None, values: Tensor) -> Tensor:
    """Return the mean of values; for sequences, the mean over the real steps."""
    return values.mean() if taken is None else values[taken].mean()
