"""Advantages and shaped rewards of episodes, and the loss of a minibatch."""

import numpy as np


def advantages(
    values: np.ndarray, rewards: np.ndarray, terminated: bool, gamma: float, lambda_: float
) -> np.ndarray:
    """Generalised advantage estimates of a piece of an episode (Schulman et al. 2016), float64 (T,).

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
    """What a potential adds to the rewards of a piece of an episode (Ng, Harada and Russell 1999), (T,).

    Args:
        potentials: Of its T + 1 places, (T + 1,).
        terminated: Whether it ended for good; its last place then has the potential 0.
        gamma: Discount per step.
    """
    after = potentials[1:].copy()
    after[-1] *= not terminated
    return gamma * after - potentials[:-1]
