"""Compute everything that the pages and figures of a study show."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from jobs.study.changes import Change, changes_of
from jobs.study.contrasts import Finding, judge
from jobs.study.doses import Dose, read_doses
from jobs.study.learned import learned
from jobs.study.results import Results, read_published
from jobs.study.spec import Family, families_of, read_study
from jobs.study.summaries import Summary, summaries_of
from jobs.study.tables import beside_text, key_of


class Study(NamedTuple):
    """A study, its results, and everything computed from them.

    Attributes:
        name: Name of its data.
        said: Section `study` of its file.
        results: Its episodes and their provenance.
        changes: Effect of each condition on each group.
        summaries: Estimates for each group and condition.
        families: Name -> a family and its findings.
        doses: Event errors of its conditions, if they were measured.
        beside: The other study (STUDY or STUDY:FAMILY) and the family that shows its findings -> `key_of` a
            test -> the finding there.
    """

    name: str
    said: Mapping[str, Any]
    results: Results
    changes: list[Change]
    summaries: list[Summary]
    families: Mapping[str, tuple[Family, list[Finding]]]
    doses: list[Dose]
    beside: Mapping[tuple[str, str], Mapping[tuple[str, ...], str]]


def judge_all(said: Mapping[str, Any], results: Results) -> dict[str, tuple[Family, list[Finding]]]:
    """Test all families of a study; return name -> the family and its findings."""
    rates = learned(said, results.groups)
    found = {family.name: (family, judge(family, results, rates)) for family in families_of(said, results)}
    return {name: (family, [one for one in own if one.difference is not None])
            for name, (family, own) in found.items()}  # fmt: skip


def compute(
    name: str, said: Mapping[str, Any], results: Results, doses: list[Dose], data: Path | None
) -> Study:
    """Compute everything that the pages of a study show.

    Args:
        name: Name of its data.
        said: Section `study` of its file.
        results: Its results.
        doses: Event errors of its conditions, if they were measured.
        data: Folder of the published studies; None: show no findings of other studies.
    """
    families = judge_all(said, results)
    named = {(other, name) for name, (family, _) in families.items() for other in family.beside.values()}
    beside = {(other, name): found for other, name in named
              if data and (found := _beside(data, *place_beside(other, name))) is not None}  # fmt: skip
    every = bool(said.get("doses"))  # show all planned conditions
    return Study(
        name, said, results, changes_of(results, every), summaries_of(results), families, doses, beside
    )


@functools.cache
def published(data: Path, name: str, spec: str) -> Study:
    """Compute the published study `name` with the families and figures of the study `spec`."""
    said = read_study(spec)
    return compute(name, said, read_published(data, name), read_doses(data / f"{name}_doses.csv"), data)


def place_beside(said: str, name: str) -> tuple[str, str]:
    """Split STUDY or STUDY:FAMILY into study and family; without FAMILY, the family is `name`."""
    study, _, family = said.partition(":")
    return study, family or name


@functools.cache
def _beside(data: Path, name: str, family: str) -> dict[tuple[str, ...], str] | None:
    """Return the findings of a family of a published study as texts; None if there is no such study."""
    if not (data / f"{name}_about.json").is_file():
        return None
    own, findings = _judged(data, name)[family]
    return {key_of(own, one.contrast): beside_text(one) for one in findings}


@functools.cache
def _judged(data: Path, name: str) -> dict[str, tuple[Family, list[Finding]]]:
    return judge_all(read_study(name), read_published(data, name))
