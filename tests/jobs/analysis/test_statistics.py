import numpy as np
import pytest
from scipy.stats import ttest_1samp, ttest_ind

from jobs.analysis.statistics import (
    bootstrap_interval,
    crossed_difference,
    crossed_mean,
    exact_pair_p,
    half_width,
    holm,
    rate_estimate,
    trainings_needed,
    wilson_interval,
)
from research.coverage import coverage

RATE, WAY_M = (0.0, 1.0), (0.0, 100.0)


def studies(rng, number, trainings, corridors, spread):
    """Simulated studies whose true mean is 0: effects of training, of corridor, and of the flight."""
    shapes = (trainings, 1), (1, corridors), (trainings, corridors)
    for _ in range(number):
        yield sum(rng.normal(0.0, one, shape) for one, shape in zip(spread, shapes, strict=True))


def test_wilson_intervals_have_their_known_values_and_impossible_counts_are_refused():
    assert wilson_interval(20, 20) == pytest.approx((0.8389, 1.0), abs=1e-4)
    assert wilson_interval(10, 20) == pytest.approx((0.2993, 0.7007), abs=1e-4)
    for successes, trials in ((0, 0), (3, 2), (-1, 2)):
        with pytest.raises(ValueError, match=f"got {successes} of {trials}"):
            wilson_interval(successes, trials)


def test_bootstrap_intervals_of_many_normal_values_are_students():
    rng = np.random.default_rng(0)
    for size in (100, 400):
        values = rng.normal(3.0, 2.0, size)
        low, high = ttest_1samp(values, 0.0).confidence_interval(0.95)
        assert bootstrap_interval(values, rng) == pytest.approx((low, high), abs=0.1 * (high - low))
    assert bootstrap_interval(np.array([5.0]), rng) is None


@pytest.mark.parametrize(
    ("trainings", "spread", "corridors"), [(1, 0.0, 1.0), (3, 3.0, 1.0), (8, 0.5, 3.0), (3, 0.0, 0.0)]
)
def test_crossed_means_hold_the_truth_about_as_often_as_they_say(trainings, spread, corridors):
    rng = np.random.default_rng(2)
    found = [crossed_mean(values) for values in studies(rng, 300, trainings, 20, (spread, corridors, 1.0))]
    held = [low <= 0.0 <= high for _, (low, high), *_ in found]
    assert 0.92 <= np.mean(held) <= 1.0
    assert held == [one.p >= 0.05 for one in found]


@pytest.mark.parametrize("spread", [0.0, 3.0])
def test_crossed_differences_hold_the_truth_whatever_trainings_and_corridors_add(spread):
    rng, held = np.random.default_rng(7), []
    pairs = [studies(rng, 300, trainings, 20, (spread, 0.0, 1.0)) for trainings in (4, 3)]
    for ours, theirs in zip(*pairs, strict=True):
        shared = rng.normal(0.0, 5.0, size=(1, 20))
        low, high = crossed_difference(ours + shared + 1.0, theirs + shared).interval
        held.append(low <= 1.0 <= high)
    assert 0.92 <= np.mean(held) <= 1.0


def test_without_corridors_a_crossed_mean_is_students_and_a_difference_is_welchs():
    rng = np.random.default_rng(3)
    ours, theirs = rng.normal(size=(6, 1)), rng.normal(2.0, 3.0, size=(4, 1))
    mean, difference = crossed_mean(ours), crossed_difference(ours, theirs)
    student, welch = ttest_1samp(ours[:, 0], 0.0), ttest_ind(ours[:, 0], theirs[:, 0], equal_var=False)
    for found, known in ((mean, student), (difference, welch)):
        assert found.p == pytest.approx(known.pvalue)
        assert found.interval == pytest.approx(known.confidence_interval(0.95))
    low, high = mean.interval
    assert half_width(ours)[0] == pytest.approx((high - low) / 2)
    with pytest.raises(ValueError, match="needs two of them, got 1"):
        half_width(ours[:1])


def test_where_corridors_add_nothing_an_interval_is_hardly_wider_than_students_of_the_training_means():
    widths = []
    for values in studies(np.random.default_rng(4), 100, 5, 20, (0.0, 0.0, 1.0)):
        student = ttest_1samp(values.mean(axis=1), 0.0).confidence_interval(0.95)
        widths.append((np.ptp(crossed_mean(values).interval), np.ptp(student)))
    crossed, student = np.mean(widths, axis=0)
    assert 0.8 * student <= crossed <= 1.15 * student


