import csv
import dataclasses

import numpy as np
import pytest

from jobs.analysis.tables import markdown_table
from jobs.run.provenance import REPOSITORY
from jobs.study.computed import published
from jobs.study.page import part
from jobs.study.results import Results
from jobs.study.summaries import axis_curves, columns_of, details_table, metrics_of, success_lines, summarise
from jobs.tracking.store import check_metrics
from tests.support.episodes import flights

AT = ("sparsity", 0.2)
DATA = REPOSITORY / "docs" / "data"


def test_a_group_pools_its_trainings():
    row = summarise(AT, "a", {0: flights(10), 1: flights(14)})
    assert (row.trainings, row.episodes, row.success.value) == ((0, 1), 40, 0.6)
    low, high = row.success.interval
    assert low < 0.446 < 0.737 < high  # wider than Wilson's of 40 episodes
    distances = [flights(won)["distance_m"] for won in (10, 14)]
    assert row.distance_m.value == pytest.approx(np.mean(distances))


def test_a_difference_is_taken_corridor_by_corridor():
    ours = {seed: flights(10, offset_m=3.0) for seed in (0, 1)}
    row = summarise(AT, "a", ours, {5: flights(10), 6: flights(10)})
    for found, value in ((row.success_difference, 0.0), (row.distance_difference_m, 3.0)):
        assert found.value == pytest.approx(value)
        low, high = found.interval
        assert low < value < high  # of trainings that agree, too, there are few
    worse = summarise(AT, "a", {0: flights(4)}, {0: flights(16)}).success_difference
    assert worse.value == pytest.approx(-0.6)
    assert worse.interval[1] < 0


def test_the_table_has_a_column_for_each_group_and_says_what_failed():
    rows = [summarise(AT, "a", {0: flights(10)})]
    results = Results({"groups": {"a": [0], "b": [0]}}, {})
    head, lines = success_lines(rows, results, [AT, ("sparsity", 0.5)], {(AT, "b"): "failed"})
    assert markdown_table(head, lines, 2).splitlines() == [
        "| Axis | Value | a | b |",
        "| --- | --- | ---: | ---: |",
        "| sparsity | 0.2 | 50 [30, 70] | failed |",
        "| sparsity | 0.5 | - | - |",
    ]


def test_a_row_stands_in_the_details_and_the_tracker_with_its_intervals_and_its_place_on_the_axis():
    row = summarise(AT, "a", {0: flights(10)}, {0: flights(10, offset_m=1.0)})
    text, figures = details_table([row], "b"), check_metrics(metrics_of(row))
    low, high = row.distance_m.interval
    assert f"| {row.distance_m.value:.1f} [{low:.1f}, {high:.1f}] |" in text
    low, high = row.distance_difference_m.interval
    assert f"| -1.0 [{low:.1f}, {high:+.1f}] | 300 | 0 |" in text
    assert (figures["sweep/value"], figures["sweep/success_difference"]) == (0.2, 0.0)
    assert figures["eval/success_rate_low"] == row.success.interval[0]
    word = dataclasses.replace(row, condition=("world", "poles"), success_difference=None)
    assert not {"sweep/value", "sweep/success_difference"} & set(metrics_of(word))
    single = summarise(AT, "a", {0: flights(1, trials=1)})
    assert "eval/distance_m_low" not in metrics_of(single)


def test_the_first_column_of_a_tracked_table_is_unique():
    first, *others = columns_of([summarise(AT, group, {0: flights(10)}) for group in ("a", "b")]).values()
    assert len(set(first)) == 2
    assert {len(values) for values in others} == {2}


@pytest.mark.parametrize(
    ("numbers", "steps", "unit"),
    [
        ([25.0, 800.0], [25, 800], ""),
        ([0.05, 0.4], [5, 40], "_percent"),
        ([0.0, 0.125], [0, 125], "_permille"),
    ],
)
def test_a_curve_has_the_axis_as_whole_steps_and_says_their_unit(numbers, steps, unit):
    low, high = numbers
    rows = [summarise(("a", at), "g", {0: flights(won)}) for at, won in ((low, 5), (high, 20))]
    curves = axis_curves("a", numbers, rows)
    assert set(curves) == {f"sweep/a{unit}_success", f"sweep/a{unit}_distance_m"}
    assert curves[f"sweep/a{unit}_success"] == dict(zip(steps, [0.25, 1.0], strict=True))
    assert axis_curves("a", [1e-5], []) == {}  # too fine for whole steps


def test_an_axis_is_as_good_as_the_mean_of_its_conditions():
    """Against the published table of trainings, which another function wrote."""
    text = part(published(DATA, "encoder_seeds", "encoder_seeds"), "axes")
    head, _, *lines = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("|")]
    rates = {}
    with (DATA / "encoder_seeds_trainings.csv").open() as file:
        for row in csv.DictReader(file):
            rates.setdefault((row["Axis"], row["Group"]), []).append(float(row["success_rate"]))
    assert lines
    for axis, *cells in lines:
        for group, cell in zip(head[1:], cells, strict=True):
            assert abs(float(cell.split()[0]) - 100 * np.mean(rates[axis, group])) < 0.51
