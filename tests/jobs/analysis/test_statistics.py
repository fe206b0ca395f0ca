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


@pytest.mark.parametrize(
    ("trainings", "spread", "corridors"),
    [(1, 0.0, 1.0), (3, 0.5, 1.0), (8, 0.5, 1.0), (3, 3.0, 1.0), (3, 0.0, 3.0), (8, 0.5, 3.0), (3, 0.0, 0.0)],
)
def test_crossed_means_hold_the_truth_about_as_often_as_they_say(trainings, spread, corridors):
    rng = np.random.default_rng(2)
    found = [crossed_mean(values) for values in studies(300, trainings, 20, rng, (spread, corridors, 1.0))]
    held = np.mean([low <= 0.0 <= high for _, (low, high), *_ in found])
    assert 0.92 <= held <= 1.0
    assert all((p < 0.05) == (not low <= 0.0 <= high) for _, (low, high), p, *_ in found)


@pytest.mark.parametrize("spread", [0.0, 0.5, 3.0])
def test_crossed_differences_hold_the_truth_whatever_trainings_and_corridors_add(spread):
    rng, held = np.random.default_rng(7), []
    pairs = zip(*(studies(300, trainings, 20, rng, (spread, 0.0, 1.0)) for trainings in (4, 3)), strict=True)
    for ours, theirs in pairs:
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


def test_where_corridors_add_nothing_an_interval_is_hardly_wider_than_students_of_the_training_means():
    rng = np.random.default_rng(4)
    both = [
        (crossed_mean(values).interval, ttest_1samp(values.mean(axis=1), 0.0).confidence_interval(0.95))
        for values in studies(200, 5, 20, rng, (0.0, 0.0, 1.0))
    ]
    crossed, student = (np.mean([high - low for low, high in side]) for side in zip(*both, strict=True))
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
    found = crossed_difference(ours, theirs)
    assert found.value == pytest.approx(7.0)
    assert found.interval == pytest.approx((7.0, 7.0))
    assert found.p == pytest.approx(0.0)
    assert crossed_difference(theirs, ours).interval == pytest.approx((-7.0, -7.0))


def test_a_difference_in_the_same_corridors_is_narrower_than_in_others():
    rng = np.random.default_rng(6)
    corridors = rng.normal(0.0, 10.0, size=(1, 20))
    ours, theirs = (corridors + rng.normal(size=(3, 20)) for _ in range(2))
    same, others = (
        np.ptp(crossed_difference(ours, other).interval) for other in (theirs, rng.permuted(theirs, axis=1))
    )
    assert same < 0.5 * others


def test_rates_that_agree_leave_a_doubt_that_shrinks_with_the_episodes():
    widths = []
    for corridors in (5, 20, 80):
        ones = np.ones((3, corridors))
        found = crossed_difference(ones, ones, (0.0, 1.0))
        assert found.value == 0.0
        assert found.p == 1.0
        widths.append(np.ptp(found.interval))
        low, high = rate_estimate(ones).interval
        assert low < 1.0 == high
        assert low <= wilson_interval(3 * corridors, 3 * corridors)[0]
    assert widths[0] > 2 * widths[1] > 4 * widths[2] > 0


@pytest.mark.parametrize("rate", [0.0, 0.3, 1.0])
def test_intervals_of_rates_stay_between_none_and_all_and_mirror(rate):
    rng = np.random.default_rng(8)
    won = (rng.random((4, 15)) < rate).astype(float)
    (low, high), (low_lost, high_lost) = rate_estimate(won).interval, rate_estimate(1.0 - won).interval
    assert 0.0 <= low <= won.mean() <= high <= 1.0
    assert (low, high) == pytest.approx((1.0 - high_lost, 1.0 - low_lost))


@pytest.mark.parametrize(("spread", "least"), [(0.0, 0.95), (1.0, 0.92), (2.0, 0.85)])
def test_intervals_of_rates_hold_the_true_one_also_where_trainings_disagree(spread, least):
    share, *_ = coverage(3, 14, 1.5, spread)
    assert least <= share <= 1.0


@pytest.mark.parametrize(
    "values", [np.zeros((0, 3)), np.zeros(3), np.array([[np.nan]]), np.array([[np.inf]])]
)
def test_episodes_that_are_no_table_of_numbers_are_refused(values):
    for refuse in (rate_estimate, crossed_mean, lambda bad: crossed_difference(bad, np.zeros((1, 3)))):
        with pytest.raises(ValueError, match=r"must be finite numbers of shape \(trainings, corridors\)"):
            refuse(values)


def test_episodes_of_other_corridors_are_not_compared():
    with pytest.raises(ValueError, match="the same corridors, got 3 and 4"):
        crossed_difference(np.zeros((1, 3)), np.zeros((1, 4)))


def test_an_interval_ends_at_what_is_possible():
    lost = np.array([[-1.0] * 5, [0.0] * 5, [-1.0] * 5])
    assert crossed_mean(lost, (-1.0, 1.0)).interval[0] == -1.0
    assert crossed_mean(lost).interval[0] < -1.0
    ones = np.ones((2, 5))
    assert crossed_difference(ones, lost + 1.0, (0.0, 1.0)).interval[1] == 1.0