def test_a_rate_near_all_may_be_farther_from_it_than_the_scatter_of_its_trainings_says():
    won = np.ones((3, 100))
    won[0, :3] = 0.0
    low, student = rate_estimate(won).interval[0], crossed_mean(won)
    assert low < min(student.interval[0], wilson_interval(297, 300)[0])


def test_a_single_episode_has_no_interval():
    one = np.array([[3.0]])
    assert crossed_mean(one)[:3] == (3.0, None, None)
    assert crossed_difference(one, one - 1.0)[:3] == (1.0, None, None)
    assert rate_estimate(np.array([[1.0]])).interval == wilson_interval(1, 1)


def test_a_difference_that_is_the_same_in_every_corridor_is_exact_however_corridors_differ():
    corridors = np.random.default_rng(5).normal(50.0, 30.0, size=(1, 20))
    ours, theirs = np.repeat(corridors + 7.0, 3, axis=0), np.repeat(corridors, 2, axis=0)
    for gain, found in ((7.0, crossed_difference(ours, theirs)), (-7.0, crossed_difference(theirs, ours))):
        assert (found.value, *found.interval) == pytest.approx((gain, gain, gain))
        assert found.p == pytest.approx(0.0)


@pytest.mark.parametrize("bounds", [RATE, WAY_M])
def test_trainings_that_all_succeed_leave_a_doubt_that_shrinks_with_the_episodes(bounds):
    widths = []
    for trainings, corridors in ((3, 14), (10, 28), (40, 100)):
        goal = np.full((trainings, corridors), bounds[1])
        found = crossed_difference(goal, goal, bounds)
        assert (found.value, found.p) == (0.0, 1.0)
        widths.append(np.ptp(found.interval) / bounds[1])
        low, high = rate_estimate(goal / bounds[1]).interval
        assert low <= wilson_interval(goal.size, goal.size)[0] < high == 1.0
    assert widths[0] > 0.1 > widths[1] > widths[2] > 0.0


@pytest.mark.parametrize("rate", [0.0, 0.3])
def test_intervals_of_rates_stay_between_none_and_all_and_mirror(rate):
    won = (np.random.default_rng(8).random((4, 15)) < rate).astype(float)
    (low, high), (low_lost, high_lost) = rate_estimate(won).interval, rate_estimate(1.0 - won).interval
    assert 0.0 <= low <= won.mean() <= high <= 1.0
    assert (low, high) == pytest.approx((1.0 - high_lost, 1.0 - low_lost))


@pytest.mark.parametrize(("spread", "least"), [(0.0, 0.95), (2.0, 0.85)])
def test_intervals_of_rates_hold_the_true_one_also_where_trainings_disagree(spread, least):
    share, *_ = coverage(3, 14, 1.5, spread)
    assert least <= share <= 1.0


@pytest.mark.parametrize("values", [np.zeros((0, 3)), np.zeros(3), np.array([[np.nan]])])
def test_episodes_that_are_no_table_of_numbers_or_of_other_corridors_are_refused(values):
    for refuse in (rate_estimate, crossed_mean, lambda bad: crossed_difference(bad, np.zeros((1, 3)))):
        with pytest.raises(ValueError, match=r"must be finite numbers of shape \(trainings, corridors\)"):
            refuse(values)
    with pytest.raises(ValueError, match="values must be a list of finite numbers"):
        bootstrap_interval(np.array([1.0, np.nan]), np.random.default_rng(0))
    with pytest.raises(ValueError, match="the same corridors, got 3 and 4"):
        crossed_difference(np.zeros((1, 3)), np.zeros((1, 4)))


def test_an_interval_ends_at_what_is_possible():
    lost = np.array([[-1.0] * 5, [0.0] * 5, [-1.0] * 5])
    assert crossed_mean(lost).interval[0] < crossed_mean(lost, (-1.0, 1.0)).interval[0] == -1.0
    assert crossed_difference(np.ones((2, 5)), lost + 1.0, RATE).interval[1] == 1.0


