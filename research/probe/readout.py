"""Measure how much of the proximity a ridge regression and a small network read from a representation.

Errors are summed per episode, because steps of one episode are not independent samples: intervals
come from resampling episodes, and trainings, with replacement.
"""

import copy
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import cho_factor, cho_solve

from jobs.analysis.statistics import CONFIDENCE, RESAMPLES
from models.policy.networks import mlp
from research.probe.dataset import ProbeData

INNER_SHARE = 0.2  # last share of the training episodes, to choose the penalty and when to stop
PENALTIES = (1e-8, 1e-6, 1e-4, 1e-3, 1e-2, 1e-1, 1.0)  # penalties of a squared weight, in squared deviations
HIDDEN = (64, 64)
LEARNING_RATE, BATCH = 1e-3, 256
MAX_EPOCHS, PATIENCE = 100, 8
ROWS = 4096  # rows that are converted to float64 at once

Interval = tuple[float, float, float]  # mean, and the ends of the 95 % interval


class Errors(NamedTuple):
    """Sums over the steps of each held-out episode, float64 (F,).

    Attributes:
        ridge, network: Squared errors of the proximity.
        bearing: Network's error of the bearing of the nearest obstacle [degrees].
    """

    ridge: np.ndarray
    network: np.ndarray
    bearing: np.ndarray


class Scores(NamedTuple):
    """The scores of a representation, each with its interval.

    Attributes:
        ridge, network: Share of the variance of the proximity, over all sectors, that the probe
            explains (R2): 0 for predicting the mean, 1 for perfect predictions.
        bearing_deg: Network's mean error of the bearing of the nearest obstacle, over steps with one
            within `research.probe.dataset.ALARM_M` [degrees].
    """

    ridge: Interval
    network: Interval
    bearing_deg: Interval


def probe(x: np.ndarray, train: ProbeData, x_held_out: np.ndarray, held_out: ProbeData, seed: int) -> Errors:
    """Fit both probes to a representation, and sum their errors on held-out episodes.

    Args:
        x: (N, D) representation of the training episodes.
        train: At least two episodes.
        x_held_out: (M, D).
        held_out: Other episodes.
        seed: Seed of the network.

    Raises:
        ValueError: A representation has a value that is not finite, or there is only one training episode.
    """
    if not (np.isfinite(x).all() and np.isfinite(x_held_out).all()):
        raise ValueError("a representation must be finite, got NaN or infinity")
    inner = inner_episodes(train.episode)
    mean, scale = x.mean(axis=0, dtype=np.float64), x.std(axis=0, dtype=np.float64)
    scale[scale < 1e-9] = 1.0
    inputs = [((part - mean) / scale).astype(np.float32) for part in (x, x_held_out)]
    linear = ridge(inputs[0], train.proximity, inner, inputs[1])
    learnt = network(inputs[0], train.proximity, inner, inputs[1], seed)
    squares = [np.square(own - held_out.proximity).sum(axis=1) for own in (linear, learnt)]
    bearing = held_out.bearing_deg
    wrong = np.abs(bearing[learnt.argmax(axis=1)] - bearing[held_out.proximity.argmax(axis=1)])
    return Errors(*(per_episode(part, held_out.episode) for part in (*squares, wrong * held_out.alarm)))


def scores(errors: Sequence[Errors], held_out: ProbeData) -> Scores:
    """Return the scores of one or more trainings, with their intervals."""
    ridge_error, error, wrong = (np.stack(parts) for parts in zip(*errors, strict=True))
    deviations = np.square(held_out.proximity - held_out.proximity.mean(axis=0)).sum(axis=1)
    total = per_episode(deviations, held_out.episode)
    missed = [ratio_interval(part, total) for part in (ridge_error, error)]
    linear, learnt = ((1.0 - share, 1.0 - high, 1.0 - low) for share, low, high in missed)
    return Scores(linear, learnt, ratio_interval(wrong, per_episode(held_out.alarm, held_out.episode)))


def per_episode(values: np.ndarray, episode: np.ndarray) -> np.ndarray:
    """Return the sums of values (N,) over the steps of each episode, float64 (F,)."""
    return np.bincount(np.unique(episode, return_inverse=True)[1], weights=values)


def inner_episodes(episode: np.ndarray) -> np.ndarray:
    """Return a mask, bool (N,), of the steps of the last episodes, which choose penalty and stopping.

    Raises:
        ValueError: There is only one episode.
    """
    numbers = np.unique(episode)
    if len(numbers) < 2:
        raise ValueError(f"need two training episodes or more, got {len(numbers)}; raise probe.num_steps")
    kept = max(1, round(INNER_SHARE * len(numbers)))
    return episode >= numbers[-kept]


