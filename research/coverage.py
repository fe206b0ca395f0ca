"""Measure the coverage of 95 % intervals over trainings and corridors: python -m research.coverage.

Studies are simulated: the logit of success is a mean plus a normal effect of each training and of each
corridor. Episodes are drawn from it; failed episodes end uniformly before the goal line. The table has the
share of intervals that contain the true rate (`rate_estimate`) or the true difference, which is 0
(`crossed_difference` of two groups, in success and in distance; `crossed_mean` of the same trainings,
evaluated twice), and the mean width.
"""

from collections.abc import Iterator

import numpy as np

from jobs.analysis.statistics import crossed_difference, crossed_mean, rate_estimate
from jobs.analysis.tables import show_table

STUDIES = 300
TRAININGS = ((3, 14), (4, 25), (8, 10), (10, 14), (10, 28))
SPREADS = (0.0, 1.0, 2.0, 3.0)  # of the trainings' logits; the shipped policies under noise: about 2
MEANS = (0.0, 1.5, 3.0)  # logits: a rate of 50, 80 and 94 % if trainings agree
CORRIDORS = 0.7  # spread of the corridors' logits
RATE, GOAL_M = (0.0, 1.0), 100.0


def studies(
    rng: np.random.Generator, trainings: int, corridors: int, mean: float, spread: float
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the successes of two groups of trainings in the same corridors, (trainings, corridors) each."""
    for _ in range(STUDIES):
        hard = rng.normal(0.0, CORRIDORS, (1, corridors))
        logits = mean + rng.normal(0.0, spread, (2, trainings, 1)) + hard
        first, second = (rng.random(logits.shape) < 1 / (1 + np.exp(-logits))).astype(np.float64)
        yield first, second


def true_rate(mean: float, spread: float) -> float:
    """Return the expected success of a new training in a new corridor."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(80)
    rates = 1 / (1 + np.exp(-(mean + np.hypot(spread, CORRIDORS) * nodes)))
    return float((weights * rates).sum() / weights.sum())


def coverage(trainings: int, corridors: int, mean: float, spread: float) -> tuple[float, float, float, float]:
    """Return the coverage of intervals of a rate and of a difference, and the mean width of each."""
    rng, truth = np.random.default_rng(0), true_rate(mean, spread)
    held, widths = np.zeros((STUDIES, 2)), np.zeros((STUDIES, 2))
    for study, (ours, theirs) in enumerate(studies(rng, trainings, corridors, mean, spread)):
        intervals = rate_estimate(ours).interval, crossed_difference(ours, theirs, RATE).interval
        for place, (found, true) in enumerate(zip(intervals, (truth, 0.0), strict=True)):
            low, high = found or (true, true)
            held[study, place], widths[study, place] = low <= true <= high, high - low
    return *held.mean(axis=0), *widths.mean(axis=0)


def distance_coverage(trainings: int, corridors: int, mean: float, spread: float) -> float:
    """Return the coverage of intervals of the difference in distance of two groups, which is truly 0."""
    rng, ends, held = np.random.default_rng(0), np.random.default_rng(2), 0
    for both in studies(rng, trainings, corridors, mean, spread):
        ours, theirs = (np.where(won > 0, GOAL_M, ends.uniform(0.0, GOAL_M, won.shape)) for won in both)
        low, high = crossed_difference(ours, theirs, (0.0, GOAL_M)).interval or (0.0, 0.0)
        held += low <= 0.0 <= high
    return held / STUDIES


def change_coverage(trainings: int, corridors: int, mean: float, spread: float) -> float:
    """Return the coverage of intervals of a change that is truly 0: the same trainings, evaluated twice."""
    rng, held = np.random.default_rng(1), 0
    for _ in range(STUDIES):
        logits = mean + rng.normal(0.0, spread, (trainings, 1)) + rng.normal(0.0, CORRIDORS, (1, corridors))
        once, again = (rng.random((2, *logits.shape)) < 1 / (1 + np.exp(-logits))).astype(np.float64)
        low, high = crossed_mean(once - again, (-1.0, 1.0)).interval or (0.0, 0.0)
        held += low <= 0.0 <= high
    return held / STUDIES


def main() -> None:
    """Print the table."""
    rows = []
    for trainings, corridors in TRAININGS:
        for mean in MEANS:
            for spread in SPREADS:
                asked = trainings, corridors, mean, spread
                others = change_coverage(*asked), distance_coverage(*asked)
                shares = [
                    f"{100 * share:.0f}" for share in (true_rate(mean, spread), *coverage(*asked), *others)
                ]
                rows.append((f"{trainings} x {corridors}", f"{spread:g}", *shares))
    held = "Rate held [%]", "Difference held [%]", "Rate's width", "Difference's"
    more = "Change held [%]", "Difference in distance held [%]"
    head = ("Trainings x corridors", "Spread", "True rate [%]", *held, *more)
    show_table("Coverage of 95 % intervals", head, rows, 1, None)


if __name__ == "__main__":
    main()
