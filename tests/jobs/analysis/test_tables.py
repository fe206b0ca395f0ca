import numpy as np
import pytest

from jobs.analysis.plots import plot_reconstructions
from jobs.analysis.tables import short, summarise, summary_cells, summary_columns, summary_metrics
from tests.support.episodes import flights


def test_every_rate_and_mean_stands_beside_its_interval_the_same_for_the_same_episodes():
    row = summarise(("faults.sparsity", "0.2"), flights(10))
    assert row == summarise(("faults.sparsity", "0.2"), flights(10))
    value, (low, high) = row.distance_m
    assert low < value < high
    told = ("faults.sparsity", "0.2", "20", "50 [30, 70]", f"{value:.1f} [{low:.1f}, {high:.1f}]", "300", "0")
    assert summary_cells(row) == told
    assert summary_metrics(row)["eval/success_rate_low"] == row.success.interval[0]
    assert summary_metrics(row)["sim/events_per_step"] == 300.0


def test_what_an_agent_did_not_look_at_is_not_counted():
    flown = flights(3)
    flown["events_per_step"] = 0.0
    row = summarise(("straight",), flown)
    assert summary_cells(row)[-2:] == ("-", "-")
    assert np.isnan(summary_metrics(row)["sim/events_per_step"])


def test_short_numbers_have_two_digits_and_are_whole_from_10_on():
    texts = {0.0123: "0.012", 4.66: "4.7", 9.96: "10", 84.0: "84", 99.7: "100", 1250.4: "1,250"}
    assert {value: short(value) for value in texts} == texts


def test_the_first_column_of_a_tracked_table_is_unique():
    rows = [summarise(("faults.sparsity", value), flights(1, 4)) for value in ("0", "0.2")]
    first = next(iter(summary_columns(("Axis", "Value"), rows).values()))
    assert len(set(first)) == 2


def test_reconstructions_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r"pictures must be \(N, H, W\) as targets"):
        plot_reconstructions(np.zeros((2, 8, 8)), np.zeros((3, 8, 8)))
