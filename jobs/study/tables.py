"""Tables and sentences of a study's page, by the same rules for all studies."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import numpy as np

from jobs.analysis.statistics import CONFIDENCE, Difference, Estimate, crossed_mean
from jobs.analysis.tables import estimate_text, markdown_table, percent_text, write_csv
from jobs.study.changes import Change, replicated
from jobs.study.contrasts import UNDECIDED, Finding, Row, by_condition
from jobs.study.doses import Dose
from jobs.study.results import RATE, Condition, Results, texts_of
from jobs.study.spec import LEARNED, Contrast, Family
from jobs.study.spread import Factors
from jobs.study.summaries import MET, Summary
from jobs.study.words import condition_text

CORRECTIONS = {"holm": "Holm", "bh": "Benjamini and Hochberg"}
ESTIMATES = (
    *("Axis", "Value", "Group", "trainings", "episodes"),
    *("success_rate", "success_low", "success_high"),
    *("distance_m", "distance_low_m", "distance_high_m"),
    *("events_per_step", "dropped"),
)
CHANGES = (
    *("Axis", "Value", "Group", "baseline_axis", "baseline_value", "trainings"),
    *("success_rate", "baseline_success_rate", "difference", "difference_low", "difference_high"),
    *("p", "certain", "broken"),
)
TESTS = (
    *("family", "Group", "test", "against", "condition", "verdict", "certain_in_family"),
    *("difference", "difference_low", "difference_high", "unit", "p_adjusted", "trainings_needed"),
)
WORST = 3  # number of worst conditions that a sentence names, plus ties


def scale_of(contrast: Contrast) -> tuple[float, str, str]:
    """Return factor, format and unit for showing a test's value."""
    if contrast.measure not in ("success", *LEARNED):
        return 1, "+.1f", "m"
    return (100, "+.0f", "points") if contrast.theirs or contrast.ours.less else (100, ".0f", "%")


def value_text(finding: Finding) -> str:
    """Return the value of a test with its interval and unit."""
    scale, form, unit = scale_of(finding.contrast)
    return f"{estimate_text(finding.difference, scale, form)} {unit}"


def family_table(
    family: Family, findings: Sequence[Finding], beside: Mapping[str, Mapping[tuple[str, ...], str]]
) -> str:
    """Return the tests of a family as a Markdown table: a line per test, or per group if possible.

    A line per group is possible if all groups have the same tests, alone or against one common group.

    Args:
        family: The family.
        findings: Findings of its tests.
        beside: Heading -> `key_of` a test -> finding of another family.
    """
    names = list(dict.fromkeys(one.contrast.name for one in findings))
    groups = list(dict.fromkeys(one.contrast.ours.group for one in findings))
    against = {one.contrast.against for one in findings}
    complete = len(findings) == len(groups) * len(names) and not any(one.contrast.source for one in findings)
    if len(names) > 1 and not beside and (against == {""} or (len(against) == 1 and complete)):
        (theirs,) = against
        cells = {(one.contrast.ours.group, one.contrast.name): _cell(family, one) for one in findings}
        lines = [(f"`{group}`", *(cells.get((group, name), "-") for name in names)) for group in groups]
        head = f"Group, against `{theirs}`" if theirs else "Group"
        return markdown_table((head, *names), lines, len(names) + 1)
    columns = _columns_beside(family, findings, beside) if beside else _columns(family, findings)
    found = {name: texts for name, texts in columns.items() if any(texts)}
    return markdown_table(tuple(found), list(zip(*found.values(), strict=True)), len(found) if beside else 4)


def _columns_beside(
    family: Family, findings: Sequence[Finding], beside: Mapping[str, Mapping[tuple[str, ...], str]]
) -> dict[str, list[str]]:
    """Return heading -> a text for each test: its finding, and the findings of other families."""
    usual = Counter(one.contrast.against for one in findings).most_common(1)[0][0]
    return {
        "Group": [f"`{one.contrast.ours.group}`" for one in findings],
        f"Test, against `{usual}`": [_test_text(one.contrast, usual) for one in findings],
        "Source": [one.contrast.source for one in findings],
        "Finding": [beside_text(one) for one in findings],
        **{
            head: [own.get(key_of(family, one.contrast), "-") for one in findings]
            for head, own in beside.items()
        },
    }