def test_distances_that_agree_at_the_goal_line_leave_a_doubt_that_shrinks_with_the_episodes():
    widths = []
    for trainings, corridors in ((3, 14), (10, 28), (40, 100)):
        goal = np.full((trainings, corridors), 100.0)
        found = crossed_difference(goal, goal, (0.0, 100.0))
        assert (found.value, found.p) == (0.0, 1.0)
        widths.append(np.ptp(found.interval))
    assert widths[0] > 10.0 > widths[1] > widths[2] > 0.0


@pytest.mark.parametrize(
    ("trainings", "corridors", "share"), [(3, 14, 0.03), (10, 28, 0.003), (10, 28, 0.01)]
)
def test_intervals_of_distances_hold_the_truth_also_where_few_episodes_fail(trainings, corridors, share):
    rng, held = np.random.default_rng(11), 0
    for _ in range(300):
        failed = rng.random((trainings, corridors)) < share
        ours = np.where(failed, rng.uniform(0.0, 100.0, failed.shape), 100.0)
        low, high = crossed_difference(ours, np.full(ours.shape, 100.0), (0.0, 100.0)).interval
        held += low <= -50.0 * share <= high
    assert held / 300 >= 0.95


def test_small_p_values_come_no_more_often_than_they_say_with_three_trainings_that_react_differently():
    """Two conditions that change each training at random, averaged over four levels: nothing in the mean."""
    rng, small = np.random.default_rng(5), 0
    for _ in range(3000):
        changed = rng.normal(0.0, 2.0, (2, 3, 1)) + rng.normal(0.0, 0.7, (1, 1, 14)) + rng.normal(size=(3, 1))
        won = rng.random((4, 2, 3, 14)) < 1 / (1 + np.exp(-changed))
        p = crossed_mean((won[:, 0].astype(float) - won[:, 1]).mean(axis=0), (-1.0, 1.0)).p
        small += p < 0.002
    assert small / 3000 < 0.003  # 0.006 where degrees of freedom have no limit


def test_one_loss_more_never_makes_a_verdict_jump():
    """Trainings that tie exactly are known no better than those that nearly do."""
    corridors = 14

    def p_of(losses):
        lost = np.zeros((len(losses), corridors))
        for row, count in enumerate(losses):
            lost[row, :count] = -1.0
        return crossed_mean(lost, (-1.0, 1.0)).p

    ties = [((4, 4, 4), (4, 4, 5)), ((6, 6, 6), (6, 6, 7)), ((5, 5, 5), (4, 5, 5)), ((8, 8, 8), (7, 8, 8))]
    for tie, near in ties:
        assert 0.3 < p_of(tie) / p_of(near) < 3.0, (tie, near)
    each = [p_of((count,) * 3) for count in range(3, 12)]
    assert each == sorted(each, reverse=True)


def test_pairs_are_tested_exactly():
    ours, theirs = (np.array([True] * 5 + [own] * 4 + [False] * 5) for own in (True, False))
    assert exact_pair_p(ours, theirs) == pytest.approx(2 * 0.5**4)
    assert exact_pair_p(theirs, ours) == pytest.approx(2 * 0.5**4)
    assert exact_pair_p(ours, ours) == 1.0


def test_holms_adjustment_has_its_known_values_and_keeps_the_order():
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []
    rng, wrong = np.random.default_rng(9), 0
    for _ in range(2000):
        wrong += min(holm(rng.random(10))) < 0.05
    assert 0.03 <= wrong / 2000 <= 0.065


@pytest.mark.parametrize(
    ("gain", "family", "apart"), [(4.0, 1, 0.0), (2.0, 1, 0.0), (2.0, 20, 0.0), (2.0, 1, 2.0)]
)
def test_as_many_trainings_as_are_needed_show_the_difference_in_four_of_five_studies(gain, family, apart):
    """Standard deviations of 2 and 1 between trainings, and of the difference of both between corridors."""
    rng, known, corridors = np.random.default_rng(10), np.array([[-1.0], [1.0]]) / 2**0.5, np.arange(14.0)
    hard = apart * (corridors - corridors.mean()) / corridors.std(ddof=1)  # exactly as it is said to be
    count = trainings_needed(2.0 * known + hard, known + 0.0 * hard, gain, family)

    def shown(trainings):
        found = []
        for _ in range(1000):
            ours, theirs = (spread * rng.normal(size=(trainings, 1)) for spread in (2.0, 1.0))
            added = rng.normal(0.0, apart, (1, 14))
            p = crossed_difference(ours + gain + added, theirs + 0.0 * added).p
            found.append(p < 0.05 / family)
        return np.mean(found)

    assert 0.76 <= shown(count) <= 0.9
    assert count < 4 or shown(count // 2) < 0.7


def test_no_number_of_trainings_is_named_where_none_is_enough():
    ours, theirs = np.array([[0.0], [2.0]]), np.array([[1.0], [3.0]])
    assert trainings_needed(ours[:1], theirs, 2.0) is None
    apart = 10.0 * np.linspace(-1.0, 1.0, 14)[None]  # corridors leave an error of 1.7
    assert trainings_needed(ours + apart, theirs + 0.0 * apart, 2.0) is None
    assert trainings_needed(ours + apart, theirs + 0.0 * apart, 20.0) is not None


def test_the_interval_over_trainings_holds_the_true_mean_as_often_as_it_says_and_needs_two():
    values = np.random.default_rng(0).normal(0.5, 0.1, (3, 4000))
    held = np.abs(values.mean(axis=0) - 0.5) <= half_width(values)
    assert 0.94 <= held.mean() <= 0.96
    with pytest.raises(ValueError, match="needs two of them, got 1"):
        half_width(values[:1])
