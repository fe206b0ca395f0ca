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
    verdicts,
)

GROUPS, SCENES = ("bytestream", "bytestream_hold"), ("poles_eval", "shape_change")


def outcome(change, half=0.05, p=0.5, other=0.01, success=0.9):
    difference = Difference(change, (change - half, change + half), p)
    return Outcome(3, 60, Estimate(success + change, (0.7, 0.99)), difference, other)


def make_row(
    knob, setting="", scene="poles_eval", speed=1.0, error=0.02, change=0.0, groups=(0.0, 0.0), **given
):
    outcomes = dict(zip(GROUPS, (outcome(one) for one in groups), strict=True))
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


ROWS = [row for scene in SCENES for row in rows_of(scene)]


@pytest.mark.parametrize(
    ("change", "half", "p", "groups", "expected"),
    [
        (-0.04, 0.05, 1e-9, (0.0, -0.08), "as good"),
        (-0.04, 0.05, 0.5, (0.0, -0.12), "undecided"),  # one group loses more than the margin
        (-0.20, 0.05, 0.03, (-0.2, -0.2), "undecided"),  # one of several tests
        (-0.20, 0.05, 1e-4, (-0.2, -0.2), "worse"),
        (0.30, 0.45, 1e-4, (0.3, 0.3), "undecided"),
    ],
)
def test_a_verdict_follows_the_interval_the_groups_and_a_test_for_all_rows(change, half, p, groups, expected):
    row = make_row("tolerance", change=change, half=half, p=p, groups=groups)
    found = verdicts([make_row("default"), row, *[make_row("encoding", str(k)) for k in range(5)]])
    assert found[:2] == ["default", expected]


def test_no_setting_on_the_front_is_beaten_beyond_doubt_and_an_encoder_has_no_event_error():
    assert on_front(rows_of("poles_eval")) == [True, True, True, False, False, False, True]
    assert on_front([make_row("a", speed=1.0), make_row("b", speed=1.04)]) == [True, True]


def test_every_line_has_a_word_for_each_heading_and_each_scene_its_own():
    text = trade_lines(ROWS, GROUPS)
    assert {len(line) for line in text} == {len(headings(GROUPS))}
    assert text[0][:6] == ("default", "", "4,000", "1.00 [0.95, 1.05]", "2", "10")
    assert text[5][4] == "-"
    words = ["default", "as good", "worse", "undecided", "worse", "as good", "as good"]
    assert [line[-1] for line in text] == 2 * words


def test_advice_is_the_fastest_that_is_as_good_in_each_scene_and_what_to_avoid():
    found = advise(ROWS)
    assert found.fastest.name == found.coarsest.name == "tolerance 0.5"
    assert found.encoder.name == "precision int8"
    assert [one.name for one in found.worse] == ["memory legacy", "renders 1"]
    assert [one.name for one in found.undecided] == ["pyrender samples 1"]


def test_what_is_not_as_good_in_one_scene_is_not_advised():
    rows = list(ROWS)
    rows[8] = rows[8]._replace(outcomes={**rows[8].outcomes, ALL: outcome(-0.4, p=1e-9)})
    assert advise(rows).fastest.name == "precision int8"
    assert {one.name: one.verdict for one in choices(rows)}["tolerance 0.5"] == "worse"
    only_here = [*rows_of("poles_eval"), make_row("culling", "cull_m 20"), *rows_of("shape_change")]
    assert "culling cull_m 20" not in {one.name for one in choices(only_here)}


def test_another_camera_is_reported_and_never_advised():
    as_good = [make_row("memory", "memory legacy", scene, 3.0, 0.8) for scene in SCENES]
    first, second = rows_of("poles_eval"), rows_of("shape_change")
    found = advise([*first[:2], as_good[0], *second[:2], as_good[1]])
    assert found.fastest.name == found.coarsest.name == "tolerance 0.5"
    assert [one.name for one in found.cameras] == ["memory legacy"]


def test_where_nothing_faster_is_as_good_the_default_stays():
    slower = make_row("anti-aliasing", "samples 8", speed=0.7, error=0.01)
    hardly = make_row("tolerance", "tolerance 0.1", speed=1.03)  # within the scatter of the timings
    once = make_row("tolerance", "tolerance 0.2")._replace(speed=Estimate(2.0, None))  # one timing tells none
    rows = [make_row("default"), slower, hardly, once, make_row("most exact", error=0.0)]
    assert advise(rows).fastest is advise(rows).encoder is None
    assert on_front(rows)[2:] == [True, True, True]


def test_published_settings_hold_all_that_the_plot_shows():
    settings = setting_values(ROWS)
    assert len(settings) == 3 * len(ROWS)
    assert all(tuple(one) == SETTING_FIELDS for one in settings)
    speeds, errors, changes = draw_settings(settings).axes
    rows = [label.get_text().removesuffix(" *") for label in speeds.get_yticklabels()]
    names = [row.name if row.setting == "int8" else row.setting or row.knob for row in ROWS]
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
    told = [trade_metrics(row, group) for row in ROWS for group in row.outcomes]
    assert all(value == value for metrics in told for value in metrics.values())