def _columns(family: Family, findings: Sequence[Finding]) -> dict[str, list[str]]:
    """Return heading -> a text for each test; an empty list if the family has no such column."""
    tested = family.adjust != "none"
    return {
        "Group": [f"`{one.contrast.ours.group}`" for one in findings],
        "Test": [one.contrast.name for one in findings],
        "Source": [one.contrast.source for one in findings],
        "Against": [one.contrast.against and f"`{one.contrast.against}`" for one in findings],
        "Finding": [finding_text(one) for one in findings] if tested else [],
        "Difference": [value_text(one) for one in findings],
        f"p ({CORRECTIONS.get(family.adjust)})": [_p_text(one) for one in findings] if tested else [],
        "Trainings needed": [_needed_text(one) for one in findings] if family.power else [],
    }


def finding_text(one: Finding) -> str:
    """Return the verdict of a test, with the words in bold that are certain in its family."""
    return ", ".join(f"**{word}**" if certain else word for word, certain in _certainty(one).items())


def _certainty(one: Finding) -> Mapping[str, bool]:
    """Return word of the verdict -> whether it is certain in the family."""
    if one.excluded and one.verdict == ", ".join(one.excluded):
        return one.excluded
    return {one.verdict: one.adjusted_p is not None and one.adjusted_p < 1 - CONFIDENCE}


def beside_text(one: Finding) -> str:
    """Return the verdict of a test of another family with its difference."""
    return f"{finding_text(one)}: {value_text(one)}"


def _cell(family: Family, one: Finding) -> str:
    return value_text(one) if family.adjust == "none" else f"{beside_text(one)}, p = {_p_text(one)}"


def _p_text(one: Finding) -> str:
    return "-" if one.adjusted_p is None else f"{one.adjusted_p:.2g}"


def _needed_text(one: Finding) -> str:
    if one.verdict != UNDECIDED or one.adjusted_p is None:
        return "-"
    return "corridors" if one.needed is None else str(one.needed)


def key_of(family: Family, contrast: Contrast) -> tuple[str, ...]:
    """Return name and groups of a test, which identify it across studies; groups by the family's aliases."""
    sides = (contrast.ours.group, "" if contrast.theirs is None else contrast.theirs.group)
    return contrast.name, *(family.alias.get(group, group) for group in sides)


def counted(findings: Sequence[Finding]) -> str:
    """Return the number of findings with each verdict as text, the most frequent first."""
    verdicts = Counter(one.verdict for one in findings)
    return "; ".join(f"{count} {verdict}" for verdict, count in verdicts.most_common())


def _excluded_text(family: Family, findings: Sequence[Finding]) -> str:
    """Return a sentence with the numbers of tests that exclude a gain or a loss; "" if not asked."""
    said = []
    for name, what in (("no_gain", "gain"), ("no_loss", "loss")):
        if name in family.words:
            own = [one.excluded[family.words[name]] for one in findings if family.words[name] in one.excluded]
            limit = limit_text(family, findings)
            said.append(f"{len(own)} exclude a {what} of {limit}, {sum(own)} of them for certain")
    return f" {'; '.join(said).capitalize()}." if said else ""


def limit_text(family: Family, findings: Sequence[Finding]) -> str:
    """Return the smallest differences that matter as text, in each unit of the tests."""
    measures = {one.contrast.measure for one in findings}
    margins = [f"{100 * family.margin['success']:g} points"] if measures & {"success", *LEARNED} else []
    return " or ".join(margins + ([f"{family.margin['distance_m']:g} m"] if "distance_m" in measures else []))


