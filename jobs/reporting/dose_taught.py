"""The page of the second dose-response study: ten taught trainings each, with and without a neighbour filter.

The plan stands on the page and is left as it is; what is below it is written from the study's episodes alone.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from matplotlib.figure import Figure

from envs.config import EnvConfig
from jobs.analysis.statistics import CONFIDENCE, Difference, crossed_mean, holm, rate_estimate
from jobs.analysis.tables import estimate_text, markdown_table, percent_text, save_plot
from jobs.config.conditions import NOMINAL
from jobs.config.errors import ConfigError
from jobs.evaluation.group_stats import CHANGE, episode_values
from jobs.evaluation.sweep_plan import Axes, axes_of
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting.breaks import Change, SweptEpisodes, changes_of, replicated
from jobs.reporting.dose_plan import ACTION, check_whole, read_plan
from jobs.reporting.dose_plot import dose_plot
from jobs.reporting.dose_response import (
    DRAWN,
    WORST,
    Dose,
    change_table,
    compare_kinds,
    dose_table,
    doses_of,
    read_doses,
    verdict_table,
    write_doses,
)
from jobs.reporting.planned_page import made_text, write_below_plan
from jobs.reporting.sweep_data import read_data, read_sweep, write_data
from jobs.run.provenance import REPOSITORY
from jobs.run.templates import render

DOSES_TAUGHT = "dose_response_taught"  # name of the experiment, and of what is published of it
TRAINED = REPOSITORY / "conf" / "exp" / "taught_claims.yaml"  # the experiment whose policies are evaluated
TEMPLATE = Path(__file__).parent / "templates" / f"{DOSES_TAUGHT}.md.j2"
FILTER, FILTERED = "filtered", "_filtered"  # the axis of the filter alone, and how the others behind it end
NO_ERROR = "no error"
MARGIN = 0.1  # of success: smaller changes do not matter
ByKind = Mapping[tuple[str, str], np.ndarray]  # group and kind, or axis -> values (trainings, corridors)


class Words(NamedTuple):
    """How a family of tests calls its verdicts: certain below 0, certain above, within the margin."""

    below: str
    above: str
    within: str


ERRORS, FILTERS = Words("costs", "gains", "free"), Words("harms", "helps", "equal")
BEYOND = ("worse", "better")  # invented events, than another kind
UNDECIDED = "undecided"


class Judged(NamedTuple):
    """One test of a family.

    Attributes:
        difference: Of success.
        adjusted_p: Of it, after Holm over its family.
        verdict: One of the family's words, or `UNDECIDED`.
    """

    difference: Difference
    adjusted_p: float
    verdict: str


def mean_success(about: SweepFacts, swept: SweptEpisodes) -> dict[tuple[str, str], np.ndarray]:
    """Group and axis -> success (trainings, corridors), averaged over the doses of the axis."""
    return {
        (group, axis): np.mean(
            [episode_values(swept[(axis, value), group], "success") for value in points], axis=0
        )
        for group in about["groups"]
        for axis, points in about["axes"].items()
    }


def error_changes(success: ByKind) -> dict[tuple[str, str], np.ndarray]:
    """Group and kind of error -> what it changes without a filter, of `mean_success`."""
    return {
        (group, axis): values - success[group, NOMINAL]
        for (group, axis), values in success.items()
        if axis in DRAWN
    }


def filter_changes(success: ByKind) -> dict[tuple[str, str], np.ndarray]:
    """Group and kind of error, or `NO_ERROR` -> what the filter changes under it, of `mean_success`."""
    found = {}
    for (group, axis), values in success.items():
        if axis == FILTER:
            found[group, NO_ERROR] = values - success[group, NOMINAL]
        elif axis.endswith(FILTERED):
            kind = axis.removesuffix(FILTERED)
            found[group, kind] = values - success[group, kind]
    return found


def judge(changes: ByKind, words: Words) -> dict[tuple[str, str], Judged]:
    """Test each change against 0; all are one family (Holm)."""
    differences = {at: crossed_mean(values, CHANGE) for at, values in changes.items()}
    adjusted = holm([1.0 if one.p is None else one.p for one in differences.values()])
    return {
        at: Judged(one, p, _verdict(one, p, words))
        for (at, one), p in zip(differences.items(), adjusted, strict=True)
    }


def _verdict(difference: Difference, adjusted_p: float, words: Words) -> str:
    low, high = difference.interval or (-1.0, 1.0)
    if adjusted_p < 1 - CONFIDENCE and not low <= 0.0 <= high:
        return words.below if high < 0.0 else words.above
    return words.within if low > -MARGIN and high < MARGIN else UNDECIDED


def count_words(verdicts: Sequence[str], words: Sequence[str]) -> dict[str, int]:
    """Verdict -> how many tests have it; none is left out."""
    return {word: verdicts.count(word) for word in (*words, UNDECIDED)}


def counts(
    verdicts: Mapping[tuple[str, str], str], words: Sequence[str], apart: Sequence[str]
) -> list[tuple[bool, dict[str, int]]]:
    """Whether kinds stand apart, because their doses are others -> `count_words` of these.

    Args:
        verdicts: Of each group and kind.
        words: Of the family.
        apart: The kinds that do.
    """
    return [
        (
            is_apart,
            count_words([one for (_, kind), one in verdicts.items() if (kind in apart) == is_apart], words),
        )
        for is_apart in (False, True)
    ]


def judged_table(judged: Mapping[tuple[str, str], Judged]) -> str:
    """Verdict, change [points] and p of each test: a row for each group, a column for each kind."""
    groups, kinds = (list(dict.fromkeys(at[place] for at in judged)) for place in (0, 1))
    lines = [(f"`{group}`", *(_judged_text(judged[group, kind]) for kind in kinds)) for group in groups]
    return markdown_table(("Group", *kinds), lines, len(kinds) + 1)


def _judged_text(one: Judged) -> str:
    verdict = one.verdict if one.verdict == UNDECIDED else f"**{one.verdict}**"
    return f"{verdict}: {estimate_text(one.difference, 100, '+.0f')}, p = {one.adjusted_p:.2g}"


def behind_filter(doses: Sequence[Dose], axes: Axes) -> list[Dose]:
    """The filter alone, and the doses that stand behind it, too: the sensor's errors are the same."""
    alone = [Dose(FILTER, value, 0.0, 0.0, ()) for value in axes[FILTER]]
    return alone + [
        dose._replace(kind=dose.kind + FILTERED)
        for dose in doses
        if dose.value in axes.get(dose.kind + FILTERED, {})
    ]


