"""Run the tests of a family: difference, corrected p value, and verdict of each.

All families follow one rule. A difference is certain if its corrected p is below 0.05. Otherwise the interval
of the single test decides: it may exclude a gain as large as the smallest difference that matters, a loss as
large, or both. `Finding.excluded` says whether such an exclusion is also certain within the family.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import compress
from typing import NamedTuple

import numpy as np
from scipy.stats import false_discovery_control

from envs.scene import Scene
from jobs.analysis.statistics import (
    CONFIDENCE,
    Difference,
    Estimate,
    Interval,
    crossed_difference,
    crossed_mean,
    holm,
    rate_estimate,
    trainings_needed,
)
from jobs.study.results import RATE, Condition, Results, values_of
from jobs.study.spec import LEARNED, Contrast, Family, Side

UNDECIDED, NOT_TESTED = "undecided", "not tested"
Learned = Mapping[str, Mapping[str, Sequence[float]]]  # measure -> group -> value of each training, 0..1


class Finding(NamedTuple):
    """The finding of a test.

    Attributes:
        contrast: The test.
        difference: Value, interval and uncorrected p; None: there is nothing to compare.
        adjusted_p: p after the family's correction; None: not tested.
        verdict: A word of the family, `UNDECIDED` or `NOT_TESTED`.
        needed: Number of trainings per side that would show a difference that matters, for undecided tests.
            None: no number would in these corridors, or the family does not ask.
        excluded: The family's word for each exclusion by the test's own interval -> whether the exclusion is
            certain among all tests of the family.
    """

    contrast: Contrast
    difference: Difference | None
    adjusted_p: float | None
    verdict: str
    needed: int | None
    excluded: Mapping[str, bool]


def judge(family: Family, results: Results, learned: Learned | None = None) -> list[Finding]:
    """Run all tests of a family.

    Args:
        family: The family.
        results: The episodes.
        learned: Success of each training while it learned, for tests of learning speed.
    """
    sides = [compared_values(one, results, learned or {}) for one in family.contrasts]
    found = [_difference(one, *pair) for one, pair in zip(family.contrasts, sides, strict=True)]
    places = [place for place, one in enumerate(found) if one is not None and one.p is not None]
    adjusted = dict(zip(places, adjust(family.adjust, [found[place].p for place in places]), strict=True))  # type: ignore[union-attr, misc]
    excluded = exclusions(family, found)
    findings = []
    for place, (one, difference) in enumerate(zip(family.contrasts, found, strict=True)):
        p, margin, needed = adjusted.get(place), margin_of(family, one), None
        verdict = verdict_of(difference, p, margin, family.words)
        ours, theirs = sides[place]
        is_asked = family.power and verdict == UNDECIDED and p is not None
        if is_asked and ours is not None and theirs is not None:
            needed = trainings_needed(ours, theirs, margin, len(places), bounds_of(one, ours, theirs))
        findings.append(Finding(one, difference, p, verdict, needed, excluded[place]))
    return findings


def margin_of(family: Family, contrast: Contrast) -> float:
    """Return the smallest difference that matters, in the unit of a test."""
    return family.margin.get(contrast.measure, family.margin["success"])


def exclusions(family: Family, found: Sequence[Difference | None]) -> list[dict[str, bool]]:
    """Return what the interval of each test excludes, and whether that is certain in the family.

    Gains and losses are separate families of one-sided tests, with the same correction as the family's own.

    Returns:
        One mapping for each test, see `Finding.excluded`.
    """
    excluded: list[dict[str, bool]] = [{} for _ in found]
    for name in ("no_gain", "no_loss"):
        tested = [
            (place, one, margin_of(family, contrast))
            for place, (one, contrast) in enumerate(zip(found, family.contrasts, strict=True))
            if name in family.words and one is not None and one.interval is not None
        ]
        alone = [_p_within(one, margin, name) for _, one, margin in tested]
        for (place, one, margin), p in zip(tested, adjust(family.adjust, alone), strict=True):
            low, high = one.interval or (-math.inf, math.inf)
            if high < margin if name == "no_gain" else low > -margin:
                excluded[place][family.words[name]] = p < 1 - CONFIDENCE
    return excluded


def _p_within(one: Difference, margin: float, name: str) -> float:
    p = one.p_of_gain(margin) if name == "no_gain" else one.p_of_loss(margin)
    return 1.0 if p is None else p


def adjust(correction: str, p_values: Sequence[float]) -> list[float]:
    """Correct the p values of a family by "holm" or "bh"; "none" returns them unchanged."""
    if correction == "holm":
        return holm(p_values)
    if correction == "bh" and len(p_values):
        return [float(p) for p in false_discovery_control(np.array(p_values))]
    return list(p_values)


def verdict_of(
    difference: Difference | None, adjusted_p: float | None, margin: float, words: Mapping[str, str]
) -> str:
    """Return the verdict of a test in the words of its family, by the rule at the top of this file."""
    if difference is None:
        return NOT_TESTED
    if difference.interval is None or adjusted_p is None:
        return UNDECIDED
    low, high = difference.interval
    if adjusted_p < 1 - CONFIDENCE:
        return words.get("above" if difference.value > 0 else "below", UNDECIDED)
    if -margin < low and high < margin and "within" in words:
        return words["within"]
    beyond = {"no_gain": high < margin, "no_loss": low > -margin}
    return ", ".join(words[name] for name, out in beyond.items() if out and name in words) or UNDECIDED


def compared_values(
    contrast: Contrast, results: Results, learned: Learned
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Return the values of both sides, (trainings, corridors) each; None if missing or not evaluated."""
    ours, theirs = contrast.ours, contrast.theirs
    if contrast.measure in LEARNED:
        rates = learned.get(contrast.measure, {})
        sides = [np.array(rates.get(side.group, ()))[:, None] if side else None for side in (ours, theirs)]
        return (sides[0], sides[1]) if all(one is None or one.size for one in sides) else (None, None)
    ours, theirs = _evaluated(ours, theirs, results)
    seeds = [_seeds(side, results) if side else [] for side in (ours, theirs)]
    if contrast.paired and theirs:
        seeds = [[seed for seed in seeds[0] if seed in seeds[1]]] * 2
    if not seeds[0] or (theirs and not seeds[1]):
        return None, None
    first = side_values(ours, contrast.measure, results, seeds[0])
    return first, side_values(theirs, contrast.measure, results, seeds[1]) if theirs else None


