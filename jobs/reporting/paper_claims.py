"""The paper's claims about its policies, tested on a sweep as one family of tests."""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from jobs.analysis.statistics import CONFIDENCE, Difference, crossed_difference, holm, trainings_needed
from jobs.evaluation.group_stats import RATE, Condition, TrainingEpisodes, episode_values
from jobs.evaluation.sweep_plan import NOMINAL
from jobs.reporting.breaks import CHANGE

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
        needed: Trainings of each group that would show a difference that matters; None: not known.
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
    return {
        claim: one._replace(
            adjusted_p=adjusted.get(claim),
            verdict=verdict_of(one.overall, adjusted.get(claim), GAIN[claim.measure]),
        )
        for claim, one in found.items()
    }


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
    bounds = None if claim.measure == "distance_m" else CHANGE if claim.change else RATE
    single = {at: crossed_difference(ours[at], theirs[at], bounds) for at in ours}
    first, second = (over_conditions(side) for side in (ours, theirs))
    overall = crossed_difference(first, second, bounds)
    if min(len(first), len(second)) == 1:  # of one training nothing follows for others
        overall = Difference(overall.value, None, None)
    needed = trainings_needed(first.mean(axis=1), second.mean(axis=1), GAIN[claim.measure])
    return Finding("undecided", overall, single, needed=needed)


def compared(
    claim: Claim, find: Find, baselines: Mapping[Condition, Condition]
) -> tuple[dict[Condition, np.ndarray], dict[Condition, np.ndarray]]:
    """What is compared of both groups, (trainings, corridors), under each condition that both have."""
    ours: dict[Condition, np.ndarray] = {}
    theirs: dict[Condition, np.ndarray] = {}
    for at in claim.conditions:
        here, there = (_values(claim, find, at, group, baselines) for group in (claim.ours, claim.theirs))
        if here is not None and there is not None:
            ours[at], theirs[at] = here, there
    return ours, theirs


def _values(
    claim: Claim, find: Find, at: Condition, group: str, baselines: Mapping[Condition, Condition]
) -> np.ndarray | None:
    """What is compared of a group under a condition, (trainings, corridors); None: not evaluated."""
    here, before = find(at, group), find(baselines.get(at, at), group)
    if not here or (claim.change and here.keys() != before.keys()):
        return None
    values = episode_values(here, claim.measure)
    return values - episode_values(before, claim.measure) if claim.change else values


def compare_learning(claim: Claim, trainings: Mapping[str, Sequence[float]]) -> Finding:
    """The difference of a claim of `LEARNT`; arguments as in `judge_all`."""
    ours, theirs = (np.array(trainings.get(group, ())) for group in (claim.ours, claim.theirs))
    if not len(ours) or not len(theirs):
        return Finding("not tested", None, {})
    if min(len(ours), len(theirs)) == 1:
        return Finding("undecided", Difference(float(ours.mean() - theirs.mean()), None, None), {})
    overall = crossed_difference(ours[:, None], theirs[:, None])
    return Finding("undecided", overall, {}, needed=trainings_needed(ours, theirs, GAIN[claim.measure]))


def over_conditions(values: Mapping[Condition, np.ndarray]) -> np.ndarray:
    """Mean over conditions; where a training lacks one, over trainings first."""
    tables = list(values.values())
    if len({table.shape for table in tables}) > 1:
        tables = [table.mean(axis=0, keepdims=True) for table in tables]
    means: np.ndarray = np.mean(tables, axis=0)
    return means