def kind_text(kind: str) -> str:
    """How the page calls a kind of error, or the same behind the filter."""
    if kind == FILTER:
        return "the filter alone"
    return f"{kind.removesuffix(FILTERED)}, filtered" if kind.endswith(FILTERED) else kind


def draw(about: SweepFacts, swept: SweptEpisodes, doses: Sequence[Dose]) -> Figure:
    """The plot of the study: as that of the first, with what is behind the filter dashed."""
    changes = changes_of(about, swept, every=True)
    errors = {dose.condition: dose.measured for dose in doses}
    plain = [one for one in changes if one.condition in errors]
    return dose_plot(plain, errors, dashed=[_unfiltered(one) for one in changes if _is_filtered(one)])


def _is_filtered(change: Change) -> bool:
    return change.condition[0].endswith(FILTERED)


def _unfiltered(change: Change) -> Change:
    """The change under the name of the condition without the filter."""
    axis, value = change.condition
    return change._replace(condition=(axis.removesuffix(FILTERED), value))


def results_text(about: SweepFacts, swept: SweptEpisodes, doses: Sequence[Dose]) -> str:
    """What stands below the plan."""
    success, changes = mean_success(about, swept), changes_of(about, swept, every=True)
    means = error_changes(success)
    errors, filters = judge(means, ERRORS), judge(filter_changes(success), FILTERS)
    compared, groups = compare_kinds(means), list(about["groups"])
    kinds = list(dict.fromkeys(kind for _, kind in means))
    apart = [dose.kind for dose in doses if dose.asked is None][:1]
    every = [*doses, *behind_filter(doses, about["axes"])]
    return render(
        TEMPLATE,
        made=made_text(about, swept),
        name=DOSES_TAUGHT,
        worst=WORST,
        nominal={group: percent_text(rate_estimate(success[group, NOMINAL])) for group in groups},
        apart=apart,
        margin=f"{100 * MARGIN:.0f}",
        costs=judged_table(errors),
        cost_counts=counts({at: one.verdict for at, one in errors.items()}, ERRORS, apart),
        compared=verdict_table(compared, groups, kinds),
        compared_counts=counts({(one.group, one.kind): one.verdict for one in compared}, BEYOND, apart),
        filters=judged_table(filters),
        filter_counts=count_words([one.verdict for one in filters.values()], FILTERS),
        tests=len(replicated(changes)),
        changes=change_table(changes, every, groups, kind_text),
        doses=dose_table(doses),
    )


