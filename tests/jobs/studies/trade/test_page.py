import pytest

from jobs.analysis.statistics import Estimate
from jobs.analysis.tables import summarise
from jobs.studies.front_plots import choice_figure
from jobs.studies.replays import Measured
from jobs.studies.trade.page import HEADINGS, RULE, Row, advice, fronts, lines, metrics, page, panels, verdict
from tests.support.episodes import flights

ABOUT = {
    "run": "trade-short-s0-1",
    "command": "python -m platform.launch +exp=trade",
    "commit": "c0ffee",
    "date": "2026-01-02",
    "host": "somewhere",
    "cpus": 2,
    "policy": "bytestream-s0",
    "scene": "poles_eval",
    "action": "stochastic",
    "trials": 20,
    "replays": 8,
    "failed": {"pyrender samples 1": "RuntimeError: no OpenGL"},
}


def make_row(knob, setting="", step_us=250.0, error=0.02, low=-0.05, high=0.05, won=18, other=0.01):
    flown = summarise((knob, setting), flights(won))
    measured = Measured(step_us, error, 0.1, other)
    return Row(knob, setting, measured, flown, Estimate((low + high) / 2, (low, high)))


DEFAULT = make_row("default")
COARSE = make_row("tolerance", "tolerance 0.5", 125.0, 0.11, other=0.03)
FORGETFUL = make_row("memory", "memory legacy", 100.0, 0.8, low=-0.7, high=-0.6, won=4, other=0.4)
FEW = make_row("pyrender", "samples 1", 2000.0, 0.9, low=-0.2, high=0.1)
ROUNDED = make_row("precision", "int8", 200.0, 0.02)
EXACT = make_row("most exact", "", 2500.0, 0.0, other=0.0)
ROWS = [DEFAULT, COARSE, FORGETFUL, FEW, ROUNDED, EXACT]


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (-0.09, 0.01, "as good"),
        (-0.09, -0.01, "as good"),
        (-0.11, 0.01, "undecided"),
        (-0.30, -0.01, "worse"),
    ],
)
def test_a_verdict_follows_the_interval_of_the_difference(low, high, expected):
    row = make_row("tolerance")._replace(difference=Estimate(0.0, (low, high)))
    assert verdict(row) == expected
    assert verdict(row._replace(knob="default")) == "default"
    assert "-10 points" in RULE


def test_fronts_hold_what_is_not_beaten_and_know_no_event_error_of_an_encoder():
    found = fronts(ROWS)
    assert found == {"e": [2, 1, 0, 5], "a": [2, 1, 4, 5], "s": [2, 1]}
    assert [panel.front for panel in panels(ROWS)] == list(found.values())


def test_every_line_has_a_word_for_each_heading():
    text = lines(ROWS)
    assert {len(line) for line in text} == {len(HEADINGS)}
    assert text[0][:6] == ("default", "", "4,000", "2", "10", "1")
    assert text[0][8] == ""
    assert text[4][3] == "-"
    assert [line[10] for line in text] == ["default", "as good", "worse", "undecided", "as good", "as good"]


def test_advice_names_the_fastest_of_the_good_and_what_to_leave_alone():
    said = "\n".join(advice(ROWS))
    assert "choose tolerance 0.5, the fastest setting as good as the default: 8,000 steps/s, 2 times" in said
    assert "tolerance 0.5 has the largest event error: 11 %" in said
    assert "the fastest as good as the default is precision int8: 1.2 times" in said
    assert "what costs success [points]: memory legacy (-65 [-70, -60])" in said
    assert "**Undecided** with so many flights: pyrender samples 1." in said
    assert "Of 5 verdicts" in said


def test_another_camera_is_reported_and_never_advised():
    as_good = make_row("memory", "memory legacy", 100.0, 0.8)
    said = advice([DEFAULT, COARSE, as_good, EXACT])
    assert said[0].startswith("**To fly fast**, choose tolerance 0.5")
    assert "tolerance 0.5 has the largest event error" in said[2]
    assert "memory legacy: 80 % of the events differ, success +0 [-5, +5] points, as good." in said[3]


def test_where_nothing_faster_is_as_good_the_default_stays():
    said = advice([DEFAULT, FORGETFUL, EXACT])
    assert said[0] == "**To fly fast**, keep the default: no faster setting is known to be as good."
    assert not any("encoder" in line or "Undecided" in line for line in said)


def test_the_page_says_what_made_it_and_what_could_not_fly():
    text = page(ABOUT, ROWS)
    assert (
        "Made on 2026-01-02 by `python -m platform.launch +exp=trade` at commit c0ffee on `somewhere`" in text
    )
    assert "Not flown: pyrender samples 1: RuntimeError: no OpenGL." in text
    assert text.count("(images/trade.png)") == 1
    assert text.count("\n| ") == len(ROWS) + 2


def test_every_number_of_the_advice_is_in_the_table():
    text = page(ABOUT, ROWS)
    advised, table = text.split("## Every setting")
    for word in ("8,000", "11", "-65 [-70, -60]"):
        assert word in advised
        assert word in table


def test_metrics_leave_out_what_was_not_measured():
    assert metrics(DEFAULT)["perf/env_steps_per_second"] == 4000.0
    assert metrics(DEFAULT)["sim/event_error"] == 0.02
    assert "sim/event_error" not in metrics(ROUNDED)
    assert all(value == value for row in ROWS for value in metrics(row).values())


def test_the_figure_has_a_panel_for_each_measure_and_a_point_for_each_setting():
    named = [(row.knob, row.setting, row.steps_per_s) for row in ROWS]
    figure = choice_figure(named, panels(ROWS))
    assert [axes.get_ylabel() for axes in figure.axes] == [panel.label for panel in panels(ROWS)]
    drawn = [sum(len(points.get_offsets()) for points in axes.collections[-6:]) for axes in figure.axes]
    assert drawn == [len(ROWS)] * 3
