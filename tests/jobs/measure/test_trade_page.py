import pytest
from matplotlib.collections import PathCollection

from jobs.analysis.statistics import Difference, Estimate
from jobs.measure.plots import draw_settings
from jobs.measure.trade_page import (
    ALL,
    SETTING_FIELDS,
    Outcome,
    TradedSetting,
    advise,
    choices,
    headings,
    on_front,
    setting_values,
    trade_lines,
    trade_metrics,
    trade_page,
    verdicts,
)

ABOUT = {
    "run": "trade-short-s0-1",
    "command": "python -m platform.launch +exp=trade",
    "commit": "c0ffee",
    "date": "2026-01-02",
    "host": "somewhere",
    "cpus": 2,
    "policies": {"bytestream": 3, "bytestream_hold": 5},
    "scenes": ["poles_eval", "shape_change"],
    "met": {"bytestream_hold": ["tolerance 0.5", "samples 1"]},
    "action": "stochastic",
    "trials": 20,
    "pyrender_trials": 4,
    "replays": 2,
    "failed": {"pyrender samples 1 of bytestream s0": "RuntimeError: no OpenGL"},
}


def outcome(change, half=0.05, p=0.5, other=0.01, success=0.9):
    difference = Difference(change, (change - half, change + half), p)
    return Outcome(3, 60, Estimate(success + change, (0.7, 0.99)), difference, other)


def make_row(
    knob, setting="", scene="poles_eval", speed=1.0, error=0.02, change=0.0, groups=(0.0, 0.0), **given
):
    outcomes = dict(zip(ABOUT["policies"], (outcome(one) for one in groups), strict=True))
    ratio = Estimate(speed, (0.95 * speed, 1.05 * speed))
    outcomes[ALL] = outcome(change, **given)
    return TradedSetting(scene, knob, setting, 250.0 / speed, ratio, error, 0.1, outcomes)


def rows_of(scene):
    return [
        make_row("default", scene=scene),
        make_row("tolerance", "tolerance 0.5", scene, 2.0, 0.11, 0.01),
        make_row("memory", "memory legacy", scene, 2.5, 0.8, -0.5, p=1e-9),
        make_row("pyrender", "samples 1", scene, 0.1, 0.9, -0.05, half=0.2),
        make_row("renders", "renders 1", scene, 1.5, 0.3, -0.3, p=1e-9),
        make_row("precision", "int8", scene, 1.2, 0.02),
        make_row("most exact", "", scene, 0.1, 0.0),
    ]


ROWS = [row for scene in ABOUT["scenes"] for row in rows_of(scene)]


@pytest.mark.parametrize(
    ("change", "half", "p", "groups", "expected"),
    [
        (-0.04, 0.05, 0.5, (0.0, -0.08), "as good"),
        (-0.04, 0.05, 1e-9, (0.0, -0.08), "as good"),
        (-0.04, 0.05, 0.5, (0.0, -0.12), "undecided"),  # one group loses more than the margin
        (-0.06, 0.05, 0.5, (-0.06, -0.06), "undecided"),
        (-0.20, 0.05, 0.03, (-0.2, -0.2), "undecided"),  # one of several tests
        (-0.20, 0.05, 1e-4, (-0.2, -0.2), "worse"),
        (0.30, 0.45, 1e-4, (0.3, 0.3), "undecided"),
    ],
)
def test_a_verdict_follows_the_interval_the_groups_and_a_test_for_all_rows(change, half, p, groups, expected):
    row = make_row("tolerance", change=change, half=half, p=p, groups=groups)
    found = verdicts([make_row("default"), row, *[make_row("encoding", str(k)) for k in range(5)]])
    assert found[:2] == ["default", expected]
    assert "-10 points" in trade_page(ABOUT, ROWS)


def test_no_setting_on_the_front_is_beaten_beyond_doubt_and_an_encoder_has_no_event_error():
    own = rows_of("poles_eval")
    assert on_front(own) == [True, True, True, False, False, False, True]
    noisy = [make_row("a", speed=1.0, error=0.02), make_row("b", speed=1.04, error=0.02)]
    assert on_front(noisy) == [True, True]


def test_every_line_has_a_word_for_each_heading_and_each_scene_its_own():
    groups = list(ABOUT["policies"])
    text = trade_lines(ROWS, groups)
    assert {len(line) for line in text} == {len(headings(groups))}
    assert text[0][:6] == ("default", "", "4,000", "1.00 [0.95, 1.05]", "2", "10")
    assert text[0][-2:] == ("", "default")
    assert text[5][4] == "-"
    words = ["default", "as good", "worse", "undecided", "worse", "as good", "as good"]
    assert [line[-1] for line in text] == 2 * words


