import numpy as np
import pytest

from jobs.analysis.plots import reconstruction_figure
from jobs.analysis.tables import columns, markdown, metrics, summarise
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
    assert markdown(["Agent"], [row]).splitlines()[-1].endswith("| - | - |")
    assert np.isnan(metrics(row)["sim/events_per_step"])
    assert metrics(summarise(("a",), episodes(3, 20)))["sim/events_per_step"] == 300.0


def test_the_same_episodes_give_the_same_summary():
    assert summarise(("a",), episodes(3, 20)) == summarise(("a",), episodes(3, 20))


def test_every_rate_and_mean_stands_beside_its_interval():
    row = summarise(("faults.sparsity", "0.2"), episodes(10, 20))
    text = markdown(("Axis", "Value"), [row])
    assert "| faults.sparsity | 0.2 | 20 | 50 [30, 70] |" in text
    low, high = row.distance_interval
    assert low < row.distance_m < high
    assert f"{row.distance_m:.1f} [{low:.1f}, {high:.1f}]" in text
    assert metrics(row)["eval/success_rate_low"] == row.success_interval[0]


def test_the_first_column_of_a_tracked_table_is_unique():
    rows = [summarise(("faults.sparsity", value), episodes(1, 4)) for value in ("0", "0.2")]
    first = next(iter(columns(("Axis", "Value"), rows).values()))
    assert len(set(first)) == 2


def test_reconstructions_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r"pictures must be \(N, H, W\) as targets"):
        reconstruction_figure(np.zeros((2, 8, 8)), np.zeros((3, 8, 8)))
