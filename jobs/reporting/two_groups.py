"""Which of two groups of trainings succeeds more often over all conditions: one test, and a table."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jobs.analysis.plots import MUTED, style_of, tidy
from jobs.analysis.statistics import CONFIDENCE, Difference, Estimate, crossed_mean, rate_estimate
from jobs.analysis.tables import estimate_text, markdown_table
from jobs.evaluation.group_stats import CHANGE, RATE, Condition, TrainingEpisodes, episode_values
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting.breaks import SweptEpisodes
from jobs.reporting.paper_claims import GAIN
from jobs.reporting.words import condition_text

MEAN = "mean of these"


class Groups(NamedTuple):
    """The names of the two groups: `tried` is compared with `usual`."""

    tried: str
    usual: str


class Pair(NamedTuple):
    """Success of both groups, float (trainings, corridors) each; row by row trainings of one seed."""

    tried: np.ndarray
    usual: np.ndarray

    def difference(self) -> Difference:
        """`tried` minus `usual`, by pairs of trainings in the same corridors."""
        return crossed_mean(self.tried - self.usual, CHANGE)


def pairs_of(groups: Groups, about: SweepFacts, episodes: SweptEpisodes) -> dict[Condition, Pair]:
    """Condition -> success under it.

    Args:
        groups: Which are compared.
        about: What made the study.
        episodes: Of the study.

    Raises:
        ValueError: The groups have trainings of other seeds or other corridors, or one of them is missing.
    """
    seeds = {group: about["groups"].get(group, []) for group in groups}
    if not seeds[groups.tried] or seeds[groups.tried] != seeds[groups.usual]:
        raise ValueError(f"both groups must have trainings of the same seeds, got {seeds}")
    return {
        (axis, value): _pair(groups, episodes, (axis, value), seeds[groups.tried])
        for axis, points in about["axes"].items()
        for value in points
    }


def _pair(groups: Groups, episodes: SweptEpisodes, at: Condition, seeds: Sequence[int | None]) -> Pair:
    """The trainings of both groups under one condition, in the order of the seeds."""
    both = [(group, seed) for group in groups for seed in seeds]
    missing = [one for one in both if one[1] not in episodes.get((at, one[0]), {})]
    if missing:
        raise ValueError(f"every training must be evaluated under {at}; missing: {missing}")
    rows: TrainingEpisodes = {rank: episodes[at, group][seed] for rank, (group, seed) in enumerate(both)}
    return Pair(*np.split(episode_values(rows, "success"), 2))


def overall(pairs: Mapping[Condition, Pair]) -> Pair:
    """Mean success over all conditions."""
    return Pair(*(np.mean(side, axis=0) for side in zip(*pairs.values(), strict=True)))


def results_text(groups: Groups, about: SweepFacts, episodes: SweptEpisodes) -> str:
    """What the results say, as Markdown: the test, and success under each condition."""
    pairs = pairs_of(groups, about, episodes)
    mean = overall(pairs)
    found = mean.difference()
    tried, usual = (f"{100 * side.mean():.0f} %" for side in mean)
    means = [crossed_mean(side, RATE) for side in (mean.usual, mean.tried)]
    lines = [
        _row(condition_text(*at), pair, [rate_estimate(side) for side in (pair.usual, pair.tried)])
        for at, pair in pairs.items()
    ]
    rates = [f"`{group}` [%]" for group in (groups.usual, groups.tried)]
    head = ("Condition", *rates, f"`{groups.tried}` minus `{groups.usual}` [points]")
    return "\n\n".join(
        [
            f"Over all {len(pairs)} conditions `{groups.tried}` succeeds in {tried} of its episodes and "
            f"`{groups.usual}` in {usual}. The difference is {estimate_text(found, 100, '+.0f')} points. "
            f"{verdict_text(groups, found)}",
            markdown_table(head, [_row(MEAN, mean, means), *lines], 3).rstrip("\n"),
            "Means with 95 % intervals by trainings and corridors, each alone. The first line is the test.",
        ]
    )


def verdict_text(groups: Groups, found: Difference) -> str:
    """What the test says, in a sentence; with the smallest difference that matters, where none is certain."""
    if found.p is not None and found.p < 1.0 - CONFIDENCE:
        return f"It is certain: `{groups.tried if found.value > 0.0 else groups.usual}` succeeds more often."
    matters = GAIN["success"]
    out = found.interval is not None and max(map(abs, found.interval)) <= matters
    return (
        f"It is not certain, and one of {100 * matters:.0f} points, the smallest that "
        f"[matters](results.md#the-papers-claims), {'is' if out else 'cannot be'} ruled out."
    )


def _row(name: str, pair: Pair, rates: Sequence[Estimate | Difference]) -> tuple[str, ...]:
    """The rates of both groups, the usual first, and their difference as a row of the table."""
    texts = [estimate_text(one, 100, ".0f") for one in rates]
    return (name, *texts, estimate_text(pair.difference(), 100, "+.0f"))


def draw(groups: Groups, about: SweepFacts, episodes: SweptEpisodes) -> Figure:
    """Draw the success of both groups under each condition, a small marker for each training."""
    pairs = pairs_of(groups, about, episodes)
    names = [MEAN, *(condition_text(*at) for at in pairs)]
    figure = Figure(figsize=(6.4, 1.0 + 0.34 * len(names)), layout="constrained")
    panel = figure.subplots()
    for row, pair in enumerate((overall(pairs), *pairs.values())):
        for group, side, aside in ((groups.usual, pair.usual, -0.15), (groups.tried, pair.tried, 0.15)):
            colour, marker = style_of(group)
            each, height = 100 * side.mean(axis=1), row + aside
            panel.plot(each, np.full(len(each), height), marker, color=colour, ms=3.5, alpha=0.4, mew=0)
            (mean,) = panel.plot(each.mean(), height, "|", color=colour, ms=11, mew=2)
            if not row:
                mean.set_label(f"{group}: mean of {len(each)} trainings")
    panel.axhline(0.5, color=MUTED, lw=0.8)
    panel.set_yticks(range(len(names)), names)
    panel.set(xlabel="Success [%]", xlim=(-3, 103), ylim=(len(names) - 0.4, -0.6))
    figure.legend(frameon=False, fontsize=9, ncols=2, loc="outside upper center")
    tidy(panel, "x")
    return figure
