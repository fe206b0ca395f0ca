"""Summarise the trainings of a group under a condition: estimates, and their metrics for the tracker."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from jobs.analysis.statistics import Difference, Estimate, crossed_difference, crossed_mean, rate_estimate
from jobs.analysis.tables import estimate_metrics, estimate_text, events_texts, markdown_table, percent_text
from jobs.study.contrasts import reach
from jobs.study.results import RATE, Condition, Results, Trainings, text_of, texts_of, values_of

MET = "°"  # marks a result whose condition lies within the group's training distribution


@dataclass(frozen=True)
class Summary:
    """One group under one condition.

    Attributes:
        condition: The condition.
        group: The group.
        trainings: Training seeds that were evaluated; None for a baseline.
        episodes: Number of episodes of all trainings [-].
        success: Fraction of episodes that reached the goal.
        distance_m: Mean forward distance without collision [m].
        success_difference: Difference of success to the reference group in the same corridors; None: there
            is no reference.
        distance_difference_m: Difference of distance to the reference group [m].
        events_per_step: Mean events of a control step [-]; 0 for an agent that sees none.
        dropped: Events in all episodes that did not fit into a window or a pixel [-].
    """

    condition: Condition
    group: str
    trainings: tuple[int | None, ...]
    episodes: int
    success: Estimate
    distance_m: Difference
    success_difference: Difference | None
    distance_difference_m: Difference | None
    events_per_step: float
    dropped: int

    @property
    def name(self) -> str:
        """Return condition and group: "control_hz=45 bytestream"."""
        return f"{self.condition[0]}={text_of(self.condition[1])} {self.group}"


def summarise(at: Condition, group: str, trainings: Trainings, reference: Trainings | None = None) -> Summary:
    """Summarise one group under one condition.

    Args:
        at: The condition.
        group: The group.
        trainings: EPISODE (n,) of each training, in the same corridors.
        reference: EPISODE (n,) of each training of the reference group.
    """
    success, distance = values_of(trainings, "success"), values_of(trainings, "distance_m")
    differences: list[Difference | None] = [None, None]
    if reference:
        theirs = values_of(reference, "distance_m")
        differences = [
            crossed_difference(success, values_of(reference, "success"), RATE),
            crossed_difference(distance, theirs, reach(distance, theirs)),
        ]
    return Summary(
        condition=at,
        group=group,
        trainings=tuple(trainings),
        episodes=success.size,
        success=rate_estimate(success),
        distance_m=crossed_mean(distance, reach(distance)),
        success_difference=differences[0],
        distance_difference_m=differences[1],
        events_per_step=float(values_of(trainings, "events_per_step").mean()),
        dropped=int(values_of(trainings, "dropped").sum()),
    )


def summaries_of(results: Results) -> list[Summary]:
    """Summarise every group under every condition in which it was evaluated."""
    reference = str(results.facts.get("reference"))
    return [
        summarise(at, group, results.cells[at, group],
                  results.cells.get((at, reference)) if group != reference else None)
        for at in results.conditions
        for group in results.groups
        if (at, group) in results.cells
    ]  # fmt: skip


def success_lines(
    found: Sequence[Summary],
    results: Results,
    conditions: Sequence[Condition],
    gaps: Mapping[tuple[Condition, str], str] | None = None,
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return headings and lines of success [%] with intervals: a line per condition, a column per group.

    Args:
        found: Summaries of the evaluated groups.
        results: The study, which determines the groups.
        conditions: The conditions to show.
        gaps: Condition and group -> text of an empty cell; by default "-".
    """
    cells = dict(gaps or {})
    for one in found:
        at = one.condition, one.group
        cells[at] = percent_text(one.success) + (MET if at in results.met else "")
    lines = [(*texts_of(at), *(cells.get((at, group), "-") for group in results.groups)) for at in conditions]
    return ("Axis", "Value", *results.groups), lines


def details_table(found: Sequence[Summary], reference: str) -> str:
    """Return every estimate as a Markdown table."""
    own = ("Axis", "Value", "Group", "Trainings", "Episodes", "Success [%]", "Distance [m]")
    head = (*own, f"Success - {reference}", f"Distance - {reference} [m]", "Events/step", "Dropped")
    lines = [
        (
            *texts_of(one.condition),
            one.group,
            str(len(one.trainings)),
            str(one.episodes),
            percent_text(one.success),
            estimate_text(one.distance_m),
            estimate_text(one.success_difference, 100, "+.0f"),
            estimate_text(one.distance_difference_m, 1, "+.1f"),
            *events_texts(one.events_per_step, one.dropped),
        )
        for one in found
    ]
    return markdown_table(head, lines, 3)


def metrics_of(one: Summary) -> dict[str, float]:
    """Return a summary as metrics, without unknown ones."""
    metrics = {
        **estimate_metrics("eval/success_rate", one.success),
        **estimate_metrics("eval/distance_m", one.distance_m),
        **estimate_metrics("sweep/success_difference", one.success_difference),
        **estimate_metrics("sweep/distance_difference_m", one.distance_difference_m),
    }
    if one.events_per_step > 0.0:
        metrics |= {"sim/events_per_step": one.events_per_step, "sim/dropped_events": float(one.dropped)}
    value = one.condition[1]  # the x axis of a chart over runs
    return metrics if isinstance(value, str) else {**metrics, "sweep/value": value}


def columns_of(found: Sequence[Summary]) -> dict[str, list[str | float]]:
    """Return the summaries as columns of a tracker's table; the first (condition and group) is unique."""
    metrics = [metrics_of(one) for one in found]
    names = dict.fromkeys(name for values in metrics for name in values)
    return {
        "condition": [one.name for one in found],
        "axis": [one.condition[0] for one in found],
        "value": [text_of(one.condition[1]) for one in found],
        "group": [one.group for one in found],
        "trainings": [len(one.trainings) for one in found],
        "episodes": [one.episodes for one in found],
        **{name: [values.get(name, float("nan")) for values in metrics] for name in names},
    }


def axis_curves(axis: str, numbers: Sequence[float], found: Sequence[Summary]) -> dict[str, dict[int, float]]:
    """Return success and distance of a group along an axis as curves of a tracker, whose steps are integers.

    Args:
        axis: Name of the axis.
        numbers: Values of the axis.
        found: Summaries of one group along this axis.

    Returns:
        Metric -> step -> value. The step is the axis value; if it is not an integer, the value in per cent or
        per mille, named in the metric. Empty if none of these gives integers.
    """
    for scale, unit in ((1, ""), (100, "_percent"), (1000, "_permille")):
        if all(math.isclose(round(scale * number), scale * number) for number in numbers):
            points = {round(scale * float(one.condition[1])): one for one in found}
            return {
                f"sweep/{axis}{unit}_success": {x: one.success.value for x, one in points.items()},
                f"sweep/{axis}{unit}_distance_m": {x: one.distance_m.value for x, one in points.items()},
            }
    return {}
