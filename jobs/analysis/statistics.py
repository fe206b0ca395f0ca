"""95 % intervals of a rate, of a mean, over several trainings, and of a difference on the same corridors.

Every random draw comes from a generator that the caller gives. scipy computes what it can; it has no
bootstrap in two stages, and no interval of a difference of paired rates.
"""

import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import binomtest, bootstrap, sem, t, trim_mean, ttest_ind

CONFIDENCE = 0.95
RESAMPLES = 10_000
TWO_STAGE_RESAMPLES = 2_000  # as rliable draws for such intervals
TAIL = 0.25  # that the interquartile mean leaves out at each end

Interval = tuple[float, float]
Statistic = Callable[[np.ndarray], np.ndarray]  # (resamples, n) -> (resamples,)


class Estimate(NamedTuple):
    """A value with its 95 % interval; None where a single episode leaves nothing to resample."""

    value: float
    interval: Interval | None


def wilson_interval(successes: int, trials: int) -> Interval:
    """95 % interval of a success rate (Wilson 1927); it also holds at 0 and at all of them.

    Raises:
        ValueError: If there are no trials, or more successes than trials.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"need 0 <= successes <= trials and a trial, got {successes} of {trials}")
    interval = binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def bootstrap_interval(values: np.ndarray, rng: np.random.Generator) -> Interval | None:
    """95 % percentile bootstrap interval of the mean; None for a single value.

    Args:
        values: One number per episode, shape (n,).
        rng: Draws the resamples.

    Raises:
        ValueError: If there is no value, or one is NaN or infinite.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
        raise ValueError(f"values must be a list of finite numbers, got {values!r}; leave out what failed")
    if values.size == 1:
        return None
    found = bootstrap([values], np.mean, n_resamples=RESAMPLES, confidence_level=CONFIDENCE,
                      method="percentile", rng=rng)  # fmt: skip
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def mean(values: np.ndarray) -> np.ndarray:
    """The mean of each row."""
    return values.mean(axis=-1)


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """The mean of the middle half of each row (Agarwal et al. 2021, as their rliable computes it)."""
    return trim_mean(values, TAIL, axis=-1)


def two_stage_estimate(values: np.ndarray, rng: np.random.Generator, statistic: Statistic = mean) -> Estimate:
    """A statistic over trainings and corridors, its interval from a two-stage bootstrap.

    Trainings are drawn first, then corridors, which all trainings share.
    Of n trainings n - 1 are drawn, which makes the variance of the resamples that of the mean
    (Rao and Wu 1988); n draws would make intervals over three trainings a fifth too narrow.

    Args:
        values: Shape (trainings, corridors).
        rng: Draws the resamples.
        statistic: Of each row of an array; `mean` or `interquartile_mean`.

    Raises:
        ValueError: If there is no value, or one is NaN or infinite.
    """
    values = _checked(values, "values")
    value = float(statistic(values.reshape(1, -1))[0])
    if values.size == 1:
        return Estimate(value, None)
    rows, columns = _trainings(len(values), rng), _corridors(values.shape[1], rng)
    drawn = values[rows[:, :, None], columns[:, None, :]].reshape(TWO_STAGE_RESAMPLES, -1)
    return Estimate(value, _percentiles(statistic(drawn)))


def paired_difference(ours: np.ndarray, theirs: np.ndarray, rng: np.random.Generator) -> Estimate:
    """Mean of ours minus mean of theirs on the same corridors, with its paired bootstrap interval.

    The trainings of each side are drawn separately, the corridors for both together.

    Args:
        ours: Shape (trainings, corridors).
        theirs: Shape (other trainings, the same corridors).
        rng: Draws the resamples.

    Raises:
        ValueError: If the corridors are not as many, or a value is NaN or infinite.
    """
    ours, theirs = _checked(ours, "ours"), _checked(theirs, "theirs")
    if ours.shape[1] != theirs.shape[1]:
        raise ValueError(f"both must be of the same corridors, got {ours.shape[1]} and {theirs.shape[1]}")
    value = float(ours.mean() - theirs.mean())
    if ours.size == theirs.size == 1:
        return Estimate(value, None)
    columns = _corridors(ours.shape[1], rng)
    sides = []
    for values in (ours, theirs):
        rows = _trainings(len(values), rng)
        sides.append(values[rows[:, :, None], columns[:, None, :]].mean(axis=(1, 2)))
    return Estimate(value, _percentiles(sides[0] - sides[1]))


