"""The numbers that results.md says by hand are those of the published data."""

import csv
import re

from jobs.run.provenance import REPOSITORY
from jobs.study.results import read_published

DATA = REPOSITORY / "docs" / "data"
TEXT = " ".join((REPOSITORY / "docs" / "results.md").read_text().split())


def said(pattern):
    """The whole numbers that the page has in the groups of a pattern."""
    return [int(one) for one in re.search(pattern, TEXT).groups()]


def changes(study):
    """The published changes of a study with the points that each costs."""
    with (DATA / f"{study}_changes.csv").open() as file:
        return [row | {"lost": -round(100 * float(row["difference"]))} for row in csv.DictReader(file)]


def ends(numbers):
    return [min(numbers), max(numbers)]


def test_what_is_left_to_the_policy_that_holds_and_what_late_actions_change():
    sweep = read_published(DATA, "robustness")

    def success(axis, value, group="bytestream_hold"):
        return 100 * float(sweep.values((axis, value), group).mean())

    dense, late = "control_hz_dense", "action_delay"
    weak = {at for at in sweep.conditions if round(success(*at)) < 96}
    assert weak == {*((dense, rate) for rate in (25.0, 45.0, 800.0)), (late, 50.0), (late, 100.0)}
    pattern = r"actions \((\d+) % at 50 ms\) and `poles_dense` \((\d+) % at 200 Hz, (\d+) % at 45 Hz\)"
    found = [success(late, 50.0), success(dense, 200.0), success(dense, 45.0)]
    assert said(pattern) == [round(rate) for rate in found]
    groups = [group for group in sweep.trained if len(sweep.groups[group]) > 1 and group != "rgb"]
    assert len(groups) == 9
    gain = {ms: [round(success(late, ms, group) - success(late, 0.0, group)) for group in groups]
            for ms in (25.0, 50.0, 100.0)}  # fmt: skip
    assert said(r"25 and 50 ms change success by (-\d+) to \+(\d+) points") == ends(gain[25.0] + gain[50.0])
    assert said(r"100 ms cost each of them (\d+) to (\d+) points") == ends([-one for one in gain[100.0]])


def test_what_breaks_ten_seeds():
    claims = changes("ppo_claims")
    rows = claims + changes("ppo_event_set")
    textures = [row["lost"] for row in rows if row["Value"] == "texture_change" and row["certain"] == "1"]
    streams = ("bytestream", "bytestream_xy", "event_set")
    false = [row["lost"] for row in rows if row["Value"] == "0.1" and row["Group"] in streams]
    pattern = r"cost every kind (\d+) to (\d+) points, and .* cost event streams and sets (\d+) to (\d+)"
    assert said(pattern) == [*ends(textures), *ends(false)]
    certain = [row for row in claims if row["certain"] == "1"]
    assert said(r"With ten seeds by PPO (\d+) of (\d+) are") == [len(certain), len(claims)]


def test_what_breaks_taught_policies():
    rows = [row for row in changes("taught_claims") if row["certain"] == "1"]
    pattern = r"By imitation in plain worlds .* cost most, by (\d+) to (\d+) points"
    assert said(pattern) == ends([row["lost"] for row in rows])
    assert {row["Axis"] for row in rows} == {"world", "background_activity", "control_hz", "control_hz_dense"}
