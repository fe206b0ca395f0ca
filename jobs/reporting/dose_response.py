"""The page of the dose-response study: which kind of wrong events costs most, at the same event error.

The plan stands on the page and is left as it is; what is below it is written from the sweep's episodes alone.
"""

import csv
import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from envs.config import EnvConfig
from envs.event_error import error_between
from jobs.analysis.statistics import CONFIDENCE, Difference, crossed_mean, holm
from jobs.analysis.tables import estimate_text, markdown_table, save_plot, write_csv
from jobs.config.conditions import NOMINAL
from jobs.config.env_keys import env_with
from jobs.evaluation.group_stats import MET, Condition, TrainingEpisodes, episode_values
from jobs.evaluation.sweep_plan import Axes
from jobs.evaluation.sweep_report import SweepFacts
from jobs.reporting.breaks import CHANGE, Change, SweptEpisodes, changes_of, replicated
from jobs.reporting.dose_plan import PLAN, check_planned, read_plan
from jobs.reporting.dose_plot import dose_plot
from jobs.reporting.planned_page import made_text, write_below_plan
from jobs.reporting.sweep_data import read_data, read_sweep, replaced_text, write_data
from jobs.rollout.policies import PRETRAINED
from jobs.run.files import read_json
from jobs.run.templates import render
from models.policy.policy import MANIFEST

DOSES = "dose_response"  # name of the experiment, and of what is published of it
WORST = "invented"  # the kind that the plan compares with the others
CLOSE = 1.5  # ratio of two measured event errors up to which doses of two kinds are shown side by side
TEMPLATE = Path(__file__).parent / "templates" / f"{DOSES}.md.j2"
DATA = ("Axis", "Value", "asked_event_error", "measured_event_error", "met_by")
# Settings that make errors of a kind in a training: their shares are comparable with those of the sweep.
DRAWN = {
    "lost": ("faults.event_dropout", "faults.sparsity"),
    "displaced": ("faults.displaced",),
    "flipped": ("faults.flipped",),
    "invented": ("faults.background_activity",),
    "jittered": ("camera.latency_jitter_us",),
}


class Dose(NamedTuple):
    """One condition of the study.

    Attributes:
        kind: Of the error: the axis.
        value: Of the setting, as text.
        asked: Event error that it stands for; None for jitter, whose event error is only measured.
        measured: Event error against the same sensor without any.
        met_by: Groups whose trainings drew as much of the kind.
    """

    kind: str
    value: str
    asked: float | None
    measured: float
    met_by: tuple[str, ...]

    @property
    def condition(self) -> Condition:
        """Axis and value."""
        return self.kind, self.value


class Verdicts(NamedTuple):
    """Of comparisons of invented events with some kinds: how many, and how many are worse and better."""

    tests: int
    worse: int
    better: int


class Compared(NamedTuple):
    """What invented events cost a group more than events of another kind, over all doses.

    Attributes:
        group: What was trained.
        kind: The other kind.
        difference: Of the two changes of success, averaged over the doses.
        adjusted_p: Of it, after Holm over groups and kinds.
        verdict: "worse" and "better" are certain in this family, and by the interval.
    """

    group: str
    kind: str
    difference: Difference
    adjusted_p: float
    verdict: Literal["worse", "better", "undecided"]


def asked_error(kind: str, amount: float) -> float | None:
    """Event error of a kind of error, for events that find no other partner by chance.

    Of N true events, N * amount are lost, displaced, turned or added, each on its own; the events of both
    streams without a partner are counted against all of both.

    Args:
        kind: One of `DRAWN`.
        amount: Its setting: a share, or false events per true event.
    """
    closed = {"lost": amount / (2 - amount), "invented": amount / (2 + amount)}
    return None if kind == "jittered" else closed.get(kind, amount)


def doses_of(axes: Axes, env: EnvConfig, conditions: Mapping[str, Sequence[Mapping[str, Any]]]) -> list[Dose]:
    """The conditions of the study, with the event errors that they stand for and that are measured.

    Args:
        axes: Of the sweep.
        env: Its simulation with nothing changed.
        conditions: Group -> what its trainings drew (`TrainConfig.conditions`).
    """
    found = []
    for kind, points in axes.items():
        for value, changes in points.items() if kind != NOMINAL else ():
            amount = float(next(iter(changes.values())))  # type: ignore[arg-type]
            most = {group: largest_drawn(kind, own) for group, own in conditions.items()}
            met = tuple(group for group in most if _as_much(kind, most[group], amount))
            measured = error_between(env_with(env, changes), env)
            found.append(Dose(kind, value, asked_error(kind, amount), measured, met))
    return found


