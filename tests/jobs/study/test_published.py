"""Published numbers are what they were before the studies became data (published.json.gz, frozen then)."""

import gzip
import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from docs.from_data import UNMARKED, filled_pages, studies
from jobs.run.provenance import REPOSITORY
from jobs.study.changes import changes_of
from jobs.study.computed import judge_all
from jobs.study.contrasts import by_condition
from jobs.study.figures import pair_differences, worst_conditions
from jobs.study.page import fill, part
from jobs.study.report import study_of
from jobs.study.results import Results, read_published, text_of, values_of
from jobs.study.spec import GAIN, read_study
from jobs.study.spread import crossed_tables, factors
from jobs.study.summaries import summaries_of
from jobs.study.tables import write_changes, write_estimates
from jobs.study.words import condition_text

DOCS, DATA = REPOSITORY / "docs", REPOSITORY / "docs" / "data"
WAS = json.loads(gzip.decompress((Path(__file__).parent / "published.json.gz").read_bytes()))
KINDS = WAS["kinds"]
# Study, family, what is compared of each test, and what it was; `success` was the measure of learning, too.
TESTS = [
    *(
        (name, "claims", "name source verdict numbers p needed",
         [[*row[:2], *row[6:10]] for row in was if row[6] != "not tested"])
        for name, was in WAS["claims"].items()
    ),
    ("camera_rates", "cameras", "name numbers p", [row[1:] for row in WAS["cameras"]["tests"]]),
    ("camera_rates", "measures", "numbers", [[one] for row in WAS["cameras"]["groups"] for one in row[2:]]),
    *((name, "kinds", "ours numbers p verdict", [[row[0], *row[2:]] for row in was["tests"]])
      for name, was in KINDS.items()),
    ("dose_response", "costs", "ours name numbers", KINDS["dose_response"]["means"]),
    ("dose_response_taught", "errors", "ours name numbers", KINDS["dose_response_taught"]["means"]),
    ("dose_response_taught", "errors", "ours name numbers p verdict", WAS["errors"]),
    ("dose_response_taught", "filters", "ours name numbers p verdict", WAS["filters"]),
    ("robustness", "lead", "ours theirs numbers p", WAS["lead"]["pairs"]),
    *((name, family, "numbers conditions", [[was["mean"][2], was["conditions"]]])
      for family, (name, was) in zip(("sets", "recipe"), WAS["two_groups"].items(), strict=True)),
    *((name, "changes", "ours numbers pairs",
       [[row[0], *row[2:4]] for row in WAS["variants"][name] if row[2] is not None])
      for name in ("ablation", "taught")),
]  # fmt: skip


LATER = {"robustness": {"bytestream_late"}}  # study -> groups that it got after the numbers were frozen


@cache
def results(name):
    """A published study with the groups that it had when its numbers were frozen."""
    found, later = read_published(DATA, name), LATER.get(name, set())
    groups = {group: seeds for group, seeds in found.groups.items() if group not in later}
    cells = {(at, group): own for (at, group), own in found.cells.items() if group not in later}
    return Results({**found.facts, "groups": groups}, cells)


@cache
def findings(name):
    """Family -> findings of a published study."""
    judged = judge_all(read_study(name), results(name))
    return {family: found for family, (_, found) in judged.items()}


def numbers(found):
    """Value, ends of the interval and p, as they were frozen."""
    low, high = found.interval or (None, None)
    return [found.value, low, high, getattr(found, "p", None)]


def same(new, old):
    """Whether two nested lists are equal, floats to nine digits."""
    if isinstance(new, list):
        return len(new) == len(old) and all(map(same, new, old))
    if isinstance(new, float) and isinstance(old, float | int):
        return new == pytest.approx(old, rel=1e-9, abs=1e-12)
    return new == old


def place(at):
    return [at[0], text_of(at[1])]


@pytest.mark.parametrize("name", ["ablation", "camera_rates", "dose_response_taught", "ppo_claims"])
def test_every_estimate_of_a_group_under_a_condition(name):
    was = {tuple(row[:3]): row[3:13] for row in WAS["cells"][name]}
    new = {
        (*place(one.condition), one.group): [
            len(one.trainings), one.episodes, *numbers(one.success)[:3], *numbers(one.distance_m)[:3],
            one.events_per_step, one.dropped,
        ]
        for one in summaries_of(results(name))
    }  # fmt: skip
    assert new.keys() == was.keys()
    assert [at for at in new if not same(new[at], was[at])] == []


