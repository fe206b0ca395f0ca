"""What breaks each policy: conditions under which its trainings succeed less often than at their baseline.

Two questions are told apart. Would another training of the same kind break? Few trainings cannot tell:
`Change.certain`. Does this published training break? That its corridors tell: `Change.broken`.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import false_discovery_control

from jobs.analysis.statistics import CONFIDENCE, Difference, crossed_mean, exact_pair_p
from jobs.evaluation.group_stats import CHANGE, Condition, TrainingEpisodes, episode_values
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting.words import condition_text

SweptEpisodes = dict[tuple[Condition, str], dict[int | None, np.ndarray]]  # by condition and group


class Change(NamedTuple):
    """What a condition changes for a group.

    Attributes:
        condition: Axis and value.
        baseline: What it is compared with.
        group: What was trained.
        success: Rate under the condition, of each training (n,).
        before: Rate at the baseline (n,).
        difference: Of the rates, of the same trainings in the same corridors; of one training over corridors.
        certain: Whether the change of the group is told apart from chance, among all tests of its family; of
            one training never.
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


def changes_of(about: SweepFacts, episodes: SweptEpisodes, every: bool = False) -> list[Change]:
    """What each condition changes for each trained group; no simulation twice, and none against itself.

    The tests of groups with several trainings are one family, those of single trainings (McNemar's exact
    test) another: of the changes called certain in one, at most one in twenty is expected to be due to chance
    (Benjamini and Hochberg 1995). Of a group with a single training nothing follows for others: it is in the
    second family alone.

    Args:
        about: What made the sweep.
        episodes: All of its episodes.
        every: Keep also what is the same simulation for a group alone, as event noise is for one that sees no
            events: a plan that was written before names all of its conditions.
    """
    found = [
        _change(at, baseline, group, episodes[at, group], episodes[baseline, group])
        for at, baseline, group in _told_apart(about, episodes, every)
    ]
    if not found:
        return []
    changes, alone = [change for change, _ in found], [p_values for _, p_values in found]
    trainings = np.split(_is_certain(np.concatenate(alone)), np.cumsum([len(p) for p in alone])[:-1])
    several = np.array([len(change.success) > 1 for change in changes])
    certain = np.zeros(len(changes), bool)
    certain[several] = _is_certain(np.array([_p(change) for change in changes])[several])
    return [
        change._replace(certain=bool(group), broken=own & (change.success < change.before))
        for change, group, own in zip(changes, certain, trainings, strict=True)
    ]


def replicated(changes: Sequence[Change]) -> list[Change]:
    """The changes of groups with several trainings, which can say something of others."""
    return [change for change in changes if len(change.success) > 1]


def loses(change: Change) -> bool:
    """Whether the mean of the trainings falls."""
    return change.difference.value < 0


def drop_text(change: Change) -> str:
    """From which success to which a change takes the mean of the trainings."""
    before, success = 100 * change.before.mean(), 100 * change.success.mean()
    return f"{condition_text(*change.condition)}: {before:.0f} to {success:.0f} %"


def content(trainings: TrainingEpisodes) -> bytes:
    """All episodes of a group under a condition: equal under two that are the same simulation for it."""
    return b"".join(own.tobytes() for own in trainings.values())


def compared_pairs(about: SweepFacts, group: str | None = None) -> list[tuple[Condition, Condition]]:
    """Condition and baseline of each change; of those that are the same at both ends the first.

    Args:
        about: What made the sweep.
        group: Whose: one that was trained at another rate may have other baselines. None: those of most.
    """
    same = {place(one["condition"]): place(one["same_as"]) for one in about["compared"]}
    found: dict[tuple[Condition, Condition], tuple[Condition, Condition]] = {}
    for one in about["compared"]:
        own = one.get("own_baseline", {}) if group else {}
        at, baseline = place(one["condition"]), place(own.get(group or "", one["baseline"]))
        ends = same[at], same.get(baseline, baseline)
        if ends[0] != ends[1]:
            found.setdefault(ends, (at, baseline))
    return list(found.values())


def _told_apart(
    about: SweepFacts, episodes: SweptEpisodes, every: bool
) -> Iterator[tuple[Condition, Condition, str]]:
    """Condition, baseline and group of each change whose both ends were evaluated, see `changes_of`."""
    order = {place(one["condition"]): rank for rank, one in enumerate(about["compared"])}
    pairs = [(*pair, group) for group in about["groups"] for pair in compared_pairs(about, group)]
    seen = set()
    for at, baseline, group in sorted(pairs, key=lambda pair: order[pair[0]]):
        here, there = episodes.get((at, group), {}), episodes.get((baseline, group), {})
        if not here or here.keys() != there.keys() or None in here:
            continue
        ends = group, content(here), content(there)
        if every or (ends[1] != ends[2] and ends not in seen):
            seen.add(ends)
            yield at, baseline, group


def _p(change: Change) -> float:
    """Of the group's test; 1 where a single episode leaves nothing to test."""
    return 1.0 if change.difference.p is None else change.difference.p


def _is_certain(p_values: np.ndarray) -> np.ndarray:
    """Which tests of a family are told apart from chance, bool (n,); the family may be empty."""
    if not p_values.size:
        return np.zeros(0, bool)
    return np.asarray(false_discovery_control(p_values)) < 1 - CONFIDENCE


def _change(
    at: Condition, baseline: Condition, group: str, here: TrainingEpisodes, there: TrainingEpisodes
) -> tuple[Change, np.ndarray]:
    """A change of which it is not yet known what is certain, and the p value of each training alone."""
    success = episode_values(here, "success")
    before = episode_values({seed: there[seed] for seed in here}, "success")
    alone = np.array(
        [exact_pair_p(ours > 0, theirs > 0) for ours, theirs in zip(success, before, strict=True)]
    )
    difference = crossed_mean(success - before, CHANGE)
    rates = success.mean(axis=1), before.mean(axis=1)
    return Change(at, baseline, group, *rates, difference, False, np.zeros(len(success), bool)), alone


def place(names: Sequence[str]) -> Condition:
    """A condition, as it is read from a file."""
    axis, value = names  # JSON has lists
    return axis, value