@pytest.mark.parametrize(("trainings", "corridors", "share"), [(3, 14, 0.03), (10, 28, 0.003)])
def test_intervals_of_distances_hold_the_truth_also_where_few_episodes_fail(trainings, corridors, share):
    rng, held = np.random.default_rng(11), 0
    for _ in range(300):
        failed = rng.random((trainings, corridors)) < share
        ours = np.where(failed, rng.uniform(0.0, 100.0, failed.shape), 100.0)
        low, high = crossed_difference(ours, np.full(ours.shape, 100.0), WAY_M).interval
        held += low <= -50.0 * share <= high
    assert held / 300 >= 0.95


def test_small_p_values_come_no_more_often_than_they_say_with_three_trainings_that_react_differently():
    """Two conditions that change each training at random, averaged over four levels: nothing in the mean."""
    rng, small = np.random.default_rng(5), 0
    for _ in range(3000):
        changed = rng.normal(0.0, 2.0, (2, 3, 1)) + rng.normal(0.0, 0.7, (1, 1, 14)) + rng.normal(size=(3, 1))
        won = rng.random((4, 2, 3, 14)) < 1 / (1 + np.exp(-changed))
        small += crossed_mean((won[:, 0].astype(float) - won[:, 1]).mean(axis=0), (-1.0, 1.0)).p < 0.002
    assert small / 3000 < 0.003  # 0.006 where degrees of freedom have no limit


def test_one_loss_more_never_makes_a_verdict_jump():
    """Trainings that tie exactly are known no better than those that nearly do."""

    def p_of(losses):
        lost = -1.0 * (np.arange(14) < np.array(losses)[:, None])
        return crossed_mean(lost, (-1.0, 1.0)).p

    ties = [((4, 4, 4), (4, 4, 5)), ((6, 6, 6), (6, 6, 7)), ((5, 5, 5), (4, 5, 5)), ((8, 8, 8), (7, 8, 8))]
    for tie, near in ties:
        assert 0.3 < p_of(tie) / p_of(near) < 3.0, (tie, near)
    each = [p_of((count,) * 3) for count in range(3, 12)]
    assert each == sorted(each, reverse=True)


def test_pairs_are_tested_exactly():
    ours, theirs = (np.array([True] * 5 + [own] * 4 + [False] * 5) for own in (True, False))
    assert exact_pair_p(ours, theirs) == exact_pair_p(theirs, ours) == pytest.approx(2 * 0.5**4)
    assert exact_pair_p(ours, ours) == 1.0


def test_holms_adjustment_has_its_known_values_and_errs_in_one_family_of_twenty():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []
    rng = np.random.default_rng(9)
    wrong = [min(holm(rng.random(10))) < 0.05 for _ in range(1000)]
    assert 0.03 <= np.mean(wrong) <= 0.07


@pytest.mark.parametrize(("family", "apart"), [(1, 0.0), (20, 0.0), (1, 2.0)])
def test_as_many_trainings_as_are_needed_show_the_difference_in_four_of_five_studies(family, apart):
    """Standard deviations of 2 and 1 between trainings, and of the difference of both between corridors."""
    rng, known, corridors = np.random.default_rng(10), np.array([[-1.0], [1.0]]) / 2**0.5, np.arange(14.0)
    hard = apart * (corridors - corridors.mean()) / corridors.std(ddof=1)  # exactly as it is said to be
    count = trainings_needed(2.0 * known + hard, known + 0.0 * hard, 2.0, family)

    def shown(trainings):
        found = 0
        for _ in range(300):
            ours, theirs = (spread * rng.normal(size=(trainings, 1)) for spread in (2.0, 1.0))
            added = rng.normal(0.0, apart, (1, 14))
            found += crossed_difference(ours + 2.0 + added, theirs + 0.0 * added).p < 0.05 / family
        return found / 300

    assert 0.73 <= shown(count) <= 0.92
    assert shown(count // 2) < 0.7


def test_no_number_of_trainings_is_named_where_none_is_enough():
    ours, theirs = np.array([[0.0], [2.0]]), np.array([[1.0], [3.0]])
    assert trainings_needed(ours[:1], theirs, 2.0) is None
    apart = 10.0 * np.linspace(-1.0, 1.0, 14)[None]  # corridors leave an error of 1.7
    assert trainings_needed(ours + apart, theirs + 0.0 * apart, 2.0) is None
    assert trainings_needed(ours + apart, theirs + 0.0 * apart, 20.0) is not None