@pytest.mark.parametrize("named", ["robustness", "camera_rates every", "dose_response", "ppo_claims"])
def test_every_change_and_whether_it_is_certain(named):
    name, _, every = named.partition(" ")
    new = [
        [*place(one.condition), *place(one.baseline), one.group, float(one.success.mean()),
         float(one.before.mean()), numbers(one.difference), one.certain, one.broken.astype(int).tolist()]
        for one in changes_of(results(name), bool(every))
    ]  # fmt: skip
    assert same(new, WAS["changes"][named])


@pytest.mark.parametrize(("name", "family", "parts", "was"), TESTS)
def test_every_test_of_a_family(name, family, parts, was):
    find = {
        "name": lambda one: one.contrast.name,
        "source": lambda one: one.contrast.source,
        "ours": lambda one: one.contrast.ours.group,
        "theirs": lambda one: one.contrast.theirs.group,
        "numbers": lambda one: numbers(one.difference),
        "p": lambda one: one.adjusted_p,
        "verdict": lambda one: one.verdict,
        "needed": lambda one: one.needed,
        "pairs": lambda one: pair_differences(results(name), one).tolist(),
        "conditions": lambda one: [
            [*place(row.condition), *map(numbers, (row.theirs, row.ours, row.difference))]
            for row in by_condition(one.contrast, results(name))
        ],
    }
    new = [[find[part](one) for part in parts.split()] for one in findings(name)[family]]
    assert same(new, was)


def test_encoders_and_seeds():
    overall, each = factors(crossed_tables(read_study("encoder_seeds"), results("encoder_seeds")))
    rows = {"mean of these": overall, **{condition_text(at): one for at, one in each.items()}}
    new = [[name, one.mean, one.spread.rows, one.rows_p, one.spread.columns, one.columns_p, one.spread.rest]
           for name, one in rows.items()]  # fmt: skip
    assert same(new, WAS["encoders"])


def test_worst_conditions():
    found = results("robustness")
    worst = worst_conditions(found, changes_of(found))
    assert {group: condition_text(at) for group, at in worst.items()} == WAS["survival"]


@pytest.mark.parametrize("name", ["camera_rates", "dose_response", "dose_response_taught", "robustness"])
def test_no_condition_of_a_test_is_its_own_baseline(name):
    """Its change is 0, and an average with it is too small."""
    first = results(name).same_as
    contrasts = [one.contrast for found in findings(name).values() for one in found]
    for side in filter(None, (side for one in contrasts for side in (one.ours, one.theirs))):
        pairs = zip(side.at, side.less, strict=True) if len(side.at) == len(side.less) else ()
        assert not [at for at, less in pairs if first.get(at, at) == first.get(less, less)], side


@pytest.mark.parametrize("name", ["ppo_claims", "taught_claims"])
def test_ten_points_of_success_are_five_metres(name):
    """Over all trainings and conditions; so one margin means the same in both units."""
    cells = results(name).cells.values()
    success, metres = (
        np.concatenate([values_of(own, measure).mean(axis=1) for own in cells])
        for measure in ("success", "distance_m")
    )
    slope = np.polyfit(success, metres, 1)[0]
    assert GAIN["success"] * slope == pytest.approx(GAIN["distance_m"], rel=0.15)
    assert np.corrcoef(success, metres)[0, 1] > 0.9


def test_the_page_of_a_study_is_that_of_its_data():
    text = (DOCS / "encoder_seeds.md").read_text()
    assert fill(text, lambda mark, what: part(study_of(DATA, mark), what)) == text


@pytest.mark.slow
def test_pages_and_tables_are_those_of_the_published_data(tmp_path):
    """`python -m docs.from_data` changes nothing."""
    for name, text in filled_pages(DOCS).items():
        assert text == (DOCS / name).read_text(), f"{name}: renew it by python -m docs.from_data"
    for name, study in studies(DOCS).items():
        if name not in UNMARKED:
            write_estimates(tmp_path / f"{name}_estimates.csv", study.summaries)
            write_changes(tmp_path / f"{name}_changes.csv", study.changes)
    written = {path.name: path.read_text() for path in tmp_path.iterdir()}
    assert written.keys() >= {"robustness_estimates.csv", "ppo_claims_changes.csv"}
    assert written == {name: (DATA / name).read_text() for name in written}