def family_sentence(family: Family, findings: Sequence[Finding]) -> str:
    """Return the findings of a family in a sentence: its only test, or counts and the certain tests."""
    if family.adjust == "none" or not findings:
        return ""
    if len(findings) == 1:
        (one,) = findings
        return f"{family.title}: {value_text(one)}, p = {_p_text(one)}, {one.verdict}."
    certain = [family.words[name] for name in ("above", "below") if name in family.words]
    named = [
        f"{one.verdict}: `{one.contrast.ours.group}` {_test_text(one.contrast)}, {value_text(one)}"
        for one in findings
        if one.verdict in certain
    ]
    listed = f" Certain: {'; '.join(named)}." if 0 < len(named) <= 6 else "" if named else " None is certain."
    asked = _excluded_text(family, findings)
    return (
        f"{family.title}, {len(findings)} tests{'.' if asked else f': {counted(findings)}.'}{asked}{listed}"
    )


def _test_text(contrast: Contrast, usual: str = "") -> str:
    """Return the name of a test, with the other group unless it is the usual one."""
    return contrast.name + ("" if contrast.against == usual else f" (against `{contrast.against}`)")


def family_note(family: Family, findings: Sequence[Finding]) -> str:
    """Return the note that explains the verdicts of a family."""
    if family.adjust == "none":
        return family.note or "Means with 95 % intervals over trainings and corridors, each alone."
    words = family.words
    sure = " and ".join(dict.fromkeys(f"*{words[name]}*" for name in ("above", "below") if name in words))
    limit = limit_text(family, findings)
    excluding = " and ".join(f"*{words[name]}*" for name in ("no_gain", "no_loss") if name in words)
    said = [
        family.note,
        f"{sure}: certain among these {len(findings)} tests (p < 0.05 after {CORRECTIONS[family.adjust]}).",
        f"*{words['within']}*: the interval of this test alone lies within {limit} on both sides."
        if "within" in words
        else "",
        f"{excluding}: the test's own interval excludes one of {limit}; **bold**: certain among all."
        if excluding
        else "",
        "*Trainings needed*: of each group, to find such a difference with a power of 80 %; *corridors*: "
        "more of these."
        if family.power
        else "",
    ]
    return " ".join(filter(None, said))


def lead_sentence(results: Results, findings: Sequence[Finding]) -> str:
    """Return a sentence on the group with the highest success: its worst condition, and its certain leads."""
    at = [one for one in results.different if all((one, g) in results.cells for g in results.trained)]
    if not at:
        return ""
    rates = {group: np.stack([results.values(one, group) for one in at]) for group in results.trained}
    best = max(rates, key=lambda group: float(rates[group].mean()))
    each, usual = rates[best].mean(axis=(1, 2)), results.values(results.nominal, best).mean()
    behind = [
        f"`{(pair - {best}).pop()}`"
        for one in findings
        if one.verdict == "certain" and best in (pair := {one.contrast.ours.group, one.contrast.against})
    ]
    lead = f"certain over {', '.join(behind)}" if behind else "certain over none"
    return (
        f"`{best}` succeeds most: {100 * usual:.0f} % with nothing changed, {100 * each.mean():.0f} % as the "
        f"mean of all {len(at)} conditions, {100 * each.min():.0f} % in its worst, "
        f"{condition_text(at[int(each.argmin())])}. Its lead is {lead} (Holm over {len(findings)} pairs)."
    )


def worst_sentence(results: Results, changes: Sequence[Change]) -> str:
    """Return a sentence on the conditions under which most trainings lose at least half of their success."""
    if not changes:
        return ""
    every = sum(len(results.groups[group]) for group in {change.group for change in changes})
    halved, broken = Counter[tuple[Condition, Condition]](), Counter[tuple[Condition, Condition]]()
    for change in changes:
        pair = change.condition, change.baseline
        halved[pair] += int((change.success <= change.before / 2)[change.before > 0].sum())
        broken[pair] += int(change.broken.sum())
    most = halved.most_common()
    least = max(most[min(WORST, len(most)) - 1][1], 1)
    worst = [f"{count} with {_against(*pair)} ({broken[pair]})" for pair, count in most if count >= least]
    several = replicated(changes)
    certain = sum(one.certain and one.loses for one in several)
    return (
        f"Of {every} trainings lose half of their success or more (in brackets, how many certainly lose): "
        f"{'; '.join(worst) or 'none'}. Of {len(several)} changes of groups {certain} are losses that are "
        f"certain for other trainings."
    )


