import numpy as np
import pytest

from jobs.analysis.plots import plot_reconstructions
from jobs.analysis.tables import short, summarise, summary_cells, summary_columns, summary_metrics
from jobs.rollout.episodes import EPISODE


def episodes(successes: int, trials: int) -> np.ndarray:
    flown = np.zeros(trials, EPISODE)
    flown["seed"] = np.arange(trials)
    flown["success"][:successes] = True
    flown["distance_m"] = np.where(flown["success"], 100.0, 40.0 + flown["seed"])
    flown["events_per_step"] = 300.0
    return flown


def test_what_a_agent_did_not_look_at_is_not_counted():
    flown = episodes(3, 20)
    flown["events_per_step"] = 0.0
    row = summarise(("straight",), flown)
    assert summary_cells(row)[-2:] == ("-", "-")
    assert np.isnan(summary_metrics(row)["sim/events_per_step"])
    assert summary_metrics(summarise(("a",), episodes(3, 20)))["sim/events_per_step"] == 300.0


def test_the_same_episodes_give_the_same_summary():
    assert summarise(("a",), episodes(3, 20)) == summarise(("a",), episodes(3, 20))


def test_every_rate_and_mean_stands_beside_its_interval():
    row = summarise(("faults.sparsity", "0.2"), episodes(10, 20))
    cells = summary_cells(row)
    assert cells[:4] == ("faults.sparsity", "0.2", "20", "50 [30, 70]")
    value, (low, high) = row.distance_m
    assert low < value < high
    assert cells[4] == f"{value:.1f} [{low:.1f}, {high:.1f}]"
    assert summary_metrics(row)["eval/success_rate_low"] == row.success.interval[0]


def test_short_numbers_have_two_digits_and_are_whole_from_10_on():
    texts = {0.0123: "0.012", 4.66: "4.7", 9.96: "10", 84.0: "84", 99.7: "100", 1250.4: "1,250"}
    assert {value: short(value) for value in texts} == texts


def test_the_first_column_of_a_tracked_table_is_unique():
    rows = [summarise(("faults.sparsity", value), episodes(1, 4)) for value in ("0", "0.2")]
    first = next(iter(summary_columns(("Axis", "Value"), rows).values()))
    assert len(set(first)) == 2


def test_reconstructions_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r"pictures must be \(N, H, W\) as targets"):
        plot_reconstructions(np.zeros((2, 8, 8)), np.zeros((3, 8, 8)))
