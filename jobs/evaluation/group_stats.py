"""What the trainings of a group achieved under each condition of a sweep, as rows, tables and metrics."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from jobs.analysis.statistics import (
    Estimate,
    Interval,
    interquartile_mean,
    paired_difference,
    two_stage_estimate,
    wilson_interval,
)
from jobs.analysis.tables import (
    estimate_metrics,
    estimate_text,
    events_texts,
    markdown_table,
    percent_text,
)

Condition = tuple[str, str]  # axis and value
LABELS = ("Axis", "Value", "Group", "Training")
Flights = Mapping[int | None, np.ndarray]  # training seed -> EPISODE of the same corridors


@dataclass(frozen=True)
class Row:
    """One group under one condition.

    Attributes:
        condition: Axis and value.
        group: What was trained.
        trainings: Training seeds that flew; a bound has None.
        flights: Of all of them [-].
        success: Fraction that reached the goal, two-stage interval.
        wilson: The Wilson interval of the same, as if flights were independent.
        distance_m: Mean forward distance without collision [m].
        middle_m: Interquartile mean of the distance [m].
        success_difference: To the reference group on the same corridors; None: there is none.
        distance_difference_m: The same of the distance [m].
        events_per_step: Mean events of a control step [-]; 0 for an agent that sees none.
        dropped: Events that did not fit into a window or a pixel, all flights [-].
    """

    condition: Condition
    group: str
    trainings: tuple[int | None, ...]
    flights: int
    success: Estimate
    wilson: Interval
    distance_m: Estimate
    middle_m: Estimate
    success_difference: Estimate | None
    distance_difference_m: Estimate | None
    events_per_step: float
    dropped: int

    @property
    def success_interval(self) -> Interval:
        """From the lower end of both intervals of success to the upper.

        Wilson's alone would not see that trainings differ, the bootstrap alone would give none
        where all flights succeed or fail.
        """
        low, high = self.success.interval or self.wilson
        return min(low, self.wilson[0]), max(high, self.wilson[1])


def summarise_group(
    condition: Condition, group: str, flown: Flights, reference: Flights | None = None
) -> Row:
    """The row of one group under one condition; a fixed generator draws the resamples.

    Args:
        condition: Axis and value.
        group: What was trained.
        flown: EPISODE (n,) of each training, of the same corridors.
        reference: The same of the group to compare with.
    """
    success, distance = table_of(flown, "success"), table_of(flown, "distance_m")
    differences: list[Estimate | None] = [None, None]
    if reference:
        differences = [
            paired_difference(ours, table_of(reference, name), np.random.default_rng(0))
            for ours, name in ((success, "success"), (distance, "distance_m"))
        ]
    return Row(
        condition=condition,
        group=group,
        trainings=tuple(flown),
        flights=success.size,
        success=two_stage_estimate(success, np.random.default_rng(0)),
        wilson=wilson_interval(int(success.sum()), success.size),
        distance_m=two_stage_estimate(distance, np.random.default_rng(0)),
        middle_m=two_stage_estimate(distance, np.random.default_rng(0), interquartile_mean),
        success_difference=differences[0],
        distance_difference_m=differences[1],
        events_per_step=float(table_of(flown, "events_per_step").mean()),
        dropped=int(table_of(flown, "dropped").sum()),
    )


def table_of(flown: Flights, name: str) -> np.ndarray:
    """One column of EPISODE as float64 (trainings, corridors).

    Raises:
        ValueError: If two trainings did not fly the same corridors.
    """
    trainings = list(flown.values())
    if any(not np.array_equal(episodes["seed"], trainings[0]["seed"]) for episodes in trainings):
        raise ValueError(f"trainings {list(flown)} must have flown the same corridors; fly what is missing")
    return np.stack([episodes[name].astype(np.float64) for episodes in trainings])


def matrix(
    rows: Sequence[Row],
    conditions: Sequence[Condition],
    groups: Sequence[str],
    gaps: Mapping[tuple[str, str, str], str],
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Conditions x groups, as headings and lines: success [%] with its interval.

    Args:
        rows: What was flown.
        conditions: One line each.
        groups: One column each.
        gaps: What stands in an empty place, by axis, value and group; nothing flown is "-".
    """
    found = dict(gaps)
    found |= {(*row.condition, row.group): success_text(row) for row in rows}
    lines = [(*place, *(found.get((*place, group), "-") for group in groups)) for place in conditions]
    return ("Axis", "Value", *groups), lines


