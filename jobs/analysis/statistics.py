"""95 % intervals of rates and means, also over several trainings, and of paired differences.

The unit of replication is the training. All trainings are evaluated in the same corridors, a crossed design
of two random factors. scipy is used where possible; it has no interval of a mean over two crossed factors,
and none of a difference of paired rates. `python -m research.coverage` prints the intervals' coverage.
"""

import importlib
from collections.abc import Sequence
from types import ModuleType
from typing import NamedTuple

import numpy as np

CONFIDENCE = 0.95
RESAMPLES = 10_000
POWER = 0.8
MOST_TRAININGS = 10_000  # limit of the search in `trainings_needed`
CERTAIN = 30.0  # standard errors, beyond which power is 1 and scipy's noncentral t has no correct digits

Interval = tuple[float, float]


def _stats() -> ModuleType:
    """Import scipy.stats on demand: it takes half a second, and a demo from the wheel works without it."""
    return importlib.import_module("scipy.stats")


class Estimate(NamedTuple):
    """A value with its 95 % interval; None for a single episode."""

    value: float
    interval: Interval | None


class Difference(NamedTuple):
    """A value, its 95 % interval, and the two-sided p value of the test that the value is 0.

    Interval and p are None if there are too few trainings and corridors for a test.

    Attributes:
        error: Standard error; None if interval and p are.
        freedom: Degrees of freedom of the standard error.
    """

    value: float
    interval: Interval | None
    p: float | None
    error: float | None = None
    freedom: float | None = None

    def p_of_gain(self, margin: float) -> float | None:
        """Return the one-sided p of the test that the value is `margin` or more; small p excludes a gain."""
        if self.error is None:
            return None
        if self.error == 0.0:
            return float(self.value >= margin)
        return float(_stats().t.sf((margin - self.value) / self.error, self.freedom))

    def p_of_loss(self, margin: float) -> float | None:
        """Return the one-sided p of the test that the value is `-margin` or less; small p excludes a loss."""
        return self._replace(value=-self.value).p_of_gain(margin)