def test_advice_is_the_fastest_that_is_as_good_in_each_scene_and_what_to_avoid():
    found = advise(ROWS)
    assert found.fastest.name == found.coarsest.name == "tolerance 0.5"
    assert found.encoder.name == "precision int8"
    assert [one.name for one in found.worse] == ["memory legacy", "renders 1"]
    assert [one.name for one in found.undecided] == ["pyrender samples 1"]
    text = trade_page(ABOUT, ROWS)
    assert "choose the setting *tolerance 0.5*" in text
    assert "renders 1 (-30 [-35, -25] points in" in text


def test_what_is_not_as_good_in_one_scene_is_not_advised():
    rows = [*rows_of("poles_eval"), *rows_of("shape_change")]
    rows[8] = rows[8]._replace(outcomes={**rows[8].outcomes, ALL: outcome(-0.4, p=1e-9)})
    assert advise(rows).fastest.name == "precision int8"
    assert {one.name: one.verdict for one in choices(rows)}["tolerance 0.5"] == "worse"
    only_here = [make_row("culling", "cull_m 20"), *rows_of("shape_change")]
    assert "culling cull_m 20" not in {
        one.name for one in choices([*rows_of("poles_eval"), *only_here[:1], *only_here[1:]])
    }


def test_another_camera_is_reported_and_never_advised():
    as_good = [make_row("memory", "memory legacy", scene, 3.0, 0.8) for scene in ABOUT["scenes"]]
    first, second = rows_of("poles_eval"), rows_of("shape_change")
    found = advise([*first[:2], as_good[0], *second[:2], as_good[1]])
    assert found.fastest.name == found.coarsest.name == "tolerance 0.5"
    assert [one.name for one in found.cameras] == ["memory legacy"]


def test_where_nothing_faster_is_as_good_the_default_stays():
    slower = make_row("anti-aliasing", "samples 8", speed=0.7, error=0.01)
    hardly = make_row("tolerance", "tolerance 0.1", speed=1.03)  # within the scatter of the timings
    found = advise([make_row("default"), slower, hardly, make_row("most exact", error=0.0)])
    assert found.fastest is found.encoder is None
    text = trade_page(ABOUT, [make_row("default"), slower, hardly, make_row("most exact", error=0.0)])
    assert "keep the default" in text
    assert "Undecided" not in text


def test_a_single_timing_says_nothing_of_speed():
    once = make_row("tolerance", "tolerance 0.1", speed=2.0)._replace(speed=Estimate(2.0, None))
    rows = [make_row("default"), once, make_row("most exact", error=0.0)]
    assert advise(rows).fastest is None
    assert on_front(rows) == [True, True, True]


def test_the_page_says_what_made_it_and_what_could_not_be_evaluated():
    text = trade_page(ABOUT, ROWS)
    assert (
        "Made on 2026-01-02 by `python -m platform.launch +exp=trade` at commit c0ffee on `somewhere`" in text
    )
    assert "pyrender samples 1 of bytestream s0: RuntimeError: no OpenGL." in text
    assert text.count("(images/trade.png)") == 1
    assert (
        "`bytestream_hold` also met tolerance 0.5, samples 1. So the advice is for `bytestream_hold`" in text
    )
    shown = [line.split("|")[1].strip() for line in text.splitlines() if line.startswith("| ")][2:]
    assert shown[0] == "default"
    assert shown[-1] == "most exact"
    assert {"tolerance 0.5", "precision int8", "memory legacy", "renders 1"} <= set(shown)


def test_published_settings_hold_all_that_the_plot_shows():
    settings = setting_values(ROWS)
    assert len(settings) == 3 * len(ROWS)
    assert all(tuple(one) == SETTING_FIELDS for one in settings)
    speeds, errors, changes = draw_settings(settings).axes
    names = [
        f"{row.knob} {row.setting}" if row.setting == "int8" else row.setting or row.knob for row in ROWS
    ]
    rows = [label.get_text().removesuffix(" *") for label in speeds.get_yticklabels()]
    assert rows == list(dict.fromkeys(names))
    dots = [part for part in changes.collections if isinstance(part, PathCollection)]
    for own, part in zip((ROWS[:7], ROWS[7:]), dots, strict=True):
        drawn = part.get_offsets()[:, 0]
        assert list(drawn) == pytest.approx([100 * row.outcomes[ALL].difference.value for row in own])
    assert (speeds.get_xscale(), errors.get_xscale()) == ("log", "symlog")


def test_metrics_leave_out_what_was_not_measured():
    assert trade_metrics(ROWS[0])["perf/env_steps_per_second"] == 4000.0
    assert trade_metrics(ROWS[0])["sim/event_error"] == 0.02
    assert "sim/event_error" not in trade_metrics(ROWS[5])
    assert all(
        value == value
        for row in ROWS
        for group in row.outcomes
        for value in trade_metrics(row, group).values()
    )
