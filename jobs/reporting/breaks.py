"""What breaks each policy: conditions under which its trainings succeed less often than at their baseline."""

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
        certain: Whether the change is told apart from chance, among all tests of its family.
    """

    condition: Condition
    baseline: Condition
    group: str
    success: np.ndarray
    before: np.ndarray
    difference: Difference
    certain: bool


def changes_of(about: SweepFacts, episodes: SweptEpisodes) -> list[Change]:
    """What each condition changes for each trained group; no simulation twice, and no baseline.

    All of these tests are one family: of the changes called certain, at most one in twenty is expected to be
    due to chance (Benjamini and Hochberg 1995).
    """
    found = []
    for one in about["compared"]:
        at, baseline = place(one["condition"]), place(one["baseline"])
        if at != place(one["same_as"]) or at == baseline:
            continue
        for group in about["groups"]:
            here, there = episodes.get((at, group), {}), episodes.get((baseline, group), {})
            if here and here.keys() == there.keys() and None not in here:
                found.append(_change(at, baseline, group, here, there))
    p_values = [1.0 if change.difference.p is None else change.difference.p for change in found]
    adjusted = false_discovery_control(p_values) if found else np.empty(0)
    return [
        change._replace(certain=bool(p < 1 - CONFIDENCE)) for change, p in zip(found, adjusted, strict=True)
    ]


def _change(
    at: Condition, baseline: Condition, group: str, here: TrainingEpisodes, there: TrainingEpisodes
) -> Change:
    success, before = episode_values(here, "success"), episode_values(there, "success")
    difference = crossed_mean(success - before, CHANGE)
    if len(success) == 1:
        difference = difference._replace(p=exact_pair_p(success[0] > 0, before[0] > 0))
    return Change(at, baseline, group, success.mean(axis=1), before.mean(axis=1), difference, False)


def place(names: Sequence[str]) -> Condition:
    """A condition, as it is read from a file."""
    axis, value = names  # JSON has lists
    return axis, value
