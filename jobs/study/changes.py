"""Compare each condition with its baseline for each group, in the same corridors.

There are two questions, each with its own family of tests. Would another training of the same kind lose
success? (`Change.certain`, over trainings; undecidable with few.) Does this published training lose success?
(`Change.broken`, over its corridors, by McNemar's exact test.) Both families are corrected by Benjamini and
Hochberg (1995).
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from jobs.analysis.statistics import CONFIDENCE, Difference, crossed_mean, exact_pair_p
from jobs.study.contrasts import adjust
from jobs.study.results import Condition, Results, Trainings, values_of


class Change(NamedTuple):
    """Change of a group's success under a condition.

    Attributes:
        condition: The condition.
        baseline: The condition it is compared with.
        group: The group, with n trainings.
        success: Success rate of each training under the condition, (n,).
        before: Success rate of each training at the baseline, (n,).
        difference: Difference of the rates, paired by training and corridor, with an interval over trainings;
            over corridors if there is a single training.
        certain: Whether the group's change is certain in its family; never for a single training.
        broken: bool (n,), whether each training certainly loses, in the family of all trainings' tests.
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
        """Whether mean success falls."""
        return self.difference.value < 0


def changes_of(results: Results, every: bool = False) -> list[Change]:
    """Compare each condition with its baseline for each trained group, without repeating a simulation.

    Args:
        results: The episodes.
        every: Include equal and repeated simulations, such as event noise for a policy that sees no events.
            For studies whose plan names all of its conditions in advance.
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
    """Return the changes of groups with several trainings, which allow conclusions about other trainings."""
    return [change for change in changes if len(change.success) > 1]


def compared_pairs(results: Results, group: str | None = None) -> list[tuple[Condition, Condition]]:
    """Return condition and baseline of each change, without pairs that repeat the same two simulations.

    Args:
        results: The results of the study.
        group: The group; its baselines may differ if it was trained at another rate. None: the baselines of
            most groups.
    """
    same = results.same_as
    found: dict[tuple[Condition, Condition], tuple[Condition, Condition]] = {}
    for at, baseline in results.baselines(group).items():
        ends = same[at], same.get(baseline, baseline)
        if ends[0] != ends[1]:
            found.setdefault(ends, (at, baseline))
    return list(found.values())


def content(trainings: Trainings) -> bytes:
    """Return all episodes of a group under a condition as bytes; equal bytes mean the same simulation."""
    return b"".join(own.tobytes() for own in trainings.values())


def _compared(results: Results, every: bool) -> Iterator[tuple[Condition, Condition, str]]:
    """Yield condition, baseline and group of each change that was evaluated at both ends."""
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
    """Return a change, not yet tested for certainty, and the uncorrected p value of each training."""
    success = values_of(here, "success")
    before = values_of({seed: there[seed] for seed in here}, "success")
    alone = np.array(
        [exact_pair_p(ours > 0, theirs > 0) for ours, theirs in zip(success, before, strict=True)]
    )
    difference = crossed_mean(success - before, (-1.0, 1.0))
    rates = success.mean(axis=1), before.mean(axis=1)
    return Change(at, baseline, group, *rates, difference, False, np.zeros(len(success), bool)), alone


def _is_certain(p_values: np.ndarray) -> np.ndarray:
    """Test which p values of a family are certain, bool (n,); the family may be empty."""
    return np.array(adjust("bh", list(p_values))) < 1 - CONFIDENCE if p_values.size else np.zeros(0, bool)