def paired_rate_difference(ours: np.ndarray, theirs: np.ndarray) -> Estimate:
    """Success rate of ours minus that of theirs on the same corridors, with its 95 % interval.

    The interval is Newcombe's for pairs (1998, method 10), made of both Wilson intervals and the
    correlation of the outcomes. Unlike a bootstrap's it has a width where all pairs agree, too.

    Args:
        ours: Successes bool (n,).
        theirs: Successes bool (n,), corridor by corridor.

    Raises:
        ValueError: If there are no episodes, or not as many of both.
    """
    ours, theirs = np.asarray(ours, bool), np.asarray(theirs, bool)
    if ours.shape != theirs.shape or ours.ndim != 1 or ours.size == 0:
        rule = "both must be episodes of the same corridors, at least one"
        raise ValueError(f"{rule}, got shapes {ours.shape} and {theirs.shape}")
    count = ours.size
    both, neither = int((ours & theirs).sum()), int((~ours & ~theirs).sum())
    first, second = int(ours.sum()), int(theirs.sum())
    agreement = float(both * neither) - (first - both) * (second - both)
    if agreement > 0:
        agreement = max(agreement - count / 2, 0.0)
    spread = np.sqrt(float(first * (count - first)) * float(second * (count - second)))
    phi = agreement / spread if spread else 0.0
    ends = []
    for place in (0, 1):  # the lower end of ours meets the upper one of theirs
        own = first / count - wilson_interval(first, count)[place]
        other = wilson_interval(second, count)[1 - place] - second / count
        ends.append(float(np.sqrt(max(own * own - 2 * phi * own * other + other * other, 0.0))))
    difference = (first - second) / count
    return Estimate(difference, (difference - ends[0], difference + ends[1]))


def half_width(values: np.ndarray) -> np.ndarray:
    """Half of the 95 % interval (Student's t) of the mean over trainings at each of k points: (k,).

    Args:
        values: Shape (trainings, k), two trainings at least.

    Raises:
        ValueError: There is only one training.
    """
    count = len(values)
    if count < 2:
        raise ValueError(f"an interval over trainings needs two of them, got {count}")
    return t.ppf((1 + CONFIDENCE) / 2, count - 1) * sem(values, axis=0)


def mean_difference(ours: Sequence[float], theirs: Sequence[float]) -> Estimate:
    """Mean of ours minus mean of theirs, of independent trainings, with its 95 % interval.

    The interval is Welch's (1947), which allows unequal variances; None where a side has fewer than
    two values, or all values of each side are equal.
    """
    value = float(np.mean(ours) - np.mean(theirs))
    if min(len(ours), len(theirs)) < 2 or np.ptp(ours) == np.ptp(theirs) == 0:
        return Estimate(value, None)
    with warnings.catch_warnings():  # scipy warns where the values of one side are equal
        warnings.simplefilter("ignore", RuntimeWarning)
        interval = ttest_ind(ours, theirs, equal_var=False).confidence_interval(CONFIDENCE)
    return Estimate(value, (float(interval.low), float(interval.high)))


def _checked(values: np.ndarray, name: str) -> np.ndarray:
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 2 or values.size == 0 or not np.isfinite(values).all():
        rule = f"{name} must be finite numbers of shape (trainings, corridors)"
        raise ValueError(f"{rule}, got {values!r}; leave out what failed")
    return values


def _trainings(count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw the trainings of each resample, (resamples, count - 1); where there is one, that one."""
    return rng.integers(count, size=(TWO_STAGE_RESAMPLES, max(count - 1, 1)))


def _corridors(count: int, rng: np.random.Generator) -> np.ndarray:
    """Draw the corridors of each resample, (resamples, count)."""
    return rng.integers(count, size=(TWO_STAGE_RESAMPLES, count))


def _percentiles(resampled: np.ndarray) -> Interval:
    low, high = np.quantile(resampled, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return float(low), float(high)
