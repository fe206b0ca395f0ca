"""A study and all that is computed of its results, which its pages and figures show."""

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
    """A study and all that is computed of its results.

    Attributes:
        name: Of its data.
        said: Section `study` of its file.
        results: What was evaluated.
        changes: Of its conditions.
        summaries: Of its groups.
        families: Name -> a family and its findings.
        doses: Event errors of its conditions, if they were measured.
        beside: What a family names beside itself -> `key_of` a test -> what was found there.
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
    """Return name -> each family of a study and its findings."""
    rates = learned(said, results.groups)
    found = {family.name: (family, judge(family, results, rates)) for family in families_of(said, results)}
    return {name: (family, [one for one in own if one.difference is not None])
            for name, (family, own) in found.items()}  # fmt: skip


def compute(
    name: str, said: Mapping[str, Any], results: Results, doses: list[Dose], data: Path | None
) -> Study:
    """Compute all that the pages of a study show.

    Args:
        name: Of its data.
        said: Section `study` of its file.
        results: What was evaluated.
        doses: Event errors of its conditions, if they were measured.
        data: Where other published studies are; None: none is shown beside.
    """
    families = judge_all(said, results)
    named = {(other, name) for name, (family, _) in families.items() for other in family.beside.values()}
    beside = {(other, name): found for other, name in named
              if data and (found := _beside(data, *place_beside(other, name))) is not None}  # fmt: skip
    every = bool(said.get("doses"))  # a plan that was written before names all of its conditions
    return Study(
        name, said, results, changes_of(results, every), summaries_of(results), families, doses, beside
    )


@functools.cache
def published(data: Path, name: str, spec: str) -> Study:
    """Compute a published study by the file of `spec`."""
    said = read_study(spec)
    return compute(name, said, read_published(data, name), read_doses(data / f"{name}_doses.csv"), data)


def place_beside(said: str, name: str) -> tuple[str, str]:
    """Return study and family of STUDY or STUDY:FAMILY; `name` is the family that names it."""
    study, _, family = said.partition(":")
    return study, family or name


@functools.cache
def _beside(data: Path, name: str, family: str) -> dict[tuple[str, ...], str] | None:
    """Return what a family of a published study found; None if the study is not there."""
    if not (data / f"{name}_about.json").is_file():
        return None
    own, findings = _judged(data, name)[family]
    return {key_of(own, one.contrast): beside_text(one) for one in findings}


@functools.cache
def _judged(data: Path, name: str) -> dict[str, tuple[Family, list[Finding]]]:
    return judge_all(read_study(name), read_published(data, name))
