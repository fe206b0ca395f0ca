"""Every published number is what it was before the studies became data (published.json.gz, frozen then)."""

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
from jobs.study.contrasts import by_condition, judge
from jobs.study.figures import contact_ends, pair_differences, worst_conditions
from jobs.study.results import read_published, text_of, values_of
from jobs.study.spec import GAIN, read_study
from jobs.study.spread import crossed_tables, factors
from jobs.study.summaries import summaries_of
from jobs.study.tables import write_changes, write_estimates
from jobs.study.words import condition_text

DOCS, DATA = REPOSITORY / "docs", REPOSITORY / "docs" / "data"
WAS = json.loads(gzip.decompress((Path(__file__).parent / "published.json.gz").read_bytes()))
NAMES = sorted(WAS["cells"])  # a later study has no earlier numbers to keep


@cache
def results(name):
    return read_published(DATA, name)


@cache
def findings(name, spec=None):
    """Family -> findings of a published study."""
    return {
        family: found for family, (_, found) in judge_all(read_study(spec or name), results(name)).items()
    }


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


@pytest.mark.parametrize("name", NAMES)
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


@pytest.mark.parametrize("named", WAS["changes"])
def test_every_change_and_whether_it_is_certain(named):
    name, _, every = named.partition(" ")
    new = [
        [*place(one.condition), *place(one.baseline), one.group, float(one.success.mean()),
         float(one.before.mean()), numbers(one.difference), one.certain, one.broken.astype(int).tolist()]
        for one in changes_of(results(name), bool(every))
    ]  # fmt: skip
    assert same(new, WAS["changes"][named])


@pytest.mark.parametrize("name", WAS["claims"])
def test_every_claim_of_the_paper(name):
    """The tests of learning have a measure of their own now, in place of `success`."""
    was = [row for row in WAS["claims"][name] if row[6] != "not tested"]
    new = [
        [
            one.contrast.name,
            one.contrast.source,
            one.verdict,
            numbers(one.difference),
            one.adjusted_p,
            one.needed,
        ]
        for one in findings(name)["claims"]
    ]
    assert same(new, [[row[0], row[1], *row[6:10]] for row in was])
    each = {row[0] + row[2]: row[10] for row in was}
    for one in findings(name)["claims"]:
        if one.contrast.measure == "success" and not one.contrast.ours.less:
            rows = by_condition(one.contrast, results(name))
            claimed = each[
                one.contrast.name + one.contrast.ours.group.replace("bytestream_paper", "bytestream")
            ]
            assert same([[*place(row.condition), numbers(row.difference)] for row in rows], claimed)


@pytest.mark.parametrize("name", NAMES)
def test_no_condition_of_a_test_is_its_own_baseline(name):
    """Its change is 0, and an average with it is too small."""
    for family, found in findings(name).items():
        for one in found:
            for side in filter(None, (one.contrast.ours, one.contrast.theirs)):
                pairs = zip(side.at, side.less, strict=True) if len(side.at) == len(side.less) else ()
                first = results(name).same_as
                same = [at for at, less in pairs if first.get(at, at) == first.get(less, less)]
                assert not same, (family, one.contrast.name, same)


@pytest.mark.parametrize("name", ["ppo_claims", "taught_claims"])
def test_ten_points_of_success_are_five_metres(name):
    """Over all trainings and conditions; so one margin means the same in both units."""
    success, metres = [], []
    for (_, _), own in results(name).cells.items():
        success += list(values_of(own, "success").mean(axis=1))
        metres += list(values_of(own, "distance_m").mean(axis=1))
    slope = np.polyfit(success, metres, 1)[0]
    assert 10 * GAIN["success"] * slope / 10 == pytest.approx(GAIN["distance_m"], rel=0.15)
    assert np.corrcoef(success, metres)[0, 1] > 0.9


def test_the_cameras_at_each_rate():
    found = findings("camera_rates")
    new = [[one.contrast.name, numbers(one.difference), one.adjusted_p] for one in found["cameras"]]
    assert same(new, [row[1:] for row in WAS["cameras"]["tests"]])
    measures = [numbers(one.difference) for one in found["measures"]]
    assert same(measures, [one for row in WAS["cameras"]["groups"] for one in row[2:]])