def ridge(x: np.ndarray, y: np.ndarray, inner: np.ndarray, x_held_out: np.ndarray) -> np.ndarray:
    """Return predictions (M, K) of a closed-form ridge regression with the best penalty for `inner` steps.

    All penalties share the normal equations. scikit-learn's Ridge computes them for each penalty, which took
    five to eight times as long on 20,000 rows, and it converts all rows to float64.

    Args:
        x: float32 (N, D), with mean 0 and deviation 1.
        y: (N, K).
        inner: bool (N,).
        x_held_out: float32 (M, D).
    """
    middle = y.mean(axis=0)
    outer, rest = (normal_equations(x, y - middle, part) for part in (~inner, inner))
    errors = [np.square(x[inner] @ solve(outer, penalty) + middle - y[inner]).mean() for penalty in PENALTIES]
    both = Equations(outer.square + rest.square, outer.moment + rest.moment, outer.rows + rest.rows)
    return x_held_out @ solve(both, PENALTIES[int(np.argmin(errors))]) + middle


class Equations(NamedTuple):
    """Normal equations: x'x (D, D), x'y (D, K), and the number of rows."""

    square: np.ndarray
    moment: np.ndarray
    rows: int


def normal_equations(x: np.ndarray, y: np.ndarray, chosen: np.ndarray) -> Equations:
    """Return the normal equations of the chosen rows, float64."""
    square, moment = np.zeros((x.shape[1], x.shape[1])), np.zeros((x.shape[1], y.shape[1]))
    places = np.flatnonzero(chosen)
    for first in range(0, len(places), ROWS):
        part = places[first : first + ROWS]
        rows = x[part].astype(np.float64)
        square += rows.T @ rows
        moment += rows.T @ y[part]
    return Equations(square, moment, len(places))


def solve(equations: Equations, penalty: float) -> np.ndarray:
    """Return the weights (D, K) that minimize the mean squared error plus `penalty` times their squares."""
    damped = equations.square + penalty * equations.rows * np.eye(len(equations.square))
    return cho_solve(cho_factor(damped, overwrite_a=True), equations.moment)


def network(x: np.ndarray, y: np.ndarray, inner: np.ndarray, x_held_out: np.ndarray, seed: int) -> np.ndarray:
    """Return predictions (M, K) of two dense tanh layers; training stops by the error of `inner` steps.

    The arguments are as in `ridge`; `seed` is the seed of weights and batches.
    """
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    middle, scale = y.mean(axis=0), max(float(y.std(axis=0).mean()), 1e-9)
    inputs = torch.from_numpy(x)
    outputs = torch.from_numpy(((y - middle) / scale).astype(np.float32))
    model = mlp(x.shape[1], HIDDEN, y.shape[1])
    optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE, fused=True)
    places, rest = np.flatnonzero(~inner), torch.from_numpy(np.flatnonzero(inner))
    best, best_state, waited = np.inf, copy.deepcopy(model.state_dict()), 0
    for _ in range(MAX_EPOCHS):
        for batch in np.array_split(rng.permutation(places), -(-len(places) // BATCH)):
            rows = torch.from_numpy(batch)
            loss = torch.nn.functional.mse_loss(model(inputs[rows]), outputs[rows])
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
        with torch.no_grad():
            error = float(torch.nn.functional.mse_loss(model(inputs[rest]), outputs[rest]))
        waited += 1
        if error < best:
            best, best_state, waited = error, copy.deepcopy(model.state_dict()), 0
        if waited >= PATIENCE:
            break
    model.load_state_dict(best_state)
    with torch.no_grad():
        return model(torch.from_numpy(x_held_out)).double().numpy() * scale + middle


def ratio_interval(top: np.ndarray, bottom: np.ndarray) -> Interval:
    """Return a ratio of sums with its 95 % bootstrap interval; NaN if the sum of `bottom` is not positive.

    Args:
        top: Values per training and episode, float64 (S, F); trainings have equal weight.
        bottom: Values per episode, float64 (F,).

    Returns:
        The ratio, and the quantiles of the ratio over trainings and episodes drawn with
        replacement. The draws depend only on the numbers of trainings and episodes.
    """
    if not bottom.sum() > 0:
        return np.nan, np.nan, np.nan
    trainings, episodes = (np.full(size, 1.0 / size) for size in top.shape)
    rng = np.random.default_rng(0)
    chosen_episodes = rng.multinomial(len(episodes), episodes, RESAMPLES)
    chosen = rng.multinomial(len(trainings), trainings, RESAMPLES) / len(trainings)
    above, below = ((chosen @ top) * chosen_episodes).sum(axis=1), chosen_episodes @ bottom
    drawn = above[below > 0] / below[below > 0]
    low, high = np.quantile(drawn, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(top.mean(axis=0).sum() / bottom.sum()), float(low), float(high)