def details(rows: Sequence[Row], reference: str) -> str:
    """Every row with all its estimates as a Markdown table."""
    flown = ("Axis", "Value", "Group", "Trainings", "Flights", "Success [%]", "Distance [m]")
    compared = ("Middle half [m]", f"Success - {reference}", f"Distance - {reference} [m]")
    head = (*flown, *compared, "Events/step", "Dropped")
    lines = [
        (
            *row.condition,
            row.group,
            str(len(row.trainings)),
            str(row.flights),
            success_text(row),
            estimate_text(row.distance_m),
            estimate_text(row.middle_m),
            estimate_text(row.success_difference, 100, "+.0f"),
            estimate_text(row.distance_difference_m, 1, "+.1f"),
            *events_texts(row.events_per_step, row.dropped),
        )
        for row in rows
    ]
    return markdown_table(head, lines, 3)


def success_text(row: Row) -> str:
    """The success rate [%] with its interval."""
    return percent_text(Estimate(row.success.value, row.success_interval))


def columns(rows: Sequence[Row]) -> dict[str, list[str | float]]:
    """The rows as columns for a tracker; the first, all labels joined, is unique."""
    found: dict[str, list[str | float]] = {
        "condition": [f"{name_of(row.condition)} {row.group}" for row in rows],
        "axis": [row.condition[0] for row in rows],
        "value": [row.condition[1] for row in rows],
        "group": [row.group for row in rows],
        "trainings": [len(row.trainings) for row in rows],
        "flights": [row.flights for row in rows],
    }
    figures = [metrics(row) for row in rows]
    names = dict.fromkeys(name for values in figures for name in values)
    return found | {name: [values.get(name, float("nan")) for values in figures] for name in names}


def name_of(condition: Condition) -> str:
    """A condition in one word: "control_hz=45"."""
    return "=".join(condition)


def metrics(row: Row) -> dict[str, float]:
    """The figures of a row under the names that trackers and tables share; what is not known is left out."""
    low, high = row.success_interval
    figures = {
        "eval/success_rate": row.success.value,
        "eval/success_rate_low": low,
        "eval/success_rate_high": high,
        **estimate_metrics("eval/distance_m", row.distance_m),
        **estimate_metrics("sweep/middle_half_m", row.middle_m),
        **estimate_metrics("sweep/success_difference", row.success_difference),
        **estimate_metrics("sweep/distance_difference_m", row.distance_difference_m),
    }
    if row.events_per_step > 0.0:
        figures |= {"sim/events_per_step": row.events_per_step, "sim/dropped_events": float(row.dropped)}
    try:
        return {**figures, "sweep/value": float(row.condition[1])}  # the x axis of a chart over runs
    except ValueError:  # the value is a word
        return figures


def axis_curves(axis: str, numbers: Mapping[str, float], rows: Sequence[Row]) -> dict[str, dict[int, float]]:
    """Success and distance of one group along an axis, as curves of a tracker, whose steps are integers.

    Args:
        axis: Its name.
        numbers: Value as text -> number, as `jobs.config.conditions.axis_numbers` gives them.
        rows: Of this axis and one group.

    Returns:
        Metric -> step -> value. The step is the axis value, in per cent or per mille where it must
        be to be whole, which the metric's name then says; no curve if even these are not.
    """
    for scale, unit in ((1, ""), (100, "_percent"), (1000, "_permille")):
        steps = {value: round(scale * number) for value, number in numbers.items()}
        if all(math.isclose(steps[value], scale * numbers[value]) for value in numbers):
            points = {steps[row.condition[1]]: row for row in rows}
            return {
                f"sweep/{axis}{unit}_success": {x: row.success.value for x, row in points.items()},
                f"sweep/{axis}{unit}_distance_m": {x: row.distance_m.value for x, row in points.items()},
            }
    return {}