@pytest.mark.parametrize(("name", "family"), [("ppo_event_set", "sets"), ("ppo_paper", "recipe")])
def test_two_groups_under_every_condition(name, family):
    was, (one,) = WAS["two_groups"][name], findings(name)[family]
    assert same(numbers(one.difference), was["mean"][2])
    assert ("It is certain" in was["mean"][3]) is (one.verdict == "certain")
    assert "cannot be ruled out" in was["mean"][3] or one.verdict != "undecided"
    new = [[*place(row.condition), *map(numbers, (row.theirs, row.ours, row.difference))]
           for row in by_condition(one.contrast, results(name))]  # fmt: skip
    assert same(new, was["conditions"])


@pytest.mark.parametrize("name", WAS["kinds"])
def test_invented_events_against_the_other_kinds(name):
    new = [[one.contrast.ours.group, numbers(one.difference), one.adjusted_p, one.verdict]
           for one in findings(name)["kinds"]]  # fmt: skip
    assert same(new, [[row[0], *row[2:]] for row in WAS["kinds"][name]["tests"]])
    costs = findings(name).get("costs") or findings(name)["errors"]
    new = [[one.contrast.ours.group, one.contrast.name, numbers(one.difference)] for one in costs]
    assert same(new, WAS["kinds"][name]["means"])


@pytest.mark.parametrize("family", ["errors", "filters"])
def test_what_errors_and_the_filter_change_for_taught_policies(family):
    new = [[one.contrast.ours.group, one.contrast.name, numbers(one.difference), one.adjusted_p, one.verdict]
           for one in findings("dose_response_taught")[family]]  # fmt: skip
    assert same(new, WAS[family])


@pytest.mark.parametrize("name", WAS["variants"])
def test_every_variant_and_its_difference(name):
    spec = "learning_rates" if name.startswith("learning_rates") else UNMARKED[name]
    found, was = findings(name, spec), {row[0]: row for row in WAS["variants"][name]}
    for one in found["means"]:
        assert same(numbers(one.difference)[:3], was[one.contrast.ours.group][1][:3])
    compared = {one.contrast.ours.group: one for one in found["changes"]}
    assert compared.keys() == {name for name, row in was.items() if row[2] is not None}
    for group, one in compared.items():
        assert same(numbers(one.difference), was[group][2])
        assert same(pair_differences(results(name), one).tolist(), was[group][3])


def test_encoders_and_seeds():
    overall, each = factors(crossed_tables(read_study("encoder_seeds"), results("encoder_seeds")))
    rows = {"mean of these": overall, **{condition_text(at): one for at, one in each.items()}}
    new = [[name, one.mean, one.spread.rows, one.rows_p, one.spread.columns, one.columns_p, one.spread.rest]
           for name, one in rows.items()]  # fmt: skip
    assert same(new, WAS["encoders"])


def test_who_leads_by_how_much():
    new = [[one.contrast.ours.group, one.contrast.theirs.group, numbers(one.difference), one.adjusted_p]
           for one in findings("robustness")["lead"]]  # fmt: skip
    assert same(new, WAS["lead"]["pairs"])


def test_worst_conditions_and_contacts():
    found = results("robustness")
    worst = worst_conditions(found, changes_of(found))
    assert {group: condition_text(at) for group, at in worst.items()} == WAS["survival"]
    ends = {group: [[len(one), int(one["collision"].sum())] for one in both]
            for group, both in contact_ends(found).items()}  # fmt: skip
    assert ends == WAS["contacts"]


@pytest.mark.slow
def test_pages_and_tables_are_those_of_the_published_data(tmp_path):
    """`python -m docs.from_data` changes nothing."""
    for name, text in filled_pages(DOCS).items():
        assert text == (DOCS / name).read_text(), f"{name}: renew it by python -m docs.from_data"
    for name, study in studies(DOCS).items():
        if name not in UNMARKED:
            write_estimates(tmp_path / f"{name}_estimates.csv", study.summaries)
            write_changes(tmp_path / f"{name}_changes.csv", study.changes)
    assert {path.name for path in tmp_path.iterdir()} >= {
        "robustness_estimates.csv",
        "ppo_claims_changes.csv",
    }
    for path in tmp_path.iterdir():
        assert path.read_text() == (DATA / path.name).read_text()


def test_seeds_of_one_training_are_paired_whatever_their_order():
    found, (one,) = results("ppo_event_set"), findings("ppo_event_set")["sets"]
    turned = {
        at: dict(reversed(own.items())) if at[1] == "event_set" else own for at, own in found.cells.items()
    }
    ((family, _),) = judge_all(read_study("ppo_event_set"), found).values()
    (again,) = judge(family, type(found)(found.facts, turned))
    assert again == one
    assert not np.isnan(again.difference.value)
