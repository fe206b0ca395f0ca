"""Scores of a policy as in ImageNet-C: failures relative to a frozen reference policy in the same cells.

The corruption error (CE) of a corruption is the policy's failures over its five severities, divided by the
reference's failures: 100 % is as bad as the reference, 0 % never fails. mCE is the mean over corruptions
(Hendrycks and Dietterich, ICLR 2019). A failure is an episode that does not reach the goal.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from jobs.analysis.statistics import crossed_mean
from jobs.bench.protocol import CLEAN, Cell

Episodes = Mapping[Cell, np.ndarray]  # EPISODE (corridors,) of each cell, the same corridors in all


class Scores(NamedTuple):
    """Scores of one or several trainings of a policy, as shown in the leaderboard.

    Attributes:
        mce: Mean corruption error, 1 for the reference.
        interval: 95 % interval of the mCE over trainings and corridors; over corridors only for a single
            training.
        errors: Corruption -> corruption error.
        clean: Share of failures in the clean cell.
        worst: Largest share of failures in any cell but the clean one.
        worst_cell: The cell with the largest share of failures.
        failures: Corruption -> share of failures at each severity.
    """

    mce: float
    interval: tuple[float, float] | None
    errors: dict[str, float]
    clean: float
    worst: float
    worst_cell: Cell
    failures: dict[str, list[float]]


def failure_counts(episodes: Episodes) -> dict[str, int]:
    """Return corruption -> number of failures over all severities, including the clean cell's."""
    found: dict[str, int] = {}
    for (corruption, _), rows in episodes.items():
        found[corruption] = found.get(corruption, 0) + int((~rows["success"]).sum())
    return found


def score(trainings: Sequence[Episodes], reference: Mapping[str, int]) -> Scores:
    """Compute the scores of a policy.

    Args:
        trainings: Episodes of each training in one part of the protocol.
        reference: Corruption -> failures of the reference over all severities.

    Raises:
        ValueError: The reference lacks a corruption, or never fails under one.
    """
    cells = list(trainings[0])
    corruptions = list(dict.fromkeys(name for name, _ in cells if name != CLEAN))
    without = [name for name in corruptions if not reference.get(name)]
    if without:
        raise ValueError(f"the reference must fail under each corruption; it has no failures of {without}")
    failed = {cell: np.stack([~by_cell[cell]["success"] for by_cell in trainings]) for cell in cells}
    rates = {cell: int(values.sum()) / values.size for cell, values in failed.items()}
    own = {name: sum(failed[cell].astype(float) for cell in cells if cell[0] == name) for name in corruptions}
    # Sums and quotients must round identically on every machine: `read_result` compares scores exactly.
    errors = {name: int(np.sum(own[name])) / (len(trainings) * reference[name]) for name in corruptions}
    shares = [np.shape(own[name])[1] * own[name] / reference[name] for name in corruptions]
    interval = crossed_mean(np.mean(shares, axis=0)).interval
    worst = max((cell for cell in cells if cell[0] != CLEAN), key=lambda cell: rates[cell])
    return Scores(
        mce=math.fsum(errors.values()) / len(errors),
        interval=None if interval is None else (max(0.0, interval[0]), interval[1]),
        errors=errors,
        clean=rates[CLEAN, 0],
        worst=rates[worst],
        worst_cell=worst,
        failures={name: [rates[cell] for cell in cells if cell[0] == name] for name in corruptions},
    )