def _as_much(kind: str, most: float, amount: float) -> bool:
    """Whether an amount is not beyond the largest that was drawn."""
    return 0.0 < amount <= most if kind in DRAWN else False


def largest_drawn(kind: str, conditions: Sequence[Mapping[str, Any]]) -> float:
    """The largest amount of a kind of error that conditions of a training draw; 0: it met none."""
    settings = [condition.get(key, 0.0) for condition in conditions for key in DRAWN.get(kind, ())]
    ends = [one.values() if isinstance(one, Mapping) else one if isinstance(one, list) else [one]
            for one in settings]  # fmt: skip
    return max((float(end) for several in ends for end in several if not isinstance(end, bool)), default=0.0)


def drawn_conditions(
    groups: Mapping[str, Sequence[int | None]], pretrained: Path
) -> dict[str, list[dict[str, Any]]]:
    """Group -> what its published trainings drew; nothing for groups that are not published."""
    found = {}
    for group, seeds in groups.items():
        file = pretrained / f"{group}-s{seeds[0]}" / MANIFEST
        manifest = read_json(file) if file.is_file() else {}
        older = manifest.get("train", {}).get("conditions", [])  # of the first versions
        found[group] = list(manifest.get("conditions") or older)
    return found


def over_doses(changes: Sequence[Change], doses: Sequence[Dose], swept: SweptEpisodes) -> dict[Any, Any]:
    """Group and kind -> change of success (trainings, corridors), averaged over the doses of the kind."""
    found: dict[tuple[str, str], np.ndarray] = {}
    for group in dict.fromkeys(change.group for change in changes):
        for kind in dict.fromkeys(dose.kind for dose in doses):
            own = [one for one in changes if (one.group, one.condition[0]) == (group, kind)]
            each = [_success(swept[one.condition, group]) - _success(swept[one.baseline, group])
                    for one in own]  # fmt: skip
            found[group, kind] = np.mean(each, axis=0)
    return found


def _success(trainings: TrainingEpisodes) -> np.ndarray:
    return episode_values(trainings, "success")


def compare_kinds(means: Mapping[tuple[str, str], np.ndarray]) -> list[Compared]:
    """Compare invented events with each other kind in each group; all of these tests are one family (Holm).

    Args:
        means: Group and kind -> change of success (trainings, corridors), of `over_doses`.
    """
    places = [(group, kind) for group, kind in means if kind != WORST and (group, WORST) in means]
    differences = [crossed_mean(means[group, WORST] - means[group, kind], CHANGE) for group, kind in places]
    adjusted = holm([1.0 if one.p is None else one.p for one in differences])
    return [
        Compared(*place, one, p, _verdict(one, p))
        for place, one, p in zip(places, differences, adjusted, strict=True)
    ]


def count_verdicts(compared: Sequence[Compared], kinds: Collection[str]) -> Verdicts:
    """Count the verdicts against some kinds."""
    own = [one.verdict for one in compared if one.kind in kinds]
    return Verdicts(len(own), own.count("worse"), own.count("better"))


def mean_errors(doses: Sequence[Dose]) -> dict[str, float]:
    """Kind -> measured event error, mean over its doses."""
    kinds = dict.fromkeys(dose.kind for dose in doses)
    return {kind: float(np.mean([one.measured for one in doses if one.kind == kind])) for kind in kinds}


def close_pairs(doses: Sequence[Dose]) -> list[tuple[Dose, Dose]]:
    """Doses that stand for no asked error, each with the nearest one of invented events if that is close."""
    worst = [dose for dose in doses if dose.kind == WORST]
    others = [dose for dose in doses if dose.asked is None] if worst else []
    pairs = [(one, min(worst, key=lambda dose: abs(dose.measured - one.measured))) for one in others]
    return [pair for pair in pairs if _ratio(*pair) <= CLOSE]


def _ratio(one: Dose, other: Dose) -> float:
    low, high = sorted((one.measured, other.measured))
    return high / low if low else math.inf


def _verdict(difference: Difference, adjusted_p: float) -> Literal["worse", "better", "undecided"]:
    low, high = difference.interval or (-1.0, 1.0)
    if adjusted_p >= 1 - CONFIDENCE or low <= 0.0 <= high:
        return "undecided"
    return "worse" if high < 0.0 else "better"


