"""Event errors of the conditions of a study that corrupts events: intended and measured."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from envs.config import EnvConfig
from envs.event_error import error_between
from jobs.analysis.tables import write_csv
from jobs.config.env_keys import env_with
from jobs.study.results import Condition, Results, place, texts_of

HEAD = ("Axis", "Value", "asked_event_error", "measured_event_error", "met_by")


class Dose(NamedTuple):
    """Event error of one condition.

    Attributes:
        condition: Kind of error, and its setting.
        asked: Intended event error; None: it is only measured.
        measured: Event error against the same sensor without this kind of error.
        met_by: Groups whose training distribution includes this condition.
    """

    condition: Condition
    asked: float | None
    measured: float
    met_by: tuple[str, ...]


def measure_doses(study: Mapping[str, Any], results: Results, env: EnvConfig) -> list[Dose]:
    """Measure the event error of each condition of the axes in `doses` of a study's file.

    Args:
        study: Section `study` of its file; `doses` maps an axis to the intended error of each point.
        results: The results of the study.
        env: The simulation of the nominal condition.
    """
    found = []
    for axis, asked in (study.get("doses") or {}).items():
        points = results.axes[axis]
        for place_, (value, changes) in enumerate(points.items()):
            met = tuple(group for group in results.trained if ((axis, value), group) in results.met)
            error = error_between(env_with(env, dict(changes)), env)
            found.append(Dose((axis, value), asked[place_] if asked else None, error, met))
    return found


def write_doses(file: Path, doses: Sequence[Dose]) -> None:
    """Write the table of the doses for `read_doses`."""
    rows = [
        (*texts_of(one.condition), "" if one.asked is None else f"{one.asked:.4f}",
         f"{one.measured:.4f}", " ".join(one.met_by))
        for one in doses
    ]  # fmt: skip
    write_csv(file, HEAD, rows)


def read_doses(file: Path) -> list[Dose]:
    """Read the published table of the doses; empty if there is none."""
    if not file.is_file():
        return []
    with file.open() as stream:
        rows = list(csv.DictReader(stream))
    return [
        Dose(
            place((row["Axis"], row["Value"])),
            float(row["asked_event_error"]) if row["asked_event_error"] else None,
            float(row["measured_event_error"]),
            tuple(row["met_by"].split()),
        )
        for row in rows
    ]