def published_text(data: Path) -> str:
    """What stands below the plan of the published study."""
    return results_text(*read_data(data, DOSES_TAUGHT), read_doses(data / f"{DOSES_TAUGHT}_doses.csv"))


def draw_published(data: Path) -> Figure:
    """The plot of the published study."""
    return draw(*read_data(data, DOSES_TAUGHT), read_doses(data / f"{DOSES_TAUGHT}_doses.csv"))


def write_dose_taught(study: Path, docs: Path, env: EnvConfig) -> Path:
    """Write the results below the plan, the plot and the data.

    Args:
        study: The folder that the study has left in its run folder.
        docs: Where the page is, or goes; plot and data into `images` and `data`.
        env: The simulation in which event errors are measured.

    Returns:
        The page.

    Raises:
        ConfigError: If an earlier version wrote the study, or it is not the planned one, complete.
        RunError: If a file of the study is damaged.
    """
    about, swept = read_sweep(study)
    check_study(study, env, about, swept)
    env = dataclasses.replace(env, scene=about["scene"], split="eval")
    plain = {axis: points for axis, points in about["axes"].items() if axis == NOMINAL or axis in DRAWN}
    file = docs / "data" / f"{DOSES_TAUGHT}_doses.csv"
    write_doses(file, doses_of(plain, env, {}))
    doses = read_doses(file)
    text, figure = results_text(about, swept, doses), draw(about, swept, doses)
    write_data(docs / "data", DOSES_TAUGHT, study, swept)
    save_plot(docs / "images" / f"{DOSES_TAUGHT}.png", figure)
    return write_below_plan(docs / f"{DOSES_TAUGHT}.md", text)


def check_study(study: Path, env: EnvConfig, about: SweepFacts, swept: SweptEpisodes) -> None:
    """Check that a study has the trainings, corridors and doses of its plan, and all of its episodes.

    Raises:
        ConfigError: It has not; the message names what it has instead.
    """
    plan = read_plan()
    trained = yaml.safe_load(TRAINED.read_text())["ablation"]
    groups = dict.fromkeys(trained["variants"], trained["seeds"])
    axes = axes_of(plan)
    planned = {"groups": groups, "trials": plan.trials, "action": ACTION, "axes": axes}
    found = {**about, "axes": {name: about["axes"].get(name) for name in axes}}
    for name, asked in planned.items():
        if found.get(name) != asked:
            rule = f"{study} is not the planned study: its {name} must be {asked!r}, got {found.get(name)!r}"
            raise ConfigError(
                f"resume: {rule}; give `python -m platform.launch +exp={DOSES_TAUGHT}` as it stands"
            )
    check_whole(study, env, about, swept)
