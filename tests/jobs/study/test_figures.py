import numpy as np
import pytest

from jobs.analysis.colours import BASELINE_STYLES, GROUP_STYLES, TAUGHT
from jobs.analysis.plots import style_of
from jobs.analysis.statistics import Difference
from jobs.rollout.policies import PRETRAINED
from jobs.run.provenance import REPOSITORY
from jobs.study.axis_figure import axis_figure
from jobs.study.changes import Change, changes_of
from jobs.study.computed import Study, compute, published
from jobs.study.figures import KINDS, change_map, still_going, worst_conditions
from jobs.study.page import figures
from jobs.study.results import Results, read_cells
from jobs.study.spec import read_study
from jobs.study.summaries import summarise
from models.policy.policy import MANIFEST
from tests.support.episodes import flights
from tests.support.sweep_folders import ABOUT, write_sweep

DATA = REPOSITORY / "docs" / "data"
NOMINAL, FEW, MANY = ("nominal", "poles_eval"), ("sparsity", 0.2), ("sparsity", 0.5)
RATES = {hz: {"env.control_hz": hz, "env.scene": "poles"} for hz in (45.0, 200.0, 400.0)}
WORLDS = {name: {"env.scene": name} for name in ("poles", "shape_change")}
DRAWN = [("ppo_claims", "forest"), ("camera_rates", "lines")]
DRAWN += [("encoder_seeds", "spread"), ("ppo_event_set", "dots")]
BOTH = {hz: {"env.control_hz": hz, "faults.sparsity": off} for hz, off in ((200.0, 0.0), (45.0, 0.5))}


@pytest.fixture
def swept(tmp_path):
    return read_cells(write_sweep(tmp_path / "sweep") / "episodes.csv")


def rows_of(points, groups):
    return [
        summarise(("here", value), group, {0: flights(5 * place), 1: flights(4 * place)})
        for place, value in enumerate(points)
        for group in groups
    ]


@pytest.mark.parametrize(
    ("points", "joined", "ticks", "same"),
    [
        (RATES, True, ["45", "200", "400"], "scene poles"),
        (WORLDS, False, ["poles", "shape\nchange"], "here"),
        (BOTH, False, ["control_hz 200\nsparsity 0", "control_hz 45\nsparsity 0.5"], "here"),
    ],
    ids=["numbers", "words", "two settings"],
)
def test_groups_stand_side_by_side_at_ticks_that_say_what_changes_with_lines_over_numbers_alone(
    points, joined, ticks, same
):
    figure = axis_figure("here", points, rows_of(points, ("bytestream", "event_image", "oracle")))
    panel = figure.axes[0]
    assert panel.get_legend_handles_labels()[1] == ["bytestream", "event_image", "oracle"]
    places = np.array([line.get_xdata() for line in panel.lines])
    assert (np.diff(places, axis=0) > 0).all()
    assert np.ptp(places, axis=0).max() < 0.5
    assert all((line.get_linewidth() > 0) is joined for line in panel.lines)
    assert [label.get_text() for label in panel.get_xticklabels()] == ticks
    assert same in figure._supxlabel.get_text()
    gap = axis_figure("here", points, rows_of(points, ("a", "b"))[:-1]).axes[0].lines
    assert [len(line.get_xdata()) for line in gap] == [len(points), len(points) - 1]


def test_every_experiment_and_every_shipped_policy_has_a_look_of_its_own():
    looks = [style_of(group) for group in (*GROUP_STYLES, *BASELINE_STYLES)]
    taught = {group: style_of(f"{TAUGHT}{group}") for group in GROUP_STYLES}
    assert len({colour for colour, _ in (*looks, *taught.values())}) == len(looks) + len(taught)
    assert all(marker == GROUP_STYLES[group][1] for group, (_, marker) in taught.items())
    assert len({marker for _, marker in looks[: len(GROUP_STYLES)]}) == len(GROUP_STYLES)
    assert style_of("mine") == style_of("mine")
    shipped = {path.parent.name.rpartition("-s")[0] for path in PRETRAINED.glob(f"*/{MANIFEST}")}
    assert {group.removeprefix(TAUGHT) for group in shipped} <= GROUP_STYLES.keys()


def test_episodes_continue_until_they_end():
    episodes = flights(5, trials=20)
    x, share = still_going(episodes, 100.0)
    assert (x[0], x[-1], share[0], share[-1]) == (0.0, 100.0, 1.0, 5 / 20)
    assert (np.diff(x) >= 0).all()
    for at in (10.0, 47.5, 52.5, 99.0):
        beyond = np.mean(episodes["success"] | (episodes["distance_m"] > at))
        assert share[x <= at][-1] == pytest.approx(beyond)
    alone = still_going(flights(20), 100.0)
    assert [list(part) for part in alone] == [[0.0, 100.0], [1.0, 1.0]]


def test_a_group_has_a_worst_condition_if_it_was_evaluated_unchanged(swept):
    del swept[NOMINAL, "event_image"]
    results = Results(ABOUT, swept)
    assert set(worst_conditions(results, changes_of(results))) == {"bytestream"}


def test_the_map_of_changes_says_each_success_once_below_the_baseline(swept):
    before, success = np.array([1.0, 0.5]), np.array([0.5, 0.0])
    changes = [
        Change(at, NOMINAL, "bytestream", success, before, Difference(-0.5, None, None), False, success < 0)
        for at in (FEW, MANY)
    ]
    panel = change_map(Study("", {}, Results(ABOUT, swept), changes, [], {}, [], {}), {}).axes[0]
    assert panel.get_yticklabels()[0].get_text() == "nothing changed"
    texts = {text.get_position(): text.get_text() for text in panel.texts}
    assert texts == {(0, 0): "75", (0, 1): "25", (0, 2): "25"}
    assert len(panel.texts) == 3


@pytest.mark.parametrize(("name", "kind"), DRAWN)
def test_published_figures_are_drawn_from_their_data(name, kind):
    study = published(DATA, name, name)
    (said,) = [one for one in study.said["figures"].values() if one["kind"] == kind]
    figure = KINDS[kind](study, said)
    marks = sum(len(panel.lines) + len(panel.texts) for panel in figure.axes)
    assert marks >= len(study.results.trained)


def test_figures_that_need_more_than_was_evaluated_are_left_out(swept):
    """A study of one training along one axis without numbers has nothing to compare."""
    about = {**ABOUT, "groups": {"bytestream": [0]}, "axes": {"nominal": {"poles_eval": {}}}}
    alone = {(NOMINAL, "bytestream"): {0: swept[NOMINAL, "bytestream"][0]}}
    said = read_study("robustness")
    study = compute("alone", said, Results(about, alone), [], None)
    assert set(figures(study)) == {"results_survival"}
