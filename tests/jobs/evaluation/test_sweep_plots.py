import numpy as np
import pytest
import yaml

from jobs.analysis.plots import BASELINE_STYLES, GROUP_STYLES, TAUGHT, style_of
from jobs.config.conditions import axis_points
from jobs.evaluation.group_stats import summarise_group
from jobs.evaluation.sweep_plan import value_text
from jobs.evaluation.sweep_plots import axis_figure, collision_figure
from jobs.rollout.episodes import EPISODE
from jobs.rollout.policies import PRETRAINED
from jobs.run.provenance import REPOSITORY
from models.policy.policy import MANIFEST
from tests.support.episodes import flights


def rows_of(axis, values, groups):
    return [
        summarise_group((axis, value), group, {0: flights(5 * place), 1: flights(4 * place)})
        for place, value in enumerate(values)
        for group in groups
    ]


def test_numbers_are_lines_and_each_group_has_its_own_with_a_band():
    points = {value: {"env.control_hz": float(value), "env.scene": "poles"} for value in ("45", "200", "400")}
    figure = axis_figure("rate", points, rows_of("rate", points, ("bytestream", "event_image")))
    panel = figure.axes[0]
    assert [label.get_text() for label in panel.get_xticklabels()] == ["45", "200", "400"]
    assert panel.get_xscale() == "log"
    assert panel.get_xlabel() == "Control rate [Hz]"
    assert panel.get_legend_handles_labels()[1] == ["bytestream", "event_image"]
    assert len(panel.collections) == 2
    assert (
        "scene poles; 40 episodes of 2 trainings"
        in figure.texts[-1].get_text() + figure._supxlabel.get_text()
    )


@pytest.mark.parametrize(
    ("key", "values"), [("env.control_hz", (45, 200, 400)), ("faults.sparsity", (0, 0.5, 1))]
)
def test_many_groups_get_bars_beside_each_other_in_order_and_none_for_baselines(key, values):
    points = {f"{value:g}": {key: float(value)} for value in values}
    groups = ("a", "b", "c", "d", "e", "straight")
    panel = axis_figure("rate", points, rows_of("rate", points, groups)).axes[0]
    assert len(panel.collections) == 5
    lines = np.array([line.get_xdata() for line in panel.lines])
    assert (np.diff(lines[:5], axis=0) > 0).all()
    np.testing.assert_allclose(lines[[2, 5]], [values] * 2)
    assert np.ptp(lines, axis=0).max() < 0.3 * np.diff(values).min()


@pytest.mark.parametrize(
    ("points", "ticks"),
    [
        ({name: {"env.scene": name} for name in ("poles", "shape_change")}, ["poles", "shape\nchange"]),
        (
            {str(hz): {"env.control_hz": hz, "faults.sparsity": off} for hz, off in ((200, 0.0), (45, 0.5))},
            ["control_hz 200\nsparsity 0", "control_hz 45\nsparsity 0.5"],
        ),
        (
            {name: {"env.scene": name, "fidelity.tolerance": asked}
             for name, asked in (("poles", 0.05), ("shape_change", 0.2))},
            ["poles\ntolerance 0.05", "shape\nchange\ntolerance 0.2"],
        ),
    ],
)  # fmt: skip
def test_words_and_settings_that_change_together_are_bars(points, ticks):
    panel = axis_figure("here", points, rows_of("here", points, ("a", "b", "c"))).axes[0]
    assert [label.get_text() for label in panel.get_xticklabels()] == ticks
    heights = [bar.get_height() for bar in panel.patches]
    assert heights == pytest.approx([0, 22.5] * 3)


def test_every_axis_of_the_default_sweep_can_be_drawn():
    axes = yaml.safe_load((REPOSITORY / "conf" / "sweep" / "robustness.yaml").read_text())["axes"]
    for axis, settings in axes.items():
        points = {value_text(next(iter(point.values()))): point for point in axis_points(settings)}
        panel = axis_figure(axis, points, rows_of(axis, points, ("a", "b"))).axes[0]
        assert len(panel.get_xticklabels()) == len(points), axis


def test_a_condition_that_was_not_evaluated_leaves_a_gap():
    points = {name: {"env.scene": name} for name in ("poles", "dynamic")}
    rows = rows_of("world", points, ("a", "b"))[:-1]
    assert len(axis_figure("world", points, rows).axes[0].patches) == 3


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
    panel = collision_figure({"bytestream": (episodes, episodes[:1])}, 100.0, 25.0).axes[0]
    usual, changed = (np.asarray(dots.get_offsets()) for dots in panel.collections[:2])
    np.testing.assert_array_equal(usual, [[10.0, 1.0], [20.0, -2.0], [30.0, 3.0]])
    assert len(changed) == 1
    assert panel.get_title("left") == "bytestream: contacts unchanged 3 of 4, changed 1 of 1"


def test_every_policy_that_is_shipped_has_a_look_of_its_own():
    shipped = {path.parent.name.rpartition("-s")[0] for path in PRETRAINED.glob(f"*/{MANIFEST}")}
    assert {group.removeprefix(TAUGHT) for group in shipped} <= GROUP_STYLES.keys()
