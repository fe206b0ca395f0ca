import numpy as np
import pytest
from scipy.stats import ttest_ind

from jobs.analysis.statistics import (
    bootstrap_interval,
    half_width,
    interquartile_mean,
    mean_difference,
    paired_difference,
    paired_rate_difference,
    two_stage_estimate,
    wilson_interval,
)


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


def studies(number, trainings, corridors, rng, spread=(1.0, 1.0, 1.0)):
    """Simulated studies whose true mean is 0: effects of training, of corridor, and of the flight."""
    for _ in range(number):
        of_training, of_corridor, noise = (
            rng.normal(0.0, sigma, size)
            for sigma, size in zip(
                spread, ((trainings, 1), (1, corridors), (trainings, corridors)), strict=True
            )
        )
        yield of_training + of_corridor + noise


@pytest.mark.parametrize(("trainings", "least"), [(1, 0.88), (3, 0.75), (8, 0.88)])
def test_two_stage_intervals_hold_the_true_mean_about_as_often_as_they_say(trainings, least):
    rng = np.random.default_rng(2)
    spread = (0.0 if trainings == 1 else 0.5, 1.0, 1.0)  # one training says nothing of others
    hits = 0
    for values in studies(120, trainings, 20, rng, spread):
        low, high = two_stage_estimate(values, rng).interval
        hits += low <= 0.0 <= high
    assert least <= hits / 120 <= 1.0


def test_trainings_that_differ_widen_the_interval_as_their_own_scatter_says():
    rng = np.random.default_rng(3)
    values = np.repeat(rng.normal(size=(6, 1)), 20, axis=1)
    low, high = two_stage_estimate(values, rng).interval
    expected = 2 * 1.96 * values[:, 0].std(ddof=1) / np.sqrt(6)
    assert high - low == pytest.approx(expected, rel=0.2)


def test_one_training_is_resampled_over_its_corridors_as_a_plain_bootstrap_does():
    rng = np.random.default_rng(4)
    values = rng.normal(size=60)
    one = two_stage_estimate(values[None], rng)
    assert one.value == pytest.approx(values.mean())
    assert one.interval == pytest.approx(bootstrap_interval(values, rng), abs=0.04)


def test_a_single_flight_has_no_interval():
    one = np.array([[3.0]])
    assert two_stage_estimate(one, np.random.default_rng(0)) == (3.0, None)
    assert paired_difference(one, one - 1.0, np.random.default_rng(0)) == (1.0, None)


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 7, 8, 20, 101])
def test_the_interquartile_mean_is_the_mean_of_the_sorted_middle_half(size):
    values = np.random.default_rng(size).normal(size=(3, size))
    for row, found in zip(values, interquartile_mean(values), strict=True):
        cut = size // 4
        middle = sorted(row.tolist())[cut : size - cut]
        assert found == pytest.approx(sum(middle) / len(middle))


def test_the_interquartile_mean_does_not_heed_a_few_flights_far_off():
    values = np.full((2, 20), 50.0)
    values[:, :2] = 0.0
    assert two_stage_estimate(values, np.random.default_rng(0), interquartile_mean).value == 50.0


def test_a_difference_that_is_the_same_in_every_corridor_is_exact_however_corridors_differ():
    corridors = np.random.default_rng(5).normal(50.0, 30.0, size=(1, 20))
    ours, theirs = np.repeat(corridors + 7.0, 3, axis=0), np.repeat(corridors, 2, axis=0)
    found = paired_difference(ours, theirs, np.random.default_rng(0))
    assert found.value == pytest.approx(7.0)
    assert found.interval == pytest.approx((7.0, 7.0))
    back = paired_difference(theirs, ours, np.random.default_rng(0))
    assert back.interval == pytest.approx((-7.0, -7.0))


def test_a_paired_difference_is_narrower_than_one_of_other_corridors():
    rng = np.random.default_rng(6)
    corridors = rng.normal(0.0, 10.0, size=(1, 20))
    ours, theirs = (corridors + rng.normal(size=(3, 20)) for _ in range(2))
    paired, apart = (
        np.ptp(paired_difference(ours, other, rng).interval)
        for other in (theirs, rng.permuted(theirs, axis=1))
    )
    assert paired < 0.5 * apart


def test_paired_intervals_hold_the_true_difference_about_as_often_as_they_say():
    rng, hits = np.random.default_rng(7), 0
    for ours, theirs in zip(*(studies(100, 8, 20, rng, (0.5, 0.0, 1.0)) for _ in range(2)), strict=True):
        shared = rng.normal(0.0, 5.0, size=(1, 20))
        low, high = paired_difference(ours + shared + 1.0, theirs + shared, rng).interval
        hits += low <= 1.0 <= high
    assert hits >= 88


