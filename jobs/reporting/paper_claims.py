"""The paper's claims about its policies, tested on a sweep with the rule of templates/results.md.j2."""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from jobs.analysis.statistics import Estimate, mean_difference, paired_difference
from jobs.evaluation.group_stats import Condition, TrainingEpisodes, episode_values

GAIN = {"success": 0.1, "distance_m": 5.0}  # the smallest gain that a claim has to mean
Verdict = Literal["holds", "holds partly", "does not hold", "undecided", "not tested"]
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
    """

    text: str
    source: str
    ours: str
    theirs: str
    measure: Measure
    conditions: tuple[Condition, ...]


class Finding(NamedTuple):
    """The verdict on a claim, the mean difference, and the difference of each condition."""

    verdict: Verdict
    overall: Estimate | None
    conditions: Mapping[Condition, Estimate]


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
BEST = "without polarity is best among moving textures"
CLAIMS = (
    *(
        Claim(text, source, ours, "event_image", measure, tuple((at, one) for at in axes for one in axes[at]))
        for ours in BYTESTREAMS
        for text, source, measure, axes in OF_BOTH
    ),
    Claim(BEST, "F.1", "bytestream_xy", "bytestream", "distance_m", (("world", "dynamic"),)),
    Claim(VAE, "D.1.2", "event_image", "event_image_vae", "success", (("world", "poles_eval"),)),
)
# Tested on learning curves, and on no condition of a sweep.
LEARNT = tuple(Claim(FASTER, "abstract", ours, "event_image", "success", ()) for ours in BYTESTREAMS)


def judge(claim: Claim, find: Find) -> Finding:
    """Test a claim on those of its conditions under which both groups were evaluated.

    Args:
        claim: What is said.
        find: Looks up episodes.
    """
    pairs = {at: (find(at, claim.ours), find(at, claim.theirs)) for at in claim.conditions}
    both = {at: pair for at, pair in pairs.items() if all(pair)}
    if not both:
        return Finding("not tested", None, {})
    ours, theirs = ([episode_values(pair[side], claim.measure) for pair in both.values()] for side in (0, 1))
    single = [paired_difference(*pair, np.random.default_rng(0)) for pair in zip(ours, theirs, strict=True)]
    overall = paired_difference(_over_conditions(ours), _over_conditions(theirs), np.random.default_rng(0))
    return Finding(
        _verdict(overall, single, GAIN[claim.measure]), overall, dict(zip(both, single, strict=True))
    )


def judge_learning(claim: Claim, trainings: Mapping[str, Sequence[float]]) -> Finding:
    """Test a claim of `LEARNT`.

    Args:
        claim: What is said.
        trainings: Group -> mean success rate, 0..1, of each training (`learning_curves.mean_success`).
    """
    ours, theirs = (trainings.get(group, ()) for group in (claim.ours, claim.theirs))
    if not ours or not theirs:
        return Finding("not tested", None, {})
    overall = mean_difference(ours, theirs)
    return Finding(_verdict(overall, [overall], GAIN[claim.measure]), overall, {})


def _over_conditions(tables: list[np.ndarray]) -> np.ndarray:
    """Mean over conditions; where a training lacks one, over trainings first."""
    if len({table.shape for table in tables}) > 1:
        tables = [table.mean(axis=0, keepdims=True) for table in tables]
    return np.mean(tables, axis=0)


def _verdict(overall: Estimate, single: list[Estimate], gain: float) -> Verdict:
    above = [found.interval is not None and found.interval[0] > 0 for found in (overall, *single)]
    below = [found.interval is not None and found.interval[1] < 0 for found in single]
    if above[0] and not any(below):
        return "holds"
    if any(above):
        return "holds partly"
    return "does not hold" if overall.interval is not None and overall.interval[1] < gain else "undecided"