def side_values(side: Side, measure: str, results: Results, seeds: Sequence[int | None]) -> np.ndarray:
    """Return the mean of a side over its conditions, float64 (trainings, corridors)."""
    at, less = (
        [values_of({seed: results.cells[one, side.group][seed] for seed in seeds}, measure) for one in places]
        for places in (side.at, side.less)
    )
    if len(at) == len(less):
        mean: np.ndarray = np.mean([one - other for one, other in zip(at, less, strict=True)], axis=0)
        return mean
    mean = np.mean(at, axis=0)
    return mean - np.mean(less, axis=0) if less else mean


def _evaluated(ours: Side, theirs: Side | None, results: Results) -> tuple[Side, Side | None]:
    """Leave out conditions under which a side was not evaluated; out of both if they have the same ones."""

    def there(side: Side) -> list[bool]:
        places = zip(side.at, side.less, strict=True) if _is_matched(side) else zip(side.at)
        return [all(results.trainings(at, side.group) for at in place) for place in places]

    def only(side: Side, kept: Sequence[bool]) -> Side:
        at, less = tuple(compress(side.at, kept)), tuple(compress(side.less, kept))
        return side._replace(at=at, less=less if _is_matched(side) else side.less)

    if theirs is None:
        return only(ours, there(ours)), None
    kept = there(ours), there(theirs)
    if ours.at == theirs.at:
        kept = ([one and other for one, other in zip(*kept, strict=True)],) * 2
    return only(ours, kept[0]), only(theirs, kept[1])


def _is_matched(side: Side) -> bool:
    """Whether the conditions are subtracted one by one."""
    return len(side.less) == len(side.at)


def _seeds(side: Side, results: Results) -> list[int | None]:
    """Return the seeds of the trainings that were evaluated under all conditions of a side."""
    every = [set(results.trainings(at, side.group)) for at in (*side.at, *side.less)]
    return sorted(set.intersection(*every) if side.at else (), key=lambda seed: (seed is None, seed or 0))


def _difference(contrast: Contrast, ours: np.ndarray | None, theirs: np.ndarray | None) -> Difference | None:
    """Return ours minus theirs, or ours alone; no interval for an unpaired group with a single training."""
    if ours is None:
        return None
    if theirs is None:
        return crossed_mean(ours, bounds_of(contrast, ours))
    bounds = bounds_of(contrast, ours, theirs)
    if contrast.paired:
        low, high = bounds or RATE
        return crossed_mean(ours - theirs, (-max(high, -low), max(high, -low)))
    found = crossed_difference(ours, theirs, bounds)
    return found if min(len(ours), len(theirs)) > 1 else Difference(found.value, None, None)


def bounds_of(contrast: Contrast, *values: np.ndarray) -> Interval | None:
    """Return the smallest and largest possible value of a side; None for learning speed."""
    if contrast.measure in LEARNED:
        return None
    low, high = RATE if contrast.measure == "success" else reach(*values)
    return (-high, high) if contrast.ours.less else (low, high)


def reach(*distances_m: np.ndarray) -> Interval:
    """Return the smallest and largest possible distance of an episode [m]: 0 and the goal line's."""
    return 0.0, max(Scene.length_m, *(float(own.max()) for own in distances_m))


class Row(NamedTuple):
    """Success of both sides of a test under one of its conditions, and the difference."""

    condition: Condition
    ours: Estimate
    theirs: Estimate
    difference: Difference


def by_condition(contrast: Contrast, results: Results) -> list[Row]:
    """Split a test of two groups into its conditions; return success and difference under each."""
    rows = []
    for at in contrast.ours.at:
        theirs_at = contrast.theirs and contrast.theirs._replace(at=(at,))
        one = contrast._replace(ours=contrast.ours._replace(at=(at,)), theirs=theirs_at)
        ours, theirs = compared_values(one, results, {})
        difference = _difference(one, ours, theirs)
        if ours is not None and theirs is not None and difference is not None:
            rows.append(Row(at, rate_estimate(ours), rate_estimate(theirs), difference))
    return rows