def _against(at: Condition, baseline: Condition) -> str:
    usual = condition_text(baseline)
    return condition_text(at) + ("" if usual == "nothing changed" else f" against {usual}")


def certain_losses_table(results: Results, changes: Sequence[Change]) -> str:
    """Return a line per group with the losses that are certain for other trainings, the largest first."""
    lines = []
    for group in results.trained:
        own = sorted((one for one in changes if one.group == group), key=lambda one: one.difference.value)
        lost = [
            f"{_drop_text(one)}, {estimate_text(one.difference, 100, '+.0f')} ({one.broken.sum()})"
            for one in own
            if one.certain and one.loses
        ]
        lines.append((f"`{group}` ({len(results.groups[group])})", "; ".join(lost) or "none"))
    return markdown_table(("Group (trainings)", "Certain losses"), lines, 2)


def _drop_text(change: Change) -> str:
    before, success = 100 * change.before.mean(), 100 * change.success.mean()
    return f"{condition_text(change.condition)}: {before:.0f} to {success:.0f} %"


def broken_table(changes: Sequence[Change]) -> str:
    """Return a table, groups by axes: certain losses among all trainings at all points of the axis."""
    groups, axes = (list(dict.fromkeys(names)) for names in
                    zip(*((one.group, one.condition[0]) for one in changes), strict=True))  # fmt: skip

    def cell(group: str, axis: str) -> str:
        own = [one.broken for one in changes if (one.group, one.condition[0]) == (group, axis)]
        return f"{sum(int(broken.sum()) for broken in own)} of {sum(map(len, own))}"

    return markdown_table(
        ("Group", *axes), [(f"`{group}`", *(cell(group, at) for at in axes)) for group in groups]
    )


def change_table(changes: Sequence[Change], doses: Sequence[Dose]) -> str:
    """Return the change of success [points] at each dose of event errors, a column per group."""
    found = {(one.condition, one.group): one for one in changes}
    groups = list(dict.fromkeys(one.group for one in changes))

    def cell(dose: Dose, group: str) -> str:
        one = found.get((dose.condition, group))
        if one is None:
            return "-"
        text = estimate_text(one.difference, 100, "+.0f")
        return (f"**{text}**" if one.certain else text) + (MET if group in dose.met_by else "")

    lines = [
        (
            dose.condition[0],
            "-" if dose.asked is None else f"{100 * dose.asked:.0f}",
            f"{100 * dose.measured:.1f}",
            *(cell(dose, group) for group in groups),
        )
        for dose in doses
    ]
    return markdown_table(("Kind", "asked [%]", "Event error [%]", *(f"`{one}`" for one in groups)), lines)


def condition_table(rows: Sequence[Row], contrast: Contrast, mean: Finding, results: Results) -> str:
    """Return both sides of a test under each of its conditions; the first line is the mean."""
    ours, theirs = contrast.ours.group, contrast.theirs.group if contrast.theirs else ""
    at = contrast.ours.at
    every = [np.mean([results.values(one, group) for one in at], axis=0) for group in (theirs, ours)]
    means = [estimate_text(crossed_mean(one, RATE), 100, ".0f") for one in every]
    lines = [
        (condition_text(one.condition), percent_text(one.theirs), percent_text(one.ours),
         estimate_text(one.difference, 100, "+.0f"))
        for one in rows
    ]  # fmt: skip
    first = ("mean of these", *means, estimate_text(mean.difference, 100, "+.0f"))
    return markdown_table(
        ("Condition", f"`{theirs}` [%]", f"`{ours}` [%]", "Difference [points]"), [first, *lines]
    )


def spread_table(overall: Factors, each: Mapping[Condition, Factors], names: tuple[str, str]) -> str:
    """Return the standard deviations by two crossed factors, for the mean of all conditions and for each."""
    lines = []
    for name, one in [("mean of these", overall), *((condition_text(at), one) for at, one in each.items())]:
        p_values = ["-" if p is None else f"{p:.2g}" for p in (one.rows_p, one.columns_p)]
        spread = one.spread
        lines.append((name, f"{one.mean:.0f}", f"{spread.rows:.0f}", p_values[0], f"{spread.columns:.0f}",
                      p_values[1], f"{spread.rest:.0f}"))  # fmt: skip
    head = (
        "Success [%]",
        "Mean",
        f"SD by {names[0]}",
        "p (Holm)",
        f"SD by {names[1]}",
        "p (Holm)",
        "SD of the rest",
    )
    return markdown_table(head, lines)


