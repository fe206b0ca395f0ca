"""What a setting costs, how exact it is, and what else was measured of it."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple


class Measured(NamedTuple):
    """One setting of a knob.

    Attributes:
        knob: Name of the knob; "default" for the unchanged program.
        setting: The value, as text.
        cost_us: Process time of the unit of work [us].
        error: Distance from the exact result; 0 is exact.
        outcome: Name -> other measured quantity.
    """

    knob: str
    setting: str
    cost_us: float
    error: float
    outcome: Mapping[str, float]


def name_of(knob: str, setting: str) -> str:
    """Return knob and setting in one text; a knob within the setting is not repeated."""
    return setting if knob in setting else f"{knob} {setting}".strip()


def columns(rows: Sequence[Measured]) -> dict[str, list[str | float]]:
    """Return the columns of a tracker's table; the first is unique."""
    named: dict[str, list[str | float]] = {
        "setting": [f"{row.knob} {row.setting}".strip() for row in rows],
        "cost_us": [row.cost_us for row in rows],
        "error": [row.error for row in rows],
    }
    return named | {name: [row.outcome[name] for row in rows] for name in rows[0].outcome}


def pareto(points: Sequence[tuple[float, float]], noise: float = 0.0) -> list[int]:
    """Return the places of the points that no other point beats in cost and error, by rising cost.

    Args:
        points: Cost and error of each.
        noise: Relative difference of repeated measurements of one cost. A point is beaten by one that is as
            exact and cheaper by more than the noise, and by one that is more exact and not dearer beyond the
            noise.
    """

    def beats(ours: tuple[float, float], theirs: tuple[float, float]) -> bool:
        cheaper = ours[0] < (1.0 - noise) * theirs[0]
        return (ours[1] <= theirs[1] and cheaper) or (
            ours[1] < theirs[1] and ours[0] <= (1.0 + noise) * theirs[0]
        )

    front = [place for place, one in enumerate(points) if not any(beats(other, one) for other in points)]
    return sorted(front, key=lambda place: points[place])
