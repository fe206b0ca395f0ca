"""What each condition changes for each group, against its baseline, in the same corridors.

Two questions have two families of tests. Would another training of the same kind lose? (`Change.certain`,
over trainings; few trainings cannot tell.) Does this published training lose? (`Change.broken`, over its
corridors, by McNemar's exact test.) Both are corrected by Benjamini and Hochberg (1995).
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jobs.analysis.statistics import CONFIDENCE, Difference, crossed_mean, exact_pair_p
from jobs.study.contrasts import adjust
from jobs.study.results import Condition, Results, Trainings, values_of


class Change(NamedTuple):
    """What a condition changes for a group.

    Attributes:
        condition: The condition.
        baseline: The condition it is compared with.
        group: What was trained.
        success: Rate under the condition, of each training (n,).
        before: Rate at the baseline (n,).
        difference: Of the rates, of the same trainings in the same corridors; of one training over corridors.
        certain: Whether the group's change is certain in its family; never for a single training.
        broken: bool (n,), whether a training certainly loses, in the family of all trainings' tests.
    """

    condition: Condition
    baseline: Condition
    group: str
    success: np.ndarray
    before: np.ndarray
    difference: Difference
    certain: bool
    broken: np.ndarray

    @property
    def loses(self) -> bool:
        """Whether the mean of the trainings falls."""
        return self.difference.value < 0


def changes_of(results: Results, every: bool = False) -> list[Change]:
    """Compare each condition with its baseline for each trained group, no simulation twice.

    Args:
        results: What was evaluated.
        every: Keep also what is the same simulation for a group alone, as event noise is for a policy that
            sees no events: a plan that was written before names all of its conditions.
    """
    found = [
        _change(at, baseline, group, results.cells[at, group], results.cells[baseline, group])
        for at, baseline, group in _compared(results, every)
    ]
    if not found:
        return []
    changes, alone = [change for change, _ in found], [p_values for _, p_values in found]
    trainings = np.split(_is_certain(np.concatenate(alone)), np.cumsum([len(p) for p in alone])[:-1])
    several = np.array([len(change.success) > 1 for change in changes])
    certain = np.zeros(len(changes), bool)
    p_values = [1.0 if change.difference.p is None else change.difference.p for change in changes]
    certain[several] = _is_certain(np.array(p_values)[several])
    return [
        change._replace(certain=bool(group), broken=own & (change.success < change.before))
        for change, group, own in zip(changes, certain, trainings, strict=True)
    ]


def replicated(changes: Sequence[Change]) -> list[Change]:
    """Return the changes of groups with several trainings, from which something follows for others."""
    return [change for change in changes if len(change.success) > 1]


def compared_pairs(results: Results, group: str | None = None) -> list[tuple[Condition, Condition]]:
    """Return condition and baseline of each change; of those that are the same at both ends the first.

    Args:
        results: What was evaluated.
        group: Whose: one that was trained at another rate may have other baselines. None: those of most.
    """
    same = results.same_as
    found: dict[tuple[Condition, Condition], tuple[Condition, Condition]] = {}
    for at, baseline in results.baselines(group).items():
        ends = same[at], same.get(baseline, baseline)
        if ends[0] != ends[1]:
            found.setdefault(ends, (at, baseline))
    return list(found.values())


def content(trainings: Trainings) -> bytes:
    """Return all episodes of a group under a condition as bytes: equal where the simulation is the same."""
    return b"".join(own.tobytes() for own in trainings.values())


def _compared(results: Results, every: bool) -> Iterator[tuple[Condition, Condition, str]]:
    """Yield condition, baseline and group of each change whose both ends were evaluated."""
    order = {at: rank for rank, at in enumerate(results.baselines())}
    pairs = [(*pair, group) for group in results.groups for pair in compared_pairs(results, group)]
    seen = set()
    for at, baseline, group in sorted(pairs, key=lambda pair: order[pair[0]]):
        here, there = results.trainings(at, group), results.trainings(baseline, group)
        if not here or here.keys() != there.keys() or None in here:
            continue
        ends = group, content(here), content(there)
        if every or (ends[1] != ends[2] and ends not in seen):
            seen.add(ends)
            yield at, baseline, group


def _change(
    at: Condition, baseline: Condition, group: str, here: Trainings, there: Trainings
) -> tuple[Change, np.ndarray]:
    """Return a change of which nothing is known to be certain, and the p value of each training alone."""
    success = values_of(here, "success")
    before = values_of({seed: there[seed] for seed in here}, "success")
    alone = np.array(
        [exact_pair_p(ours > 0, theirs > 0) for ours, theirs in zip(success, before, strict=True)]
    )
    difference = crossed_mean(success - before, (-1.0, 1.0))
    rates = success.mean(axis=1), before.mean(axis=1)
    return Change(at, baseline, group, *rates, difference, False, np.zeros(len(success), bool)), alone


def _is_certain(p_values: np.ndarray) -> np.ndarray:
    """Whether each test of a family is certain, bool (n,); the family may be empty."""
    return np.array(adjust("bh", list(p_values))) < 1 - CONFIDENCE if p_values.size else np.zeros(0, bool)
