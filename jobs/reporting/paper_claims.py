"""The paper's claims about its policies, tested on a sweep as one family of tests."""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from jobs.analysis.statistics import (
    CONFIDENCE,
    Difference,
    Interval,
    crossed_difference,
    holm,
    trainings_needed,
)
from jobs.config.conditions import NOMINAL
from jobs.evaluation.group_stats import RATE, Condition, TrainingEpisodes, episode_values, reach

GAIN = {"success": 0.1, "distance_m": 10.0}  # the smallest difference that matters
# Factor, format and unit in which a measure is shown.
UNITS = {"success": (100, "+.0f", " points"), "distance_m": (1, "+.1f", " m")}
Verdict = Literal["holds", "reversed", "equivalent", "does not hold", "undecided", "not tested"]
Measure = Literal["success", "distance_m"]
Find = Callable[[Condition, str], TrainingEpisodes]  # of a group under a condition; empty if there are none


class Claim(NamedTuple):
    """One comparison that the paper makes.

    Attributes:
        text: What it says.
        source: Where.
        ours, theirs: The group that should do better, and the other.
        measure: Field of EPISODE that is compared.
        conditions: On which.
        change: Whether it is about what the conditions change, against the same policies at their baselines,
            rather than about who does better under them.
    """

    text: str
    source: str
    ours: str
    theirs: str
    measure: Measure
    conditions: tuple[Condition, ...]
    change: bool = False


class Finding(NamedTuple):
    """What was found of a claim.

    Attributes:
        verdict: See `verdict_of`.
        overall: Difference of the means over all conditions; None: one of the groups is missing.
        conditions: The difference under each.
        adjusted_p: Of `overall`, for the family of all claims; None: there is no test.
        needed: Trainings of each group that would show a difference that matters, if it is undecided; None:
            no number would in these corridors, or there is no test.
    """

    verdict: Verdict
    overall: Difference | None
    conditions: Mapping[Condition, Difference]
    adjusted_p: float | None = None
    needed: int | None = None


# What the paper says of both its policies on bytestreams, against event images; axis -> its own values.
OF_BOTH: tuple[tuple[str, str, Measure, dict[str, tuple[str, ...]]], ...] = (
    (
        "adapts to other control rates",
        "abstract, D.3",
        "success",
        {"control_hz": ("45", "100", "400"), "control_hz_dense": ("45", "100", "200", "400")},
    ),
    ("tolerates another camera threshold", "D.3", "distance_m", {"contrast_threshold": ("0.05",)}),
    ("tolerates dead pixels", "D.3", "distance_m", {"sparsity": ("0.2", "0.5")}),
    (
        "tolerates background activity",
        "abstract, D.3",
        "distance_m",
        {"background_activity": ("0.05", "0.1")},
    ),
    ("generalises to other textures", "D.3", "success", {"world": ("texture_change",)}),
    ("generalises to other shapes", "D.3", "success", {"world": ("shape_change",)}),
    ("gains much over event images with moving textures", "F.1", "distance_m", {"world": ("dynamic",)}),
)
BYTESTREAMS = ("bytestream", "bytestream_xy")
FASTER = "learns faster"
VAE = "beats a policy on an autoencoder over event images, which could not reach acceptable performance"
RGB = "generalises better than a policy on camera images"
BEST = "without polarity is best among moving textures"
CLAIMS = (
    *(
        Claim(
            text,
            source,
            ours,
            "event_image",
            measure,
            tuple((at, one) for at in axes for one in axes[at]),
            change=not text.startswith("gains"),
        )
        for ours in BYTESTREAMS
        for text, source, measure, axes in OF_BOTH
    ),
    Claim(BEST, "F.1", "bytestream_xy", "bytestream", "distance_m", (("world", "dynamic"),)),
    Claim(VAE, "D.1.2", "event_image", "event_image_vae", "success", ((NOMINAL, "poles_eval"),)),
    *(
        Claim(RGB, "D.1.2", ours, "rgb", "success", (("world", "texture_change"),), change=True)
        for ours in BYTESTREAMS
    ),
)
# Tested on learning curves, and on no condition of a sweep.
LEARNT = tuple(Claim(FASTER, "abstract", ours, "event_image", "success", ()) for ours in BYTESTREAMS)


def judge_all(
    find: Find, baselines: Mapping[Condition, Condition], trainings: Mapping[str, Sequence[float]]
) -> dict[Claim, Finding]:
    """Test all claims; their p values are adjusted as one family (Holm).

    Args:
        find: Looks up episodes.
        baselines: Condition -> what it is compared with.
        trainings: Group -> mean success rate, 0..1, of each training (`learning_curves.mean_success`).
    """
    found = {claim: compare(claim, find, baselines) for claim in CLAIMS}
    found |= {claim: compare_learning(claim, trainings) for claim in LEARNT}
    tested = [claim for claim, one in found.items() if one.overall and one.overall.p is not None]
    adjusted = dict(zip(tested, holm([found[claim].overall.p for claim in tested]), strict=True))  # type: ignore[union-attr, misc]
    judged = {}
    for claim, one in found.items():
        p, gain = adjusted.get(claim), GAIN[claim.measure]
        verdict, needed = verdict_of(one.overall, p, gain), None
        if verdict == "undecided" and p is not None:
            sides = compared_sides(claim, find, baselines, trainings)
            needed = trainings_needed(*sides, gain, len(tested), bounds_of(claim, *sides))
        judged[claim] = one._replace(adjusted_p=p, verdict=verdict, needed=needed)
    return judged