def wilson_interval(successes: int, trials: int) -> Interval:
    """Return the 95 % interval of a success rate (Wilson 1927), which is also valid at 0 and 1.

    Raises:
        ValueError: There are no trials, or more successes than trials.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"need 0 <= successes <= trials and a trial, got {successes} of {trials}")
    interval = _stats().binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def bootstrap_interval(values: np.ndarray, rng: np.random.Generator) -> Interval | None:
    """Return the 95 % percentile bootstrap interval of the mean; None for a single value.

    Args:
        values: One number per episode, shape (n,).
        rng: Draws the resamples.

    Raises:
        ValueError: There is no value, or a value is NaN or infinite.
    """
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
        raise ValueError(f"values must be a list of finite numbers, got {values!r}; leave out what failed")
    if values.size == 1:
        return None
    found = _stats().bootstrap([values], np.mean, n_resamples=RESAMPLES, confidence_level=CONFIDENCE,
                      method="percentile", rng=rng)  # fmt: skip
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def rate_estimate(successes: np.ndarray) -> Estimate:
    """Estimate the success rate over trainings and corridors; the training is the unit of replication.

    The interval spans three: Student's of the training means with the corridors' variance (`crossed_mean`),
    Student's of the trainings' arcsines (Anscombe 1948), which fits rates near 0 and 1, and Wilson's of all
    episodes, without which trainings that agree would give an interval of width 0. Coverage:
    `python -m research.coverage`.

    Args:
        successes: Shape (trainings, corridors), 0 or 1.

    Raises:
        ValueError: There is no value, or a value is NaN or infinite.
    """
    successes = _checked(successes, "successes")
    trainings, corridors = successes.shape
    ends = [wilson_interval(int(successes.sum()), successes.size)]
    if trainings > 1:
        ends.append(crossed_mean(successes).interval or ends[0])
        won = successes.sum(axis=1)
        angles = np.arcsin(np.sqrt((won + 0.375) / (corridors + 0.75)))
        centre, half = angles.mean(), float(half_width(angles[:, None])[0])
        low, high = np.sin(np.clip([centre - half, centre + half], 0.0, np.pi / 2)) ** 2
        ends.append((float(low), float(high)))
    lows, highs = zip(*ends, strict=True)
    return Estimate(float(successes.mean()), (max(min(lows), 0.0), min(max(highs), 1.0)))


def crossed_mean(values: np.ndarray, bounds: Interval | None = None) -> Difference:
    """Estimate the mean over trainings and corridors, two crossed random factors, and test if it is 0.

    The interval is Student's of the training means, widened by the variance that the corridors add (analysis
    of variance of a crossed design; degrees of freedom by Satterthwaite 1946, at most the trainings'). With a
    single training, the interval is over corridors, for this training alone.

    Args:
        values: Shape (trainings, corridors).
        bounds: Smallest and largest possible value. One value at each bound is added when the variance by
            chance is estimated, because values can agree by chance. None: no bounds; equal values give an
            interval of width 0.

    Raises:
        ValueError: There is no value, or a value is NaN or infinite.
    """
    values = _checked(values, "values")
    return _within(_crossed([values], _least(values, bounds)), bounds)


def crossed_difference(ours: np.ndarray, theirs: np.ndarray, bounds: Interval | None = None) -> Difference:
    """Estimate the mean of ours minus the mean of theirs in the same corridors, and test if it is 0.

    The interval is Welch's of the training means, widened as in `crossed_mean`. If a side has one training,
    the interval is over corridors, for these trainings alone.

    Args:
        ours: Shape (trainings, corridors).
        theirs: Shape (other trainings, the same corridors).
        bounds: As in `crossed_mean`.

    Raises:
        ValueError: The numbers of corridors differ, or a value is NaN or infinite.
    """
    ours, theirs = _checked(ours, "ours"), _checked(theirs, "theirs")
    if ours.shape[1] != theirs.shape[1]:
        raise ValueError(f"both must be of the same corridors, got {ours.shape[1]} and {theirs.shape[1]}")
    least = _least(ours, bounds) + _least(theirs, bounds)
    span = None if bounds is None else (bounds[0] - bounds[1], bounds[1] - bounds[0])
    return _within(_crossed([ours, -theirs], least), span)


def _within(found: Difference, bounds: Interval | None) -> Difference:
    """Clip the interval of a difference to the bounds, if there are any."""
    if bounds is None or found.interval is None:
        return found
    low, high = found.interval
    return found._replace(interval=(max(low, bounds[0]), min(high, bounds[1])))


def _by_trainings(values: np.ndarray) -> float:
    """Return the variance of the mean due to trainings and chance; 0 for a single training."""
    return float(values.mean(axis=1).var(ddof=1) / len(values)) if len(values) > 1 else 0.0


def _by_corridors(sides: Sequence[np.ndarray]) -> float:
    """Return the variance that corridors add to the sum of the sides' means.

    If a side has a single training, the variance includes chance.
    """
    corridors = sides[0].shape[1]
    if corridors == 1:
        return 0.0
    all_of_it = sum(side.mean(axis=0) for side in sides)
    chance = sum(_residual(side) for side in sides) if min(map(len, sides)) > 1 else 0.0
    return max(float(np.var(all_of_it, ddof=1)) / corridors - chance, 0.0)


def _residual(values: np.ndarray) -> float:
    """Return the variance of the mean that neither trainings nor corridors explain."""
    trainings, corridors = values.shape
    rest = values - values.mean(axis=0) - values.mean(axis=1, keepdims=True) + values.mean()
    return float((rest**2).sum() / ((trainings - 1) * (corridors - 1)) / values.size)


def _least(values: np.ndarray, bounds: Interval | None, size: int | None = None) -> float:
    """Return the variance of the mean by chance alone, with one more value at each bound; 0 without bounds.

    Agresti and Coull (1998) add a success and a failure to a rate in the same way. Variance that trainings
    and corridors explain does not count as chance, so episodes in the same corridor stay paired.

    Args:
        values: Values of one group, (trainings, corridors).
        bounds: As in `crossed_mean`.
        size: Number of values with the same variance by chance; None: the number of `values`.
    """
    if bounds is None:
        return 0.0
    count, mean = values.size if size is None else size, float(values.mean())
    chance = _residual(values) * values.size if min(values.shape) > 1 else 0.0
    return (count * chance + sum((end - mean) ** 2 for end in bounds)) / (count + 2) ** 2


def _crossed(sides: Sequence[np.ndarray], least: float) -> Difference:
    """Return the sum of the sides' means with Student's interval and two-sided test, over crossed corridors.

    If a side has one training, the degrees of freedom are the corridors'; without any, there is no interval.

    Args:
        sides: Each of shape (trainings, corridors).
        least: As for `_error`.
    """
    value = float(sum(side.mean() for side in sides))
    most = corridors = sides[0].shape[1] - 1
    parts = [(_by_corridors(sides), corridors)]
    if min(map(len, sides)) > 1:
        parts += [(_by_trainings(side), len(side) - 1) for side in sides]
        most = sum(freedom for _, freedom in parts[1:])
    if most < 1:
        return Difference(value, None, None)
    error, freedom = _error(parts, least, most)
    if error == 0.0:
        return Difference(value, (value, value), float(value == 0.0), error, freedom)
    half = float(_stats().t.ppf((1 + CONFIDENCE) / 2, freedom)) * error
    p = float(2 * _stats().t.sf(abs(value) / error, freedom))
    return Difference(value, (value - half, value + half), p, error, freedom)


def _error(parts: Sequence[tuple[float, int]], least: float, most: int) -> tuple[float, float]:
    """Return the standard error and its degrees of freedom, combined as by Welch and Satterthwaite.

    Args:
        parts: Parts of the variance with their degrees of freedom; parts without any are ignored.
        least: Smallest variance.
        most: Largest degrees of freedom, the trainings'; also used for what `least` adds. Without this limit,
            small p values come two or three times too often with three trainings, whose variance can be
            small by chance, compared with the corridors'.
    """
    known = [(part, freedom) for part, freedom in parts if freedom > 0]
    known.append((max(least - sum(part for part, _ in known), 0.0), most))
    variance = sum(part for part, _ in known)
    if variance == 0.0:
        return 0.0, float(most)
    freedom = variance**2 / sum(part**2 / freedom for part, freedom in known)
    return float(np.sqrt(variance)), min(freedom, float(most))


def exact_pair_p(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return McNemar's exact two-sided p of two policies' successes, bool (n,), in the same corridors."""
    won, lost = int((ours > theirs).sum()), int((ours < theirs).sum())
    return float(_stats().binomtest(won, won + lost).pvalue) if won + lost else 1.0


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p values so that at most 5 % of such families have a wrong one below 0.05 (Holm 1979)."""
    order = np.argsort(p_values)
    scaled = np.array(p_values)[order] * np.arange(len(order), 0, -1)
    adjusted = np.empty(len(order))
    adjusted[order] = np.minimum(np.maximum.accumulate(scaled), 1.0)
    return [float(p) for p in adjusted]


def trainings_needed(
    ours: np.ndarray, theirs: np.ndarray, gain: float, family: int = 1, bounds: Interval | None = None
) -> int | None:
    """Compute how many trainings per side detect a difference of `gain` in four of five studies (`POWER`).

    Power is that of the test of `crossed_difference` (noncentral t) in the same number of corridors. The test
    must pass the first step of Holm's adjustment, so the number is enough whatever the other tests give.

    Args:
        ours: Shape (trainings, corridors).
        theirs: Shape (other trainings, the same corridors).
        gain: Difference of the means.
        family: Number of tests that are adjusted together.
        bounds: As in `crossed_difference`.

    Returns:
        Trainings per side; None if a side has one training, whose spread is unknown, or if no number is
        enough, because the variance that corridors add remains.
    """
    if min(len(ours), len(theirs)) < 2:
        return None
    corridors, added = ours.shape[1], _by_corridors([ours, -theirs])

    def power(count: int) -> float:
        parts = [(added, corridors - 1)]
        parts += [(_by_trainings(side) * len(side) / count, count - 1) for side in (ours, theirs)]
        least = sum(_least(side, bounds, count * corridors) for side in (ours, theirs))
        error, freedom = _error(parts, least, 2 * (count - 1))
        if error == 0.0:
            return 1.0
        limit = _stats().t.isf((1 - CONFIDENCE) / family / 2, freedom)
        return float(_stats().nct.sf(limit, freedom, min(gain / error, CERTAIN)))

    low, high = 1, 2
    while power(high) < POWER:
        low, high = high, 2 * high
        if high > MOST_TRAININGS:
            return None
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if power(middle) < POWER else (low, middle)
    return high


class Spread(NamedTuple):
    """Standard deviations in a group: between its trainings, and between a training's episodes by chance."""

    trainings: float
    episodes: float