def write_dose_response(
    sweep: Path, docs: Path, env: EnvConfig, pretrained: Path = PRETRAINED, plan: Path = PLAN
) -> Path:
    """Write the results below the plan, the plot and the data.

    Args:
        sweep: The folder that the sweep has left in its run folder.
        docs: Where the page is, or goes; plot and data into `images` and `data`.
        env: The simulation in which event errors are measured; it must be that of the sweep.
        pretrained: Where the published policies are, which say what they met in training.
        plan: The settings of the planned sweep.

    Returns:
        The page.

    Raises:
        ConfigError: If an earlier version wrote the sweep, or it is not the planned one, complete.
        RunError: If a file of the sweep is damaged.
    """
    about, swept = read_sweep(sweep)
    check_planned(sweep, env, about, swept, read_plan(plan), pretrained)
    env = dataclasses.replace(env, scene=about["scene"], split="eval")
    doses = doses_of(about["axes"], env, drawn_conditions(about["groups"], pretrained))
    write_data(docs / "data", DOSES, sweep, swept)
    table = docs / "data" / f"{DOSES}_doses.csv"
    write_doses(table, doses)
    doses, changes = read_doses(table), changes_of(about, swept, every=True)  # the plan names all of them
    save_plot(docs / "images" / f"{DOSES}.png", draw(doses, changes))
    return write_below_plan(docs / f"{DOSES}.md", results_text(about, swept, doses, changes))


def published_text(data: Path) -> str:
    """What stands below the plan of the published study."""
    about, swept = read_data(data, DOSES)
    doses = read_doses(data / f"{DOSES}_doses.csv")
    return results_text(about, swept, doses, changes_of(about, swept, every=True))


def write_doses(file: Path, doses: Sequence[Dose]) -> None:
    """Write the table of the doses, which `read_doses` reads."""
    rows = [
        (*one.condition, "" if one.asked is None else f"{one.asked:.4f}", f"{one.measured:.4f}",
         " ".join(one.met_by))
        for one in doses
    ]  # fmt: skip
    write_csv(file, DATA, rows)


def read_doses(file: Path) -> list[Dose]:
    """The published table of the doses."""
    with file.open() as stream:
        rows = list(csv.DictReader(stream))
    return [
        Dose(
            row["Axis"], row["Value"], float(row["asked_event_error"]) if row["asked_event_error"] else None,
            float(row["measured_event_error"]), tuple(row["met_by"].split()),
        )
        for row in rows
    ]  # fmt: skip


def draw(doses: Sequence[Dose], changes: Sequence[Change]) -> Any:
    """The plot of the study, see `dose_plot`."""
    errors = {dose.condition: dose.measured for dose in doses}
    met = {(*dose.condition, group) for dose in doses for group in dose.met_by}
    return dose_plot(changes, errors, met)


def results_text(
    about: SweepFacts, swept: SweptEpisodes, doses: Sequence[Dose], changes: Sequence[Change]
) -> str:
    """What stands below the plan."""
    means = over_doses(changes, doses, swept)
    compared = compare_kinds(means)
    kinds = list(dict.fromkeys(dose.kind for dose in doses))
    groups = list(dict.fromkeys(change.group for change in changes))
    apart = list(dict.fromkeys(dose.kind for dose in doses if dose.asked is None))
    same = [kind for kind in kinds if kind not in (*apart, WORST)]
    return render(
        TEMPLATE,
        made=made_text(about, swept),
        replaced=replaced_text(about["commit"]),
        means=means_table(means, groups, kinds),
        verdicts=verdict_table(compared, groups, kinds),
        worst=WORST,
        same=same,
        at_dose=count_verdicts(compared, same),
        apart=[(kind, count_verdicts(compared, [kind])) for kind in apart],
        errors={kind: f"{100 * error:.1f}" for kind, error in mean_errors(doses).items()},
        pairs=pair_table(changes, close_pairs(doses), groups),
        family=len(compared),
        losses={kind: sum(_loss(one) for one in changes if one.condition[0] == kind) for kind in kinds},
        tests=len(replicated(changes)),
        alone=sum(len(change.broken) for change in changes),
        broken=broken_table(changes, groups, kinds),
        changes=change_table(changes, doses, groups),
        doses=dose_table(doses),
        met=MET,
        beyond=", ".join(sorted({one.kind for one in doses if one.asked is not None and _beyond(one)})),
    )


def _loss(change: Change) -> bool:
    return change.certain and change.difference.value < 0


