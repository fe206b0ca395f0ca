"""What breaks each policy: conditions under which its trainings succeed less often than at their baseline.

Two questions are told apart. Would another training of the same kind break? Few trainings cannot tell:
`Change.certain`. Does this published training break? That its corridors tell: `Change.broken`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import false_discovery_control

from jobs.analysis.statistics import CONFIDENCE, Difference, crossed_mean, exact_pair_p
from jobs.evaluation.group_stats import Condition, TrainingEpisodes, episode_values
from jobs.evaluation.sweep_report import SweepFacts

CHANGE = (-1.0, 1.0)  # bounds of a change of success
SweptEpisodes = dict[tuple[Condition, str], dict[int | None, np.ndarray]]  # by condition and group


class Change(NamedTuple):
    """What a condition changes for a group.

    Attributes:
        condition: Axis and value.
        baseline: What it is compared with.
        group: What was trained.
        success: Rate under the condition, of each training (n,).
        before: Rate at the baseline (n,).
        difference: Of the rates, of the same trainings in the same corridors; of one training the p is exact.
        certain: Whether the change of the group is told apart from chance, among all tests of its family.
        broken: bool (n,), whether each of these trainings loses for certain, among all tests of trainings.
    """

    condition: Condition
    baseline: Condition
    group: str
    success: np.ndarray
    before: np.ndarray
    difference: Difference
    certain: bool
    broken: np.ndarray


def changes_of(about: SweepFacts, episodes: SweptEpisodes) -> list[Change]:
    """What each condition changes for each trained group; no simulation twice, and no baseline.

    The tests of groups are one family, those of single trainings (McNemar's exact test) another: of the
    changes called certain in one, at most one in twenty is expected to be due to chance (Benjamini and
    Hochberg 1995).
    """
    found, alone = [], []
    for one in about["compared"]:
        at, baseline = place(one["condition"]), place(one["baseline"])
        if at != place(one["same_as"]) or at == baseline:
            continue
        for group in about["groups"]:
            here, there = episodes.get((at, group), {}), episodes.get((baseline, group), {})
            if here and here.keys() == there.keys() and None not in here:
                change, p_values = _change(at, baseline, group, here, there)
                found.append(change)
                alone.append(p_values)
    if not found:
        return []
    groups = _is_certain([1.0 if change.difference.p is None else change.difference.p for change in found])
    trainings = np.split(_is_certain(np.concatenate(alone)), np.cumsum([len(p) for p in alone])[:-1])
    return [
        change._replace(certain=bool(certain), broken=own & (change.success < change.before))
        for change, certain, own in zip(found, groups, trainings, strict=True)
    ]


def _is_certain(p_values: Sequence[float] | np.ndarray) -> np.ndarray:
    """Which tests of a family are told apart from chance, bool (n,)."""
    return np.asarray(false_discovery_control(p_values)) < 1 - CONFIDENCE


def _change(
    at: Condition, baseline: Condition, group: str, here: TrainingEpisodes, there: TrainingEpisodes
) -> tuple[Change, np.ndarray]:
    """A change of which it is not yet known what is certain, and the p value of each training alone."""
    success, before = episode_values(here, "success"), episode_values(there, "success")
    alone = np.array(
        [exact_pair_p(ours > 0, theirs > 0) for ours, theirs in zip(success, before, strict=True)]
    )
    difference = crossed_mean(success - before, CHANGE)
    if len(success) == 1:
        difference = difference._replace(p=float(alone[0]))
    rates = success.mean(axis=1), before.mean(axis=1)
    return Change(at, baseline, group, *rates, difference, False, np.zeros(len(success), bool)), alone


def place(names: Sequence[str]) -> Condition:
    """A condition, as it is read from a file."""
    axis, value = names  # JSON has lists
    return axis, value