def spread_of(values: np.ndarray) -> Spread:
    """Estimate both standard deviations by analysis of variance of two crossed factors (method of moments).

    They exclude effects of a corridor on all trainings. If trainings differ less than chance between
    episodes would make them differ, the first is 0.

    Args:
        values: Shape (trainings, corridors), two of each at least.
    """
    variance = _residual(values) * values.size
    between = _by_trainings(values) * len(values) - variance / values.shape[1]
    return Spread(float(np.sqrt(max(between, 0.0))), float(np.sqrt(variance)))


def corridor_spread(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Estimate the standard deviation between corridors of the difference of two groups, without chance.

    It excludes effects of a corridor on both groups alike.

    Args:
        ours: Shape (trainings, corridors).
        theirs: Shape (other trainings, the same corridors), two trainings of each at least.
    """
    return float(np.sqrt(_by_corridors([ours, -theirs]) * ours.shape[1]))


def expected_half_width(ours: Spread, theirs: Spread, apart: float, trainings: int, corridors: int) -> float:
    """Return half the width of the 95 % interval of the difference of two groups, in the spreads' unit.

    Args:
        ours: Spread of one group.
        theirs: Spread of the other group.
        apart: `corridor_spread` of both.
        trainings: Number of trainings per group, at least two.
        corridors: Number of corridors in which all are evaluated.

    Raises:
        ValueError: There are less than two trainings.
    """
    if trainings < 2:
        raise ValueError(f"an interval over trainings needs two of them, got {trainings}")
    parts = [
        ((one.trainings**2 + one.episodes**2 / corridors) / trainings, trainings - 1)
        for one in (ours, theirs)
    ]
    error, freedom = _error([*parts, (apart**2 / corridors, corridors - 1)], 0.0, 2 * (trainings - 1))
    return float(_stats().t.ppf((1 + CONFIDENCE) / 2, freedom)) * error


class CrossedSpread(NamedTuple):
    """Standard deviations of the rows and the columns of a table, and the p of the tests that they are 0.

    Attributes:
        rows, columns: Standard deviation of row or column effects; 0 if the residual alone explains as much.
        rest: Standard deviation of the residual.
        rows_p, columns_p: p values of the tests; None if no values differ.
    """

    rows: float
    columns: float
    rest: float
    rows_p: float | None
    columns_p: float | None


def crossed_spread(values: np.ndarray) -> CrossedSpread:
    """Estimate how values depend on two crossed factors (two-way analysis of variance, F tests).

    Args:
        values: Shape (rows, columns), at least two of each.

    Raises:
        ValueError: There are fewer rows or columns, or a value is NaN or infinite.
    """
    values = _checked(values, "values")
    if min(values.shape) < 2:
        raise ValueError(f"values must have two rows and two columns, got shape {values.shape}")
    rest = _residual(values) * values.size
    rows, rows_p = _factor(values, rest)
    columns, columns_p = _factor(values.T, rest)
    return CrossedSpread(rows, columns, float(np.sqrt(rest)), rows_p, columns_p)


def _factor(values: np.ndarray, rest: float) -> tuple[float, float | None]:
    """Return the standard deviation of the rows, and the p of its test against the residual variance."""
    rows, columns = values.shape
    between = columns * float(values.mean(axis=1).var(ddof=1))
    spread = float(np.sqrt(max(between - rest, 0.0) / columns))
    if rest > 0:
        return spread, float(_stats().f.sf(between / rest, rows - 1, (rows - 1) * (columns - 1)))
    return spread, 0.0 if between > 0 else None


def half_width(values: np.ndarray) -> np.ndarray:
    """Return half the width of the 95 % interval (Student's t) of the mean over trainings at k points, (k,).

    Args:
        values: Shape (trainings, k), at least two trainings.

    Raises:
        ValueError: There is only one training.
    """
    count = len(values)
    if count < 2:
        raise ValueError(f"an interval over trainings needs two of them, got {count}")
    return _stats().t.ppf((1 + CONFIDENCE) / 2, count - 1) * _stats().sem(values, axis=0)


def _checked(values: np.ndarray, name: str) -> np.ndarray:
    values = np.asarray(values, dtype=np.float64)
    if values.ndim != 2 or values.size == 0 or not np.isfinite(values).all():
        rule = f"{name} must be finite numbers of shape (trainings, corridors)"
        raise ValueError(f"{rule}, got {values!r}; leave out what failed")
    return values
