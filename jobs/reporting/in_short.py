"""What stands first on the results page: which policy to take, what breaks most, what the paper had right."""

import itertools
from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from jobs.analysis.statistics import CONFIDENCE, crossed_difference, holm
from jobs.analysis.tables import estimate_text
from jobs.config.conditions import NOMINAL
from jobs.evaluation.group_stats import RATE, Condition, episode_values
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting.breaks import Change, SweptEpisodes, compared_pairs, drop_text, loses, replicated
from jobs.reporting.claims_study import BY_PPO, TAUGHT, counted
from jobs.reporting.paper_claims import BYTESTREAMS, CLAIMS, Claim, Finding
from jobs.reporting.words import condition_text

# How the results page calls the studies of the claims that are published beside it.
OF_STUDIES = {
    BY_PPO: f"[by PPO, with more trainings and corridors]({BY_PPO}.md#results)",
    TAUGHT: f"[on taught policies]({TAUGHT}.md#results)",
}
# What a reader must know of a group before taking it.
NOTES = {
    "bytestream_hold": (
        ", which a planner that sees everything has taught under drawn conditions (earlier recipes of it had "
        "been evaluated in these corridors, too)"
    )
}
WORST = 3  # conditions that break most
WEAK = 0.6  # success with nothing changed below which a group is said to have little to lose


def in_short(
    about: SweepFacts,
    episodes: SweptEpisodes,
    changes: Sequence[Change],
    findings: Mapping[Claim, Finding],
    studies: Mapping[str, Mapping[Claim, Finding]],
) -> list[str]:
    """What a reader wants to know first: which policy to take, what breaks most, what the paper had right."""
    return [
        *_best_policy(about, episodes, changes),
        _worst_conditions(about, changes),
        _foretold(changes),
        *_right(about, episodes),
        f"The paper's {len({claim.text for claim in findings})} claims about its policies make "
        f"{len(findings)} tests, since most are of two encoders: {counted(findings.values())}"
        f"{_decided(findings, weak_groups(about, episodes))}.",
        *(
            f"Of {len(own)} of them {OF_STUDIES[name]}: {counted(own.values())}{_decided(own, {})}."
            for name, own in studies.items()
        ),
        *_open(findings, studies),
    ]


def _best_policy(about: SweepFacts, episodes: SweptEpisodes, changes: Sequence[Change]) -> list[str]:
    """The sentences on the group that succeeds most over the same conditions; none if none was evaluated."""
    ((value, _),) = about["axes"][NOMINAL].items()
    nominal = NOMINAL, value
    trained = dict.fromkeys(change.group for change in changes)
    groups = [group for group in trained if (nominal, group) in episodes]
    every = [at for at, _ in compared_pairs(about) if all((at, group) in episodes for group in groups)]
    if not groups or not every:
        return []
    rates = {
        group: np.stack([episode_values(episodes[at, group], "success") for at in every]) for group in groups
    }
    best = max(rates, key=lambda group: float(rates[group].mean()))
    by_condition = 100 * rates[best].mean(axis=(1, 2))
    least = int(by_condition.argmin())
    unchanged = 100 * episode_values(episodes[nominal, best], "success").mean()
    return [
        f"Take [`{best}`](train.md){NOTES.get(best, '')}: {unchanged:.0f} % with nothing changed, "
        f"{by_condition.mean():.0f} % as the mean of all conditions; its worst is "
        f"{condition_text(*every[least])}, {by_condition[least]:.0f} %. "
        f"{_lead({group: own.mean(axis=0) for group, own in rates.items()}, best)}"
    ]


def _lead(success: Mapping[str, np.ndarray], best: str) -> str:
    """The sentence on how sure it is that the best group leads, so that nobody takes a lucky training.

    The best is found by the same episodes, so that all pairs are the family, not its own pairs alone.

    Args:
        success: Group -> mean over conditions, (trainings, corridors), of the same corridors.
        best: The group with the largest mean.
    """
    several = {group: values for group, values in success.items() if len(values) > 1}
    if best not in several:
        return "It is a single training, which says nothing of another of its kind."
    others = [group for group in several if group != best]
    others.sort(key=lambda group: -float(several[group].mean()))
    if not others:
        return "No other group has several trainings to compare it with."
    pairs = list(itertools.combinations(several, 2))
    found = [crossed_difference(several[one], several[other], RATE) for one, other in pairs]
    adjusted = holm([1.0 if one.p is None else one.p for one in found])
    sure = [pair for pair, p in zip(pairs, adjusted, strict=True) if p < 1 - CONFIDENCE]
    behind = [f"`{group}`" for group in others if any({best, group} == set(pair) for pair in sure)]
    lead = crossed_difference(several[best], several[others[0]], RATE)
    named = f" ({', '.join(behind)})" if behind else ""
    return (
        f"Its lead over the next best, `{others[0]}`, is {estimate_text(lead, 100, '.0f')} points by the "
        f"interval of this pair alone; after Holm over all {len(pairs)} pairs it is certain over "
        f"{len(behind)} of the {len(others)} other groups with several trainings{named}."
    )


