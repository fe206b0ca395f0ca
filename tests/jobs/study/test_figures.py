import numpy as np
import pytest

from jobs.analysis.statistics import Difference
from jobs.run.provenance import REPOSITORY
from jobs.study.changes import Change, changes_of
from jobs.study.computed import Study, compute, published
from jobs.study.figures import (
    KINDS,
    change_map,
    contact_ends,
    numeric_axes,
    still_going,
    worst_conditions,
)
from jobs.study.page import figures
from jobs.study.results import Results, read_cells
from jobs.study.spec import read_study
from tests.support.episodes import flights
from tests.support.sweep_folders import ABOUT, write_sweep

DATA = REPOSITORY / "docs" / "data"
NOMINAL, FEW, MANY = ("nominal", "poles_eval"), ("sparsity", 0.2), ("sparsity", 0.5)


@pytest.fixture
def swept(tmp_path):
    return read_cells(write_sweep(tmp_path / "sweep") / "episodes.csv")


def test_episodes_continue_until_they_end():
    episodes = flights(5, trials=20)
    x, share = still_going(episodes, 100.0)
    assert (x[0], x[-1], share[0], share[-1]) == (0.0, 100.0, 1.0, 5 / 20)
    assert (np.diff(x) >= 0).all()
    assert (np.diff(share) <= 1e-12).all()
    for at in (10.0, 47.5, 52.5, 99.0):
        beyond = np.mean(episodes["success"] | (episodes["distance_m"] > at))
        assert share[x <= at][-1] == pytest.approx(beyond)
    alone = still_going(flights(20), 100.0)
    assert [list(part) for part in alone] == [[0.0, 100.0], [1.0, 1.0]]


def test_the_worst_condition_of_a_group_is_the_one_it_succeeds_least_in(swept):
    for one in swept[FEW, "bytestream"].values():
        one["success"][:] = False
    results = Results(ABOUT, swept)
    assert worst_conditions(results, changes_of(results))["bytestream"] == FEW
    del swept[NOMINAL, "event_image"]  # of which nothing was evaluated unchanged
    assert set(worst_conditions(results, changes_of(results))) == {"bytestream"}


def test_contacts_are_those_of_the_same_scene_and_of_no_simulation_twice(swept):
    found = contact_ends(Results(ABOUT, swept))
    assert [len(part) for part in found["bytestream"]] == [3 * 20, 2 * 3 * 20]
    assert [len(part) for part in found["oracle"]] == [20, 0]  # sees no events: dead pixels change nothing
    swept[FEW, "bytestream"] = swept[NOMINAL, "bytestream"]
    dense = {"0.2": {"faults.sparsity": 0.2}, "0.5": {"env.scene": "poles_dense"}}
    axes = {"sparsity": dense, "nominal": {"poles_eval": {}}}  # the unchanged condition stands last
    assert [len(part) for part in contact_ends(Results({**ABOUT, "axes": axes}, swept))["bytestream"]] == [
        60,
        0,
    ]


def test_the_map_says_each_success_once_below_the_baseline(swept):
    before, success = np.array([1.0, 0.5]), np.array([0.5, 0.0])
    changes = [
        Change(at, NOMINAL, "bytestream", success, before, Difference(-0.5, None, None), False, success < 0)
        for at in (FEW, MANY)
    ]
    panel = change_map(Study("", {}, Results(ABOUT, swept), changes, [], {}, [], {}), {}).axes[0]
    assert panel.get_yticklabels()[0].get_text() == "nothing changed"
    assert [(text.get_position(), text.get_text()) for text in panel.texts] == [
        ((0, 0), "75"), ((0, 1), "25"), ((0, 2), "25"),
    ]  # fmt: skip


def test_axes_of_numbers_are_those_along_which_one_number_changes(swept):
    assert numeric_axes(Results(ABOUT, swept)) == ["sparsity"]


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("ppo_claims", "forest"),
        ("camera_rates", "lines"),
        ("encoder_seeds", "spread"),
        ("ppo_event_set", "dots"),
    ],
)
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
    assert set(figures(study)) == {"results_survival", "results_contacts"} & set(said["figures"])
