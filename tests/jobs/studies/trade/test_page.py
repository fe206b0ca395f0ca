import pytest

from jobs.analysis.statistics import Estimate
from jobs.analysis.tables import summarise
from jobs.studies.replays import Measured
from jobs.studies.trade.page import (
    HEADINGS,
    TradedSetting,
    advise,
    draw_settings,
    fronts,
    panels,
    setting_values,
    trade_lines,
    trade_metrics,
    trade_page,
)
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
    summary = summarise((knob, setting), flights(won))
    measured = Measured(step_us, error, 0.1, other)
    return TradedSetting(knob, setting, measured, summary, Estimate((low + high) / 2, (low, high)))


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
    assert row.verdict == expected
    assert row._replace(knob="default").verdict == "default"
    assert "-10 points" in trade_page(ABOUT, ROWS)


def test_fronts_hold_what_is_not_beaten_and_know_no_event_error_of_an_encoder():
    found = fronts(ROWS)
    assert found == {"e": [2, 1, 0, 5], "a": [2, 1, 4, 5], "s": [2, 1]}
    assert [panel.front for panel in panels(setting_values(ROWS))] == list(found.values())


def test_every_line_has_a_word_for_each_heading():
    text = trade_lines(ROWS)
    assert {len(line) for line in text} == {len(HEADINGS)}
    assert text[0][:6] == ("default", "", "4,000", "2", "10", "1")
    assert text[0][8] == ""
    assert text[4][3] == "-"
    assert [line[10] for line in text] == ["default", "as good", "worse", "undecided", "as good", "as good"]


def test_advice_is_the_fastest_of_the_good_and_what_to_avoid():
    found = advise(ROWS)
    assert found.fastest is found.coarsest is COARSE
    assert found.encoder is ROUNDED
    assert (found.worse, found.undecided) == ([FORGETFUL], [FEW])
    text = trade_page(ABOUT, ROWS)
    assert "choose tolerance 0.5" in text
    assert "8,000 steps/s, 2 times" in text
    assert "memory legacy (-65 [-70, -60])" in text


def test_another_camera_is_reported_and_never_advised():
    as_good = make_row("memory", "memory legacy", 100.0, 0.8)
    found = advise([DEFAULT, COARSE, as_good, EXACT])
    assert found.fastest is found.coarsest is COARSE
    assert found.cameras == [as_good]
    assert "memory legacy: 80 %" in trade_page(ABOUT, [DEFAULT, COARSE, as_good, EXACT])


def test_where_nothing_faster_is_as_good_the_default_stays():
    found = advise([DEFAULT, FORGETFUL, EXACT])
    assert found.fastest is DEFAULT
    assert found.encoder is None
    text = trade_page(ABOUT, [DEFAULT, FORGETFUL, EXACT])
    assert "keep the default" in text
    assert "Undecided" not in text
    assert "\n\n-" not in text.split("## What to choose")[1].split("- **For speed**")[1], "one list"


def test_the_page_says_what_made_it_and_what_could_not_be_evaluated():
    text = trade_page(ABOUT, ROWS)
    assert (
        "Made on 2026-01-02 by `python -m platform.launch +exp=trade` at commit c0ffee on `somewhere`" in text
    )
    assert "pyrender samples 1: RuntimeError: no OpenGL." in text
    assert text.count("(images/trade.png)") == 1
    assert text.count("\n| ") == len(ROWS) + 2


def test_every_number_of_the_advice_is_in_the_table():
    text = trade_page(ABOUT, ROWS)
    advised, table = text.split("## Every setting")
    for word in ("8,000", "11", "-65 [-70, -60]"):
        assert word in advised
        assert word in table


def test_metrics_leave_out_what_was_not_measured():
    assert trade_metrics(DEFAULT)["perf/env_steps_per_second"] == 4000.0
    assert trade_metrics(DEFAULT)["sim/event_error"] == 0.02
    assert "sim/event_error" not in trade_metrics(ROUNDED)
    assert all(value == value for row in ROWS for value in trade_metrics(row).values())


def test_the_figure_has_a_panel_for_each_measure_and_a_point_for_each_setting():
    settings = setting_values(ROWS)
    figure = draw_settings(settings)
    assert [axes.get_ylabel() for axes in figure.axes] == [panel.label for panel in panels(settings)]
    drawn = [sum(len(points.get_offsets()) for points in axes.collections[-6:]) for axes in figure.axes]
    assert drawn == [len(ROWS)] * 3