def _worst_conditions(about: SweepFacts, changes: Sequence[Change]) -> str:
    """The sentence on the conditions in which most of the shipped trainings lose half or more."""
    trained = {change.group for change in changes}
    every = sum(len(about["groups"][group]) for group in trained)
    halved, broken = Counter[tuple[Condition, Condition]](), Counter[tuple[Condition, Condition]]()
    for change in changes:
        pair = change.condition, change.baseline
        halved[pair] += int((change.success <= change.before / 2)[change.before > 0].sum())
        broken[pair] += int(change.broken.sum())
    most = halved.most_common()
    least = most[min(WORST, len(most)) - 1][1] if most else 0  # what ties with the last is named, too
    worst = [
        f"{count} with {_against(*pair)} ({broken[pair]})" for pair, count in most if count >= max(least, 1)
    ]
    return (
        f"What breaks most: of the {every} shipped trainings lose half of their success or more (in "
        f"brackets, how many lose for certain): {'; '.join(worst) or 'none'}."
    )


def _against(condition: Condition, baseline: Condition) -> str:
    """A condition in words, with its baseline where that is more than nothing changed."""
    beside = "" if baseline[0] == NOMINAL else f" against {condition_text(*baseline)}"
    return f"{condition_text(*condition)}{beside}"


def _foretold(changes: Sequence[Change]) -> str:
    """The sentence on what a further training of these groups would lose for certain."""
    several = replicated(changes)
    certain = [change for change in several if change.certain and loses(change)]
    sizes = sorted({len(change.success) for change in several})
    if not certain:
        count = " or ".join(str(size) for size in sizes)
        of = f" of groups of {count} trainings" if sizes else ""
        return (
            f"What a further training would lose is not known: none of {len(several)} changes{of} is certain."
        )
    named = ", ".join(f"`{one.group}` with {drop_text(one)}" for one in certain)
    return (
        f"What a further training would lose for certain, {len(certain)} of {len(several)} changes of groups "
        f"with several trainings: {named}."
    )


def _right(about: SweepFacts, episodes: SweptEpisodes) -> list[str]:
    """The sentence on what the paper is about, policies on its encoder; none if none were evaluated."""
    (value,) = about["axes"][NOMINAL]
    unchanged = {
        group: 100 * episode_values(episodes[(NOMINAL, value), group], "success").mean()
        for group in BYTESTREAMS
        if ((NOMINAL, value), group) in episodes
    }
    told = " and ".join(f"`{group}` succeeds in {rate:.0f} %" for group, rate in unchanged.items())
    what = "The paper is right that policies learn to pass obstacles by the latent of a frozen event VAE"
    return [f"{what}: with nothing changed {told} of its episodes."] if told else []


def _decided(findings: Mapping[Claim, Finding], weak: Mapping[str, float]) -> str:
    """The claims that hold or are reversed, to be said behind how many there are.

    Args:
        findings: Of the claims.
        weak: Groups that have little to lose, and their success with nothing changed, 0..1.
    """
    holds = [_told(claim) for claim, one in findings.items() if one.verdict == "holds"]
    against: dict[tuple[str, str, bool], list[str]] = {}  # of what the paper says of several groups alike
    for claim, one in findings.items():
        if one.verdict == "reversed":
            against.setdefault((claim.theirs, claim.text, claim.change), []).append(f"`{claim.ours}`")
    other = [
        f"`{theirs}` certainly {'loses less' if change else 'does better'} than {' and '.join(ours)}, of "
        f"which the paper says: {text}{_little(theirs, weak) if change else ''}"
        for (theirs, text, change), ours in against.items()
    ]
    opposite = f". Reversed: {'; '.join(other)}" if other else ""
    return (f". It holds: {'; '.join(holds)}" if holds else ". None holds") + opposite


def _told(claim: Claim) -> str:
    """A claim in the paper's words, with the groups that it compares."""
    return f"`{claim.ours}` {claim.text} (against `{claim.theirs}`)"


def _little(group: str, weak: Mapping[str, float]) -> str:
    """What is to be said of a group that has little to lose; nothing of others."""
    if group not in weak:
        return ""
    return f" (`{group}` succeeds in {100 * weak[group]:.0f} % with nothing changed, and has little to lose)"


def _open(findings: Mapping[Claim, Finding], studies: Mapping[str, Mapping[Claim, Finding]]) -> list[str]:
    """The sentence on the claims that neither the sweep nor a study decides; none without studies."""
    left = [
        _told(claim)
        for claim in findings
        if all(own[claim].verdict == "undecided" for own in (findings, *studies.values()) if claim in own)
    ]
    if not studies:
        return []
    if not left:
        return [f"Each of the {len(findings)} tests is decided by at least one of these."]
    return [f"Undecided in each of these, {len(left)} of the {len(findings)} tests: {'; '.join(left)}."]


def weak_groups(about: SweepFacts, episodes: SweptEpisodes) -> dict[str, float]:
    """Groups of claims that succeed in less than `WEAK` with nothing changed, and how often, 0..1."""
    (value,) = about["axes"][NOMINAL]
    compared = {group for claim in CLAIMS for group in (claim.ours, claim.theirs)}
    unchanged = {
        group: float(episode_values(episodes[(NOMINAL, value), group], "success").mean())
        for group in about["groups"]
        if group in compared and ((NOMINAL, value), group) in episodes
    }
    return {group: rate for group, rate in unchanged.items() if rate < WEAK}
