"""Measurements of a setting: cost, error and other outcomes; the Pareto front of cost and error."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple


class Measured(NamedTuple):
    """Measurements of one setting of a knob.

    Attributes:
        knob: Name of the knob; "default" for the unchanged program.
        setting: The value, as text.
        cost_us: Process time of the unit of work [us].
        error: Distance from the exact result; 0 is exact.
        outcome: Name -> value of other measured quantities.
    """

    knob: str
    setting: str
    cost_us: float
    error: float
    outcome: Mapping[str, float]


def name_of(knob: str, setting: str) -> str:
    """Return knob and setting as one text, without repeating a knob that the setting contains."""
    return setting if knob in setting else f"{knob} {setting}".strip()


def columns(rows: Sequence[Measured]) -> dict[str, list[str | float]]:
    """Return the rows as columns of a tracker's table; the first is unique."""
    named: dict[str, list[str | float]] = {
        "setting": [f"{row.knob} {row.setting}".strip() for row in rows],
        "cost_us": [row.cost_us for row in rows],
        "error": [row.error for row in rows],
    }
    return named | {name: [row.outcome[name] for row in rows] for name in rows[0].outcome}


def pareto(points: Sequence[tuple[float, float]], noise: float = 0.0) -> list[int]:
    """Return the indices of the points that no other point beats in cost and error, by ascending cost.

    Args:
        points: Cost and error of each.
        noise: Relative difference between repeated measurements of a cost. A point beats another if it is at
            least as exact and cheaper by more than the noise, or more exact and not more expensive by more
            than the noise.
    """

    def beats(ours: tuple[float, float], theirs: tuple[float, float]) -> bool:
        cheaper = ours[0] < (1.0 - noise) * theirs[0]
        return (ours[1] <= theirs[1] and cheaper) or (
            ours[1] < theirs[1] and ours[0] <= (1.0 + noise) * theirs[0]
        )

    front = [place for place, one in enumerate(points) if not any(beats(other, one) for other in points)]
    return sorted(front, key=lambda place: points[place])
