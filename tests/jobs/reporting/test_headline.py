import csv
import re

import pytest

from jobs.evaluation.group_stats import episode_values
from jobs.reporting.breaks import changes_of
from jobs.reporting.headline import BEGIN, COLUMNS, END, headline_table, with_headline
from jobs.reporting.sweep_data import read_data, replaced_text
from jobs.run.files import RunError
from jobs.run.provenance import REPOSITORY
from tests.support.episodes import flights

TRAININGS = REPOSITORY / "docs" / "data" / "robustness_trainings.csv"


def cells_of(text):
    """Group -> heading -> cell, of the first Markdown table whose headings are those of the headline."""
    rows = [
        [cell.strip() for cell in line.strip("| ").split("|")] for line in text.splitlines() if "|" in line
    ]
    first = next(k for k, row in enumerate(rows) if "nothing changed" in row)
    named = {}
    for row in rows[first + 2 :]:
        if len(row) != len(rows[first]):
            break
        named[re.match(r"`(\w+)`", row[0])[1]] = dict(zip(rows[first][1:], row[1:], strict=True))
    return named


def test_a_cell_is_the_mean_of_the_trainings_and_marked_where_training_met_the_condition():
    at, dead = COLUMNS["nothing changed"], COLUMNS["50 % dead pixels"]
    episodes = {
        (at, "bytestream"): {0: flights(20), 1: flights(10)},
        (dead, "bytestream"): {0: flights(5), 1: flights(0)},
        (at, "oracle"): {None: flights(20)},
    }
    table = headline_table({"bytestream": [0, 1], "oracle": [None]}, episodes, {(*dead, "bytestream")})
    cells, total = cells_of(table), len(flights(0))
    assert cells["bytestream"]["nothing changed"] == f"{100 * 15 / total:.0f}"
    assert cells["bytestream"]["50 % dead pixels"] == f"{100 * 2.5 / total:.0f}°"
    assert cells["oracle"]["45 Hz"] == "-"
    assert list(cells) == ["oracle", "bytestream"]  # the best mean first


def test_writing_it_changes_nothing_else_of_a_page_and_twice_is_once(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"before\n{BEGIN}\nold\n\n{END}after\n")
    once = with_headline(page, "| new |\n")
    assert once == f"before\n{BEGIN}\n| new |\n\n{END}after\n"
    page.write_text(once)
    assert with_headline(page, "| new |\n") == once


def test_a_page_without_its_marks_is_refused(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"before\n{BEGIN}after\n")
    with pytest.raises(RunError, match="enclose"):
        with_headline(page, "| new |\n")


def test_published_rows_are_those_of_the_published_data():
    page = "docs/robustness.md"
    rates = {}
    with TRAININGS.open() as file:
        for row in csv.DictReader(file):
            rates.setdefault((row["Axis"], row["Value"], row["Group"]), []).append(float(row["success_rate"]))
    published = cells_of((REPOSITORY / page).read_text())
    assert len(published) >= 4
    for group, cells in published.items():
        for heading, cell in cells.items():
            values = [100 * rate for rate in rates[(*COLUMNS[heading], group)]]
            mean, *span = map(float, re.findall(r"\d+", cell))
            assert abs(mean - sum(values) / len(values)) <= 0.51, (group, heading)
            ends = sorted({round(min(values)), round(max(values))})
            if page == "README.md":  # the least and the most where they differ
                assert span == (ends if len(ends) > 1 else []), (group, heading)


@pytest.fixture(scope="module")
def sweep():
    """The published sweep: what made it, and its episodes."""
    return read_data(TRAININGS.parent, "robustness")


def success(sweep, at, group):
    return float(episode_values(sweep[1][at, group], "success").mean())


def trained(about):
    return {group for group, seeds in about["groups"].items() if None not in seeds}


def test_what_is_left_to_the_policy_that_holds_is_what_the_data_say(sweep):
    about, _ = sweep
    rates = {
        (axis, value): success(sweep, (axis, value), "bytestream_hold")
        for axis, points in about["axes"].items()
        for value in points
    }
    dense = {("control_hz_dense", rate) for rate in ("25", "45", "800")}
    assert {at for at, rate in rates.items() if round(100 * rate) < 96} == {
        *dense,
        ("action_delay", "50"),
        ("action_delay", "100"),
    }
    shown = {rate: round(100 * rates["control_hz_dense", rate]) for rate in ("25", "45", "200", "800")}
    assert shown == {"25": 90, "45": 87, "200": 97, "800": 94}
    assert [round(100 * rates["action_delay", late]) for late in ("50", "100")] == [94, 66]


def test_late_actions_change_what_the_page_says(sweep):
    groups = [group for group, seeds in sweep[0]["groups"].items() if len(seeds) > 1 and group != "rgb"]
    assert len(groups) == 8
    usual = {group: success(sweep, ("action_delay", "0"), group) for group in groups}
    ends = []
    for delays in (("25", "50"), ("100",)):
        found = [
            success(sweep, ("action_delay", d), group) - usual[group] for d in delays for group in groups
        ]
        ends.append((round(100 * min(found)), round(100 * max(found))))
    assert ends == [(-7, 17), (-34, -5)]


def test_the_losses_that_the_page_calls_certain_are_those_of_the_data(sweep):
    assert not [one for one in changes_of(*sweep) if one.certain]


def test_a_page_about_trainings_that_have_been_replaced_says_so():
    commit, text = "81ef066", (REPOSITORY / "docs" / "dose_response.md").read_text()
    assert commit in text
    assert replaced_text(commit)
    assert replaced_text(commit) in text
    assert replaced_text("0000000") == ""
