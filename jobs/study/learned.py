"""Measure learning speed: success of a study's trainings during training, from published learning curves."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from jobs.run.provenance import REPOSITORY
from jobs.study.contrasts import Learned
from jobs.tools.curves import published_trainings

VARIANT = "VARIANT"  # stands for the group's name in `study.published`


def published_place(study: Mapping[str, Any], group: str) -> Path | None:
    """Return the path of a group's published policies without "-s0" and so on; None: there are none.

    Args:
        study: Section `study` of its file.
        group: One of its groups.
    """
    own = (study.get("variants") or {}).get(group) or {}
    named = own.get("published", study.get("published"))
    if named is None:
        return None
    place = Path(str(named).replace(VARIANT, group))
    return place if place.parent.is_dir() else REPOSITORY / place


def learned(study: Mapping[str, Any], groups: Iterable[str]) -> Learned:
    """Return measure -> group -> mean success of each published training over the compared steps.

    Args:
        study: Section `study` of its file.
        groups: The groups in its results.
    """
    places = {group: at for group in groups if (at := published_place(study, group)) is not None}
    curves = {folder: published_trainings(folder) for folder in {place.parent for place in places.values()}}
    found: dict[str, dict[str, list[float]]] = {"learned": {}, "learned_uncharged": {}}
    for group, place in places.items():
        for one in curves[place.parent]:
            for measure, value in (("learned", one.mean_success_with_encoder),
                                   ("learned_uncharged", one.mean_success)):  # fmt: skip
                if one.group == place.name and value is not None:
                    found[measure].setdefault(group, []).append(value)
    return found
