"""What hand-written pages say in numbers of the published sweep is what its data say."""

import csv
import re

import pytest

from jobs.run.provenance import REPOSITORY
from jobs.study.results import read_published


@pytest.fixture(scope="module")
def sweep():
    return read_published(REPOSITORY / "docs" / "data", "robustness")


def success(sweep, at, group):
    return float(sweep.values(at, group).mean())


def test_what_is_left_to_the_policy_that_holds_is_what_the_data_say(sweep):
    rates = {at: success(sweep, at, "bytestream_hold") for at in sweep.conditions}
    dense = {("control_hz_dense", rate) for rate in (25.0, 45.0, 800.0)}
    late = {("action_delay", 50.0), ("action_delay", 100.0)}
    assert {at for at, rate in rates.items() if round(100 * rate) < 96} == dense | late
    shown = {rate: round(100 * rates["control_hz_dense", rate]) for rate in (25.0, 45.0, 200.0, 800.0)}
    assert shown == {25.0: 90, 45.0: 87, 200.0: 97, 800.0: 94}
    assert [round(100 * rates["action_delay", late]) for late in (50.0, 100.0)] == [94, 66]


def test_late_actions_change_what_the_page_says(sweep):
    groups = [group for group in sweep.trained if len(sweep.groups[group]) > 1 and group != "rgb"]
    assert len(groups) == 8
    usual = {group: success(sweep, ("action_delay", 0.0), group) for group in groups}
    ends = []
    for delays in ((25.0, 50.0), (100.0,)):
        found = [
            success(sweep, ("action_delay", ms), group) - usual[group] for ms in delays for group in groups
        ]
        ends.append((round(100 * min(found)), round(100 * max(found))))
    assert ends == [(-7, 17), (-34, -5)]


def test_what_breaks_ten_seeds_is_what_the_data_say():
    text = " ".join((REPOSITORY / "docs" / "results.md").read_text().split())
    changes = {}
    for study in ("ppo_claims", "ppo_event_set"):
        with (REPOSITORY / "docs" / "data" / f"{study}_changes.csv").open() as file:
            for row in csv.DictReader(file):
                lost = -round(100 * float(row["difference"]))
                changes[study, row["Axis"], row["Value"], row["Group"]] = lost, row["certain"] == "1"
    textures = [
        lost for (_, _, value, _), (lost, certain) in changes.items() if value == "texture_change" and certain
    ]
    false = [lost for (_, _, value, group), (lost, _) in changes.items()
             if value == "0.1" and group in ("bytestream", "bytestream_xy", "event_set")]  # fmt: skip
    found = re.search(
        r"cost every kind (\d+) to (\d+) points, and .* cost event streams and sets (\d+) to (\d+)", text
    )
    assert [int(one) for one in found.groups()] == [min(textures), max(textures), min(false), max(false)]
    own = [certain for (study, *_), (_, certain) in changes.items() if study == "ppo_claims"]
    found = re.search(r"With ten seeds by PPO (\d+) of (\d+) are", text)
    assert [int(one) for one in found.groups()] == [sum(own), len(own)]


def test_what_breaks_taught_policies_is_what_the_data_say():
    text = " ".join((REPOSITORY / "docs" / "results.md").read_text().split())
    with (REPOSITORY / "docs" / "data" / "taught_claims_changes.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["certain"] == "1"]
    lost = [-round(100 * float(row["difference"])) for row in rows]
    found = re.search(r"By imitation in plain worlds .* cost most, by (\d+) to (\d+) points", text)
    assert [int(one) for one in found.groups()] == [min(lost), max(lost)]
    assert {row["Axis"] for row in rows} == {"world", "background_activity", "control_hz", "control_hz_dense"}
