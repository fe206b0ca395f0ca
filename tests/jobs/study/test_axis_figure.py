import numpy as np
import pytest

from jobs.analysis.colours import BASELINE_STYLES, GROUP_STYLES, TAUGHT
from jobs.analysis.plots import style_of
from jobs.config.conditions import NOMINAL
from jobs.rollout.episodes import EPISODE
from jobs.rollout.policies import PRETRAINED
from jobs.study.axis_figure import axis_figure
from jobs.study.figures import contact_map
from jobs.study.plan import axes_of
from jobs.study.spec import read_study
from jobs.study.summaries import summarise
from models.policy.policy import MANIFEST
from tests.support.episodes import flights


def rows_of(axis, values, groups):
    return [
        summarise((axis, value), group, {0: flights(5 * place), 1: flights(4 * place)})
        for place, value in enumerate(values)
        for group in groups
    ]


def test_each_group_has_its_own_markers_set_apart_and_lines_over_numbers_alone():
    numbers = {hz: {"env.control_hz": hz, "env.scene": "poles"} for hz in (45.0, 200.0, 400.0)}
    words = {name: {"env.scene": name} for name in ("poles", "shape_change")}
    for points, joined in ((numbers, True), (words, False)):
        figure = axis_figure("rate", points, rows_of("rate", points, ("bytestream", "event_image", "oracle")))
        panel = figure.axes[0]
        assert panel.get_legend_handles_labels()[1] == ["bytestream", "event_image", "oracle"]
        lines = np.array([line.get_xdata() for line in panel.lines])
        assert (np.diff(lines, axis=0) > 0).all()
        assert np.ptp(lines, axis=0).max() < 0.5
        assert all((line.get_linewidth() > 0) is joined for line in panel.lines)
    assert (
        "scene poles" in axis_figure("rate", numbers, rows_of("rate", numbers, ("a",)))._supxlabel.get_text()
    )


@pytest.mark.parametrize(
    ("points", "ticks"),
    [
        ({name: {"env.scene": name} for name in ("poles", "shape_change")}, ["poles", "shape\nchange"]),
        (
            {hz: {"env.control_hz": hz, "faults.sparsity": off} for hz, off in ((200.0, 0.0), (45.0, 0.5))},
            ["control_hz 200\nsparsity 0", "control_hz 45\nsparsity 0.5"],
        ),
    ],
)
def test_a_tick_says_every_setting_that_changes(points, ticks):
    panel = axis_figure("here", points, rows_of("here", points, ("a", "b", "c"))).axes[0]
    assert [label.get_text() for label in panel.get_xticklabels()] == ticks


def test_every_axis_of_the_default_sweep_can_be_drawn():
    for axis, points in axes_of("poles_eval", read_study("robustness")["axes"]).items():
        if axis == NOMINAL:
            continue
        panel = axis_figure(axis, points, rows_of(axis, points, ("a", "b"))).axes[0]
        assert len(panel.get_xticklabels()) == len(points), axis


def test_a_condition_that_was_not_evaluated_leaves_a_gap():
    points = {name: {"env.scene": name} for name in ("poles", "dynamic")}
    rows = rows_of("world", points, ("a", "b"))[:-1]
    lines = axis_figure("world", points, rows).axes[0].lines
    assert [len(line.get_xdata()) for line in lines] == [2, 1]


def test_every_experiment_has_a_colour_and_marker_of_its_own():
    looks = [style_of(group) for group in (*GROUP_STYLES, *BASELINE_STYLES)]
    taught = {group: style_of(f"{TAUGHT}{group}") for group in GROUP_STYLES}
    assert len({colour for colour, _ in (*looks, *taught.values())}) == len(looks) + len(taught)
    assert all(marker == GROUP_STYLES[group][1] for group, (_, marker) in taught.items())
    assert len({marker for _, marker in looks[: len(GROUP_STYLES)]}) == len(GROUP_STYLES)
    assert style_of("mine") == style_of("mine")


def test_the_map_shows_contacts_alone():
    episodes = np.zeros(4, EPISODE)
    episodes["collision"] = [True, True, False, True]
    episodes["distance_m"], episodes["x_m"] = [10.0, 20.0, 100.0, 30.0], [1.0, -2.0, 0.0, 3.0]
    panel = contact_map({"bytestream": (episodes, episodes[:1])}, 100.0, 25.0).axes[0]
    usual, changed = (np.asarray(dots.get_offsets()) for dots in panel.collections[:2])
    np.testing.assert_array_equal(usual, [[10.0, 1.0], [20.0, -2.0], [30.0, 3.0]])
    assert len(changed) == 1
    assert panel.get_title("left") == "bytestream: contacts unchanged 3 of 4, changed 1 of 1"


def test_every_policy_that_is_shipped_has_a_look_of_its_own():
    shipped = {path.parent.name.rpartition("-s")[0] for path in PRETRAINED.glob(f"*/{MANIFEST}")}
    assert {group.removeprefix(TAUGHT) for group in shipped} <= GROUP_STYLES.keys()
