from pathlib import Path

import pytest

from jobs.run.files import read_json
from jobs.run.folder import locate_run
from jobs.studies.numerics import numerics
from jobs.studies.numerics.extremes import EXTREMES, events_between, refused
from jobs.studies.numerics.numerics import NumericsError, refuse_excess, table_rows
from tests.support.configs import small_config

ROOT = Path(__file__).resolve().parents[4]
QUICK = [
    extreme for extreme in EXTREMES if extreme.part not in ("corridor", "renderer", "simulator", "encoder")
]


@pytest.mark.parametrize("extreme", QUICK, ids=lambda extreme: f"{extreme.part}: {extreme.what}")
def test_the_worst_error_is_within_what_is_accepted(extreme):
    assert 0 <= extreme.worst() <= extreme.bound


@pytest.mark.system
@pytest.mark.parametrize("extreme", [one for one in EXTREMES if one not in QUICK], ids=lambda one: one.what)
def test_the_worst_error_of_what_takes_longer_is_within_what_is_accepted(extreme):
    assert 0 <= extreme.worst() <= extreme.bound


def test_each_extreme_names_tests_that_are_there():
    assert all((ROOT / extreme.test).is_file() for extreme in EXTREMES)
    assert len({extreme.what for extreme in EXTREMES}) == len(EXTREMES)


def test_what_is_measured_can_be_wrong():
    found, dropped = events_between(0.1, 0.9, contrast_threshold=0.2, max_events_per_pixel=3)
    assert (len(found), dropped) == (3, 7)
    assert refused((1.0, -1.0, 2.0), lambda value: range(int(value)) or [].index(value)) == 2.0


@pytest.mark.parametrize("error", [2.1, float("nan"), float("inf")])
def test_an_error_above_what_is_accepted_is_named(error):
    extreme = EXTREMES[0]._replace(bound=2.0, unit="events")
    refuse_excess([extreme], [2.0])
    with pytest.raises(NumericsError, match="must be at most 2 events, got"):
        refuse_excess([extreme], [error])


def test_the_table_has_a_line_for_each_with_units():
    rows = table_rows(EXTREMES[:2], [0.0, 0.25])
    assert rows[0][3] == "none"
    assert rows[1][3] == f"0.25 {EXTREMES[1].unit}"


@pytest.mark.system
def test_the_job_writes_the_page_only_if_all_is_within(tmp_path, monkeypatch):
    page = tmp_path / "docs" / "numerics.md"
    monkeypatch.setattr(numerics, "PAGE", page)
    monkeypatch.setattr(numerics, "REPOSITORY", tmp_path)
    wrong = EXTREMES[0]._replace(worst=lambda: 1.0)
    monkeypatch.setattr(numerics, "EXTREMES", (wrong,))
    config = small_config(tmp_path, job="numerics")
    with pytest.raises(NumericsError):
        numerics.run(config)
    assert not page.exists()
    monkeypatch.setattr(numerics, "EXTREMES", (wrong._replace(worst=lambda: 0.0),))
    numerics.run(config)
    assert wrong.what in page.read_text()
    assert read_json(locate_run(config).path / "stages" / "numerics.json")["figures"]
