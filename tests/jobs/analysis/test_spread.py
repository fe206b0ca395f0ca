import numpy as np
import pytest

from jobs.analysis.statistics import (
    Spread,
    corridor_spread,
    crossed_difference,
    expected_half_width,
    spread_of,
)


def study(rng, spread, trainings, corridors):
    """Values (trainings, corridors) of one group, in corridors of which some are harder."""
    own = rng.normal(0.0, spread.trainings, (trainings, 1)) + rng.normal(0.0, 3.0, corridors)
    return own + rng.normal(0.0, spread.episodes, (trainings, corridors))


def test_the_spread_of_trainings_is_told_from_that_of_episodes_and_of_corridors():
    rng, truth = np.random.default_rng(0), Spread(2.0, 5.0)
    found = np.array([spread_of(study(rng, truth, 20, 30)) for _ in range(200)])
    np.testing.assert_allclose((found**2).mean(axis=0), np.square(truth), rtol=0.1)


def test_trainings_that_differ_by_chance_alone_have_no_spread_of_their_own():
    values = np.array([[1.0, 0.0], [0.0, 1.0]])
    assert spread_of(values) == (0.0, 1.0)
    assert expected_half_width(Spread(0.0, 0.0), Spread(0.0, 0.0), 0.0, 3, 14) == 0.0


@pytest.mark.parametrize("apart", [0.0, 4.0])
def test_the_interval_of_a_study_is_as_wide_as_was_expected(apart):
    """Of groups to which corridors do the same, and of groups to which they do not."""
    rng, ours, theirs = np.random.default_rng(1), Spread(2.0, 5.0), Spread(0.5, 3.0)
    widths = []
    for _ in range(300):
        hard = rng.normal(0.0, 3.0, 28)  # the same corridors for both
        first, second = (
            rng.normal(0.0, one.trainings, (10, 1)) + hard + rng.normal(0.0, one.episodes, (10, 28))
            for one in (ours, theirs)
        )
        low, high = crossed_difference(first + rng.normal(0.0, apart, 28), second).interval
        widths.append((high - low) / 2)
    assert np.mean(widths) == pytest.approx(expected_half_width(ours, theirs, apart, 10, 28), rel=0.1)


def test_what_corridors_do_to_two_groups_alike_is_no_spread_of_their_difference():
    rng, squares = np.random.default_rng(2), []
    for _ in range(200):
        first, second = (study(rng, Spread(1.0, 2.0), 10, 28) for _ in range(2))
        shared = rng.normal(0.0, 9.0, 28)
        squares.append(corridor_spread(first + shared, second + shared) ** 2)
    assert np.mean(squares) == pytest.approx(18.0, rel=0.15)  # twice the square of the 3.0 of `study`


def test_corridors_do_not_narrow_what_trainings_leave_open():
    one, other = Spread(2.0, 5.0), Spread(0.0, 5.0)
    widths = [expected_half_width(one, other, 0.0, 10, corridors) for corridors in (14, 28, 10**6)]
    assert widths == sorted(widths, reverse=True)
    assert widths[-1] > 2.0 / 10**0.5
    assert expected_half_width(one, other, 0.0, 40, 14) < widths[0] / 2


def test_one_training_has_no_interval():
    with pytest.raises(ValueError, match="needs two of them, got 1"):
        expected_half_width(Spread(1.0, 1.0), Spread(1.0, 1.0), 0.0, 1, 14)