def test_the_same_generator_gives_the_same_interval():
    values = np.random.default_rng(8).normal(size=(3, 20))
    first, again = (two_stage_estimate(values, np.random.default_rng(0)) for _ in range(2))
    assert first == again


@pytest.mark.parametrize(
    "values", [np.zeros((0, 3)), np.zeros(3), np.array([[np.nan]]), np.array([[np.inf]])]
)
def test_flights_that_are_no_table_of_numbers_are_refused(values):
    for refuse in (two_stage_estimate, lambda bad, rng: paired_difference(bad, np.zeros((1, 3)), rng)):
        with pytest.raises(ValueError, match=r"must be finite numbers of shape \(trainings, corridors\)"):
            refuse(values, np.random.default_rng(0))


def test_flights_of_other_corridors_are_not_compared():
    with pytest.raises(ValueError, match="the same corridors, got 3 and 4"):
        paired_difference(np.zeros((1, 3)), np.zeros((1, 4)), np.random.default_rng(0))


def paired_flights(both, ours, theirs, neither):
    """Successes of two sides by how often both, one of them, or none came through."""
    first = [True] * (both + ours) + [False] * (theirs + neither)
    second = [True] * both + [False] * ours + [True] * theirs + [False] * neither
    return np.array(first), np.array(second)


def test_a_paired_rate_difference_turns_round_with_its_sides():
    ours, theirs = paired_flights(60, 14, 5, 21)
    there, back = paired_rate_difference(ours, theirs), paired_rate_difference(theirs, ours)
    assert there.value == pytest.approx(0.09) == -back.value
    assert there.interval == pytest.approx((-back.interval[1], -back.interval[0]))


def test_without_correlation_a_paired_rate_difference_is_newcombes_of_two_samples():
    ours, theirs = paired_flights(25, 25, 25, 25)
    low, high = wilson_interval(50, 100)
    half = np.hypot(0.5 - low, high - 0.5)
    assert paired_rate_difference(ours, theirs).interval == pytest.approx((-half, half))


def test_flights_that_all_agree_leave_a_doubt_that_shrinks_with_their_number():
    widths = []
    for count in (4, 20, 100):
        same = np.arange(count) % 10 > 0
        found = paired_rate_difference(same, same)
        assert found.value == 0.0
        assert found.interval[0] < 0.0 < found.interval[1]
        widths.append(np.ptp(found.interval))
    assert widths[0] > 2 * widths[1] > 4 * widths[2]


def test_paired_rate_differences_hold_the_true_one_about_as_often_as_they_say():
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(400):
        hard = rng.random(60)
        ours, theirs = (rng.random(60) < 0.95 - loss - 0.3 * hard for loss in (0.0, 0.1))
        low, high = paired_rate_difference(ours, theirs).interval
        hits += low <= 0.1 <= high
    assert 0.92 <= hits / 400 <= 0.985


@pytest.mark.parametrize(("ours", "theirs"), [([], []), ([True], [True, False]), ([[True]], [[True]])])
def test_pairs_that_are_none_are_refused(ours, theirs):
    with pytest.raises(ValueError, match="same corridors"):
        paired_rate_difference(np.array(ours, bool), np.array(theirs, bool))


def test_the_difference_of_trainings_that_share_nothing_holds_the_truth_as_often_as_it_says():
    rng, held, repeats = np.random.default_rng(0), 0, 600
    for _ in range(repeats):
        ours, theirs = rng.normal(0.7, 0.05, 3), rng.normal(0.6, 0.02, 3)
        low, high = mean_difference(ours, theirs).interval
        held += low <= 0.1 <= high
    assert 0.93 <= held / repeats <= 0.985


def test_the_difference_of_trainings_changes_its_sign_with_the_sides_and_needs_two_of_each():
    ours, theirs = [0.7, 0.8, 0.75], [0.5, 0.65]
    there, back = mean_difference(ours, theirs), mean_difference(theirs, ours)
    assert there.value == pytest.approx(-back.value)
    assert there.interval == pytest.approx((-back.interval[1], -back.interval[0]))
    known = ttest_ind(ours, theirs, equal_var=False).confidence_interval(0.95)
    assert there.interval == pytest.approx((known.low, known.high))
    assert mean_difference([0.7, 0.7, 0.7], [0.5, 0.6, 0.7]).interval[0] > -0.2  # equal on one side
    assert mean_difference([0.7], theirs).interval is None
    assert mean_difference([0.7, 0.7], [0.5, 0.5]) == (pytest.approx(0.2), None)


def test_the_interval_over_trainings_holds_the_true_mean_as_often_as_it_says_and_needs_two():
    values = np.random.default_rng(0).normal(0.5, 0.1, (3, 4000))
    held = np.abs(values.mean(axis=0) - 0.5) <= half_width(values)
    assert 0.94 <= held.mean() <= 0.96
    with pytest.raises(ValueError, match="needs two of them, got 1"):
        half_width(values[:1])
