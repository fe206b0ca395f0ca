"""Statistics of a sweep: what the trainings of a group achieved under each condition."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from envs.scene import Scene
from jobs.analysis.statistics import (
    Difference,
    Estimate,
    Interval,
    crossed_difference,
    crossed_mean,
    rate_estimate,
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
TrainingEpisodes = Mapping[int | None, np.ndarray]  # training seed -> EPISODE of the same corridors
RATE = (0.0, 1.0)  # bounds of a rate
CHANGE = (-1.0, 1.0)  # of what changes a rate
MET = "°"  # behind a result whose condition lies within what the group was trained on


@dataclass(frozen=True)
class GroupResult:
    """One group under one condition.

    Attributes:
        condition: Axis and value.
        group: What was trained.
        trainings: Training seeds that were evaluated; a baseline has None.
        episodes: Of all of them [-].
        success: Fraction that reached the goal.
        distance_m: Mean forward distance without collision [m].
        success_difference: To the reference group on the same corridors; None: there is none.
        distance_difference_m: The same of the distance [m].
        events_per_step: Mean events of a control step [-]; 0 for an agent that sees none.
        dropped: Events that did not fit into a window or a pixel, all episodes [-].
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
        """Condition and group: "control_hz=45 bytestream"."""
        return f"{'='.join(self.condition)} {self.group}"


def summarise_group(
    condition: Condition,
    group: str,
    trainings: TrainingEpisodes,
    reference: TrainingEpisodes | None = None,
) -> GroupResult:
    """The result of one group under one condition.

    Args:
        condition: Axis and value.
        group: What was trained.
        trainings: EPISODE (n,) of each training, of the same corridors.
        reference: The same of the group to compare with.
    """
    success, distance = episode_values(trainings, "success"), episode_values(trainings, "distance_m")
    differences: list[Difference | None] = [None, None]
    if reference:
        theirs = episode_values(reference, "distance_m")
        differences = [
            crossed_difference(success, episode_values(reference, "success"), RATE),
            crossed_difference(distance, theirs, reach(distance, theirs)),
        ]
    return GroupResult(
        condition=condition,
        group=group,
        trainings=tuple(trainings),
        episodes=success.size,
        success=rate_estimate(success),
        distance_m=crossed_mean(distance, reach(distance)),
        success_difference=differences[0],
        distance_difference_m=differences[1],
        events_per_step=float(episode_values(trainings, "events_per_step").mean()),
        dropped=int(episode_values(trainings, "dropped").sum()),
    )


def reach(*distances_m: np.ndarray) -> Interval:
    """The least and the greatest distance that an episode can have [m]; the goal line is at the latter."""
    return 0.0, max(Scene.length_m, *(float(own.max()) for own in distances_m))


def episode_values(trainings: TrainingEpisodes, name: str) -> np.ndarray:
    """One column of EPISODE as float64 (trainings, corridors).

    Raises:
        ValueError: If two trainings were evaluated in different corridors.
    """
    every = list(trainings.values())
    if any(not np.array_equal(episodes["seed"], every[0]["seed"]) for episodes in every):
        raise ValueError(
            f"trainings {list(trainings)} must have the same corridors; evaluate what is missing"
        )
    return np.stack([episodes[name].astype(np.float64) for episodes in every])


def success_table(
    results: Sequence[GroupResult],
    conditions: Sequence[Condition],
    groups: Sequence[str],
    gaps: Mapping[tuple[str, str, str], str],
    met: Collection[tuple[str, str, str]] = (),
) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Conditions x groups, as headings and lines: success [%] with its interval.

    Args:
        results: What was evaluated.
        conditions: One line each.
        groups: One column each.
        gaps: Axis, value and group -> what stands in an empty place; by default "-".
        met: Axis, value and group of results that `MET` marks.
    """
    found = dict(gaps)
    for result in results:
        place = *result.condition, result.group
        found[place] = success_text(result) + (MET if place in met else "")
    lines = [(*place, *(found.get((*place, group), "-") for group in groups)) for place in conditions]
    return ("Axis", "Value", *groups), lines


def details_table(results: Sequence[GroupResult], reference: str) -> str:
    """Every result with all its estimates as a Markdown table."""
    own = ("Axis", "Value", "Group", "Trainings", "Episodes", "Success [%]", "Distance [m]")
    compared = (f"Success - {reference}", f"Distance - {reference} [m]")
    head = (*own, *compared, "Events/step", "Dropped")
    lines = [
        (
            *result.condition,
            result.group,
            str(len(result.trainings)),
            str(result.episodes),
            success_text(result),
            estimate_text(result.distance_m),
            estimate_text(result.success_difference, 100, "+.0f"),
            estimate_text(result.distance_difference_m, 1, "+.1f"),
            *events_texts(result.events_per_step, result.dropped),
        )
        for result in results
    ]
    return markdown_table(head, lines, 3)


def success_text(result: GroupResult) -> str:
    """The success rate [%] with its interval."""
    return percent_text(result.success)


def result_columns(results: Sequence[GroupResult]) -> dict[str, list[str | float]]:
    """The results as columns of a tracker's table; the first, condition and group, is unique."""
    metrics = [result_metrics(result) for result in results]
    names = dict.fromkeys(name for values in metrics for name in values)
    return {
        "condition": [result.name for result in results],
        "axis": [result.condition[0] for result in results],
        "value": [result.condition[1] for result in results],
        "group": [result.group for result in results],
        "trainings": [len(result.trainings) for result in results],
        "episodes": [result.episodes for result in results],
        **{name: [values.get(name, float("nan")) for values in metrics] for name in names},
    }


def result_metrics(result: GroupResult) -> dict[str, float]:
    """Metrics under the names that trackers and tables share; what is not known is left out."""
    metrics = {
        **estimate_metrics("eval/success_rate", result.success),
        **estimate_metrics("eval/distance_m", result.distance_m),
        **estimate_metrics("sweep/success_difference", result.success_difference),
        **estimate_metrics("sweep/distance_difference_m", result.distance_difference_m),
    }
    if result.events_per_step > 0.0:
        metrics["sim/events_per_step"] = result.events_per_step
        metrics["sim/dropped_events"] = float(result.dropped)
    try:
        return {**metrics, "sweep/value": float(result.condition[1])}  # the x axis of a chart over runs
    except ValueError:  # the value is a word
        return metrics


def axis_curves(
    axis: str, numbers: Mapping[str, float], results: Sequence[GroupResult]
) -> dict[str, dict[int, float]]:
    """Success and distance of one group along an axis, as curves of a tracker, whose steps are integers.

    Args:
        axis: Its name.
        numbers: Value as text -> number, as `jobs.config.conditions.axis_numbers` gives them.
        results: Of this axis and one group.

    Returns:
        Metric -> step -> value. The step is the axis value, in per cent or per mille where it must
        be to be whole, which the metric's name then says; no curve if even these are not.
    """
    for scale, unit in ((1, ""), (100, "_percent"), (1000, "_permille")):
        steps = {value: round(scale * number) for value, number in numbers.items()}
        if all(math.isclose(steps[value], scale * numbers[value]) for value in numbers):
            points = {steps[result.condition[1]]: result for result in results}
            return {
                f"sweep/{axis}{unit}_success": {x: point.success.value for x, point in points.items()},
                f"sweep/{axis}{unit}_distance_m": {x: point.distance_m.value for x, point in points.items()},
            }
    return {}