def spread_sentence(overall: Factors, names: tuple[str, str], mean: np.ndarray) -> str:
    """Return a sentence on the factors by which trainings certainly differ.

    Args:
        overall: Factors of the mean over all conditions.
        names: Names of the row and the column factor.
        mean: Success rate of each training, 0..1, (rows, columns).
    """
    certain = overall.certain(names)
    said = (
        f"differ by their {' and '.join(certain)}"
        if certain
        else f"certainly differ neither by {' nor by '.join(names)}"
    )
    span = [
        f"{100 * own.min():.0f} to {100 * own.max():.0f} %"
        for own in (mean, mean.mean(axis=1), mean.mean(axis=0))
    ]
    return (
        f"Trainings {said}. The {mean.size} succeed in {span[0]} of their episodes; the means by {names[0]} "
        f"are {span[1]}, the means by {names[1]} {span[2]}. Neither explains {overall.spread.rest:.0f} "
        f"points of standard deviation."
    )


def write_estimates(file: Path, found: Sequence[Summary]) -> None:
    """Write every estimate with its interval as CSV."""
    rows = [
        (
            *(*texts_of(one.condition), one.group, len(one.trainings), one.episodes),
            *_numbers(one.success, ".4f"),
            *_numbers(one.distance_m, ".2f"),
            *(f"{one.events_per_step:.1f}", one.dropped),
        )
        for one in found
    ]
    write_csv(file, ESTIMATES, rows)


def write_changes(file: Path, changes: Sequence[Change]) -> None:
    """Write every change against its baseline as CSV."""
    rows = [
        (
            *(*texts_of(one.condition), one.group),
            *(*texts_of(one.baseline), len(one.success)),
            *(f"{one.success.mean():.4f}", f"{one.before.mean():.4f}"),
            *_numbers(one.difference, ".4f"),
            *(
                "" if one.difference.p is None else f"{one.difference.p:.3g}",
                int(one.certain),
                int(one.broken.sum()),
            ),
        )
        for one in changes
    ]
    write_csv(file, CHANGES, rows)


def write_tests(
    file: Path, families: Mapping[str, tuple[Family, Sequence[Finding]]], results: Results
) -> None:
    """Write every test as CSV. A family with a single test also lists its conditions, without p values."""
    rows = []
    for name, (family, findings) in families.items():
        rows += [(name, *_test_cells(family, one)) for one in findings]
        if len(findings) == 1 and findings[0].contrast.theirs is not None:
            (one,) = findings
            scale, form, unit = scale_of(one.contrast)
            rows += [(name, *_sides(one.contrast), condition_text(row.condition), "", "",
                      *_numbers(row.difference, form, scale), unit, "", "")
                     for row in by_condition(one.contrast, results)]  # fmt: skip
    write_csv(file, TESTS, rows)


def _test_cells(family: Family, one: Finding) -> tuple[str, ...]:
    scale, form, unit = scale_of(one.contrast)
    value = _numbers(cast(Difference, one.difference), form, scale)  # findings without one are left out
    certain = ", ".join(word for word, is_certain in _certainty(one).items() if is_certain)
    verdict, p = ((one.verdict, certain), _p_text(one)) if family.adjust != "none" else (("", ""), "")
    needed = _needed_text(one) if family.power else ""
    return (*_sides(one.contrast), "", *verdict, *value, unit, p, needed)


def _sides(contrast: Contrast) -> tuple[str, str, str]:
    return contrast.ours.group, contrast.name, contrast.against


def _numbers(one: Estimate | Difference, form: str, scale: float = 1) -> tuple[str, str, str]:
    """Return a value and the ends of its interval as text."""
    low, high = (format(scale * end, form) for end in one.interval) if one.interval else ("", "")
    return format(scale * one.value, form), low, high