def _beyond(dose: Dose) -> bool:
    """Whether what was measured differs from what was asked by more than a tenth of it."""
    return not math.isclose(dose.measured, dose.asked or 0.0, rel_tol=0.1)


def broken_table(changes: Sequence[Change], groups: Sequence[str], kinds: Sequence[str]) -> str:
    """How often a training loses for certain, of all of its group at all doses of a kind."""

    def cell(group: str, kind: str) -> str:
        own = [one.broken for one in changes if one.group == group and one.condition[0] == kind]
        return f"{sum(int(broken.sum()) for broken in own)} of {sum(map(len, own))}"

    lines = [(f"`{group}`", *(cell(group, kind) for kind in kinds)) for group in groups]
    return markdown_table(("Group", *kinds), lines)


def means_table(
    means: Mapping[tuple[str, str], np.ndarray], groups: Sequence[str], kinds: Sequence[str]
) -> str:
    """Change of success [points] by group and kind, averaged over the doses."""
    lines = [
        (f"`{group}`", *(estimate_text(_mean(means.get((group, kind))), 100, "+.0f") for kind in kinds))
        for group in groups
    ]
    return markdown_table(("Group", *kinds), lines)


def _mean(values: np.ndarray | None) -> Difference | None:
    return None if values is None else crossed_mean(values, CHANGE)


def verdict_table(compared: Sequence[Compared], groups: Sequence[str], kinds: Sequence[str]) -> str:
    """Invented events against each other kind, by group: difference [points], p and verdict."""
    found = {(one.group, one.kind): one for one in compared}
    others = [kind for kind in kinds if kind != WORST]
    lines = [
        (f"`{group}`", *(_verdict_text(found.get((group, kind))) for kind in others)) for group in groups
    ]
    return markdown_table(("Group", *(f"against {kind}" for kind in others)), lines, len(others) + 1)


def _verdict_text(one: Compared | None) -> str:
    if one is None:
        return "-"
    verdict = one.verdict if one.verdict == "undecided" else f"**{one.verdict}**"
    alone = "" if one.difference.p is None else f"; {one.difference.p:.2g} alone"
    return f"{verdict}: {estimate_text(one.difference, 100, '+.0f')}, p = {one.adjusted_p:.2g}{alone}"


def change_table(
    changes: Sequence[Change],
    doses: Sequence[Dose],
    groups: Sequence[str],
    text: Callable[[str], str] = str,
) -> str:
    """Every change of success [points], by condition and group; certain ones in bold.

    Args:
        changes: Of the study.
        doses: Its conditions.
        groups: What was trained.
        text: How a kind is called.
    """
    found = {(one.condition, one.group): one for one in changes}
    lines = [
        (
            text(dose.kind),
            f"{100 * dose.measured:.1f}",
            *(_change_text(found.get((dose.condition, group)), group in dose.met_by) for group in groups),
        )
        for dose in doses
    ]
    return markdown_table(("Kind", "Event error [%]", *(f"`{group}`" for group in groups)), lines)


def _change_text(change: Change | None, met: bool) -> str:
    if change is None:
        return "-"
    text = estimate_text(change.difference, 100, "+.0f")
    return (f"**{text}**" if change.certain else text) + (MET if met else "")


def pair_table(changes: Sequence[Change], pairs: Sequence[tuple[Dose, Dose]], groups: Sequence[str]) -> str:
    """Changes of success [points] at pairs of doses, side by side; "" if there are none."""
    found = {(one.condition, one.group): one for one in changes}
    every = [dose for pair in pairs for dose in pair]
    head = ("Group", *(f"{dose.kind}, {100 * dose.measured:.1f} %" for dose in every))
    lines = [
        (
            f"`{group}`",
            *(_change_text(found.get((dose.condition, group)), group in dose.met_by) for dose in every),
        )
        for group in groups
    ]
    return markdown_table(head, lines) if pairs else ""


def dose_table(doses: Sequence[Dose]) -> str:
    """What each dose is: its setting, the event error asked and measured, and who met as much, if anyone."""
    lines = [
        (
            dose.kind,
            dose.value,
            "-" if dose.asked is None else f"{100 * dose.asked:.0f}",
            f"{100 * dose.measured:.1f}",
            ", ".join(f"`{group}`" for group in dose.met_by) or "-",
        )
        for dose in doses
    ]
    head = ("Kind", "Setting", "asked [%]", "measured [%]", "met by")
    shown = len(head) if any(dose.met_by for dose in doses) else len(head) - 1
    return markdown_table(head[:shown], [line[:shown] for line in lines])
