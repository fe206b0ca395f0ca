import numpy as np
import pytest

from jobs.figures import axis_figure, reconstruction_figure
from jobs.flights import EPISODE
from jobs.report import bootstrap_interval, columns, markdown, metrics, summarise, wilson_interval


def episodes(successes: int, trials: int) -> np.ndarray:
    flown = np.zeros(trials, EPISODE)
    flown["seed"] = np.arange(trials)
    flown["success"][:successes] = True
    flown["distance_m"] = np.where(flown["success"], 100.0, 40.0 + flown["seed"])
    flown["events_per_step"] = 300.0
    return flown


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [(20, 20, 0.8389, 1.0), (0, 20, 0.0, 0.1611), (10, 20, 0.2993, 0.7007), (1, 1, 0.2065, 1.0)],
)
def test_wilson_intervals_have_their_known_values(successes, trials, low, high):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=1e-4)


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (3, 2), (-1, 2)])
def test_an_impossible_count_of_successes_is_refused(successes, trials):
    with pytest.raises(ValueError, match=f"got {successes} of {trials}"):
        wilson_interval(successes, trials)


def test_bootstrap_intervals_hold_the_true_mean_about_as_often_as_they_say():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(100):
        low, high = bootstrap_interval(rng.normal(3.0, 2.0, 30), rng)
        hits += low <= 3.0 <= high
    assert 0.88 <= hits / 100 <= 0.99


def test_bootstrap_intervals_narrow_as_the_root_of_the_trials():
    rng = np.random.default_rng(1)
    narrow, wide = (np.ptp(bootstrap_interval(rng.normal(size=n), rng)) for n in (400, 25))
    assert wide / narrow == pytest.approx(4.0, rel=0.35)


def test_a_single_trial_has_no_bootstrap_interval():
    assert bootstrap_interval(np.array([5.0]), np.random.default_rng(0)) is None


@pytest.mark.parametrize("values", [[1.0, np.nan], [np.inf, 1.0], []])
def test_values_that_are_no_numbers_are_refused(values):
    with pytest.raises(ValueError, match="values must be a list of finite numbers"):
        bootstrap_interval(np.array(values), np.random.default_rng(0))


def test_what_a_pilot_did_not_look_at_is_not_counted():
    flown = episodes(3, 20)
    flown["events_per_step"] = 0.0
    row = summarise(("straight",), flown)
    assert markdown(["Pilot"], [row]).splitlines()[-1].endswith("| - | - |")
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


def test_an_axis_figure_shows_each_value_the_bounds_and_where_the_policy_was_trained():
    rows = [summarise(("env.control_hz", f"{hz}"), episodes(hz // 20, 20)) for hz in (45, 200, 400)]
    bounds = {"oracle": summarise(("oracle", "-"), episodes(20, 20))}
    figure = axis_figure("env.control_hz", [45, 200, 400], rows, bounds, 200)
    panel = figure.axes[0]
    assert [label.get_text() for label in panel.get_xticklabels()] == ["45", "200", "400"]
    assert panel.get_xscale() == "log"
    assert panel.get_xlabel() == "Control rate [Hz]"
    assert {"policy", "oracle", "trained here"} <= set(panel.get_legend_handles_labels()[1])


def test_reconstructions_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r"pictures must be \(N, H, W\) as targets"):
        reconstruction_figure(np.zeros((2, 8, 8)), np.zeros((3, 8, 8)))