def verdict_of(overall: Difference | None, adjusted_p: float | None, gain: float) -> Verdict:
    """The verdict on a difference: "holds" and "reversed" are certain within the family of tests.

    "equivalent": the interval lies within the smallest difference that matters on both sides; "does not
    hold": it excludes such a gain; else "undecided".
    """
    if overall is None:
        return "not tested"
    if overall.interval is None or adjusted_p is None:
        return "undecided"
    low, high = overall.interval
    if adjusted_p < 1 - CONFIDENCE:
        return "holds" if overall.value > 0 else "reversed"
    if -gain < low and high < gain:
        return "equivalent"
    return "does not hold" if high < gain else "undecided"


def compare(claim: Claim, find: Find, baselines: Mapping[Condition, Condition]) -> Finding:
    """The differences of a claim, on those of its conditions under which both groups were evaluated."""
    ours, theirs = compared(claim, find, baselines)
    if not ours:
        return Finding("not tested", None, {})
    single = {
        at: crossed_difference(ours[at], theirs[at], bounds_of(claim, ours[at], theirs[at])) for at in ours
    }
    return Finding("undecided", _difference(claim, over_conditions(ours), over_conditions(theirs)), single)


def compare_learning(claim: Claim, trainings: Mapping[str, Sequence[float]]) -> Finding:
    """The difference of a claim of `LEARNT`; arguments as in `judge_all`."""
    ours, theirs = _learnt(claim, trainings)
    if not len(ours) or not len(theirs):
        return Finding("not tested", None, {})
    return Finding("undecided", _difference(claim, ours, theirs), {})


def compared_sides(
    claim: Claim,
    find: Find,
    baselines: Mapping[Condition, Condition],
    trainings: Mapping[str, Sequence[float]],
) -> tuple[np.ndarray, np.ndarray]:
    """What a tested claim compares of both groups, (trainings, corridors); arguments as in `judge_all`."""
    if claim in LEARNT:
        return _learnt(claim, trainings)
    ours, theirs = compared(claim, find, baselines)
    return over_conditions(ours), over_conditions(theirs)


def _learnt(claim: Claim, trainings: Mapping[str, Sequence[float]]) -> tuple[np.ndarray, np.ndarray]:
    """Success of the trainings of both groups while they learnt, (trainings, 1)."""
    ours, theirs = (np.array(trainings.get(group, ())) for group in (claim.ours, claim.theirs))
    return ours[:, None], theirs[:, None]


def _difference(claim: Claim, ours: np.ndarray, theirs: np.ndarray) -> Difference:
    """Of two groups (trainings, corridors); of one training nothing follows for others."""
    found = crossed_difference(ours, theirs, bounds_of(claim, ours, theirs))
    return found if min(len(ours), len(theirs)) > 1 else Difference(found.value, None, None)


def bounds_of(claim: Claim, *values: np.ndarray) -> Interval | None:
    """The least and the greatest value of what a claim compares that there can be; None: no corridors."""
    if claim in LEARNT:
        return None
    low, high = RATE if claim.measure == "success" else reach(*values)
    return (-high, high) if claim.change else (low, high)


def compared(
    claim: Claim, find: Find, baselines: Mapping[Condition, Condition]
) -> tuple[dict[Condition, np.ndarray], dict[Condition, np.ndarray]]:
    """What is compared of both groups, (trainings, corridors), under each condition that both have.

    Of each group the trainings that were evaluated under all of these conditions, and at their baselines
    where it is about a change: the same rows everywhere.
    """
    groups = claim.ours, claim.theirs

    def needed(at: Condition) -> tuple[Condition, ...]:
        return (at, baselines.get(at, at)) if claim.change else (at,)

    swept = [at for at in claim.conditions if all(find(one, group) for one in needed(at) for group in groups)]
    sides: list[dict[Condition, np.ndarray]] = []
    for group in groups:
        every = [set(find(one, group)) for at in swept for one in needed(at)]
        seeds = sorted(set.intersection(*every) if every else (), key=str)
        sides.append({at: _values(claim, find, needed(at), group, seeds) for at in swept if seeds})
    return (sides[0], sides[1]) if all(sides) else ({}, {})


def _values(
    claim: Claim, find: Find, places: Sequence[Condition], group: str, seeds: Sequence[int | None]
) -> np.ndarray:
    """What is compared of these trainings of a group under a condition, less its baseline if there is one."""
    here, *before = (
        episode_values({seed: find(at, group)[seed] for seed in seeds}, claim.measure) for at in places
    )
    return here - before[0] if before else here


def over_conditions(values: Mapping[Condition, np.ndarray]) -> np.ndarray:
    """Mean over conditions (trainings, corridors)."""
    means: np.ndarray = np.mean(list(values.values()), axis=0)
    return means
