import numpy as np
import pytest
from scipy.stats import f

from jobs.analysis.statistics import (
    Spread,
    corridor_spread,
    crossed_difference,
    crossed_spread,
    expected_half_width,
    spread_of,
)


def table(rng, rows=9.0, columns=5.0, rest=2.0, shape=(5, 4)):
    """Values of effects of rows, of columns and of neither, with these standard deviations."""
    effects = rng.normal(0.0, rows, (shape[0], 1)) + rng.normal(0.0, columns, shape[1])
    return 50.0 + effects + rng.normal(0.0, rest, shape)


def test_effects_of_rows_and_columns_are_those_of_nested_linear_models():
    """The rest with and without effects of rows, by least squares; exchanged, the same of columns."""
    values = table(np.random.default_rng(2), 3.0)
    rows, columns = np.indices(values.shape)
    effects = [np.eye(5)[rows.ravel()], np.eye(4)[columns.ravel()]]
    rests = []
    for design in (np.hstack(effects), effects[1]):
        solution = np.linalg.lstsq(design, values.ravel(), rcond=None)[0]
        rests.append(((values.ravel() - design @ solution) ** 2).sum())
    found, explained = crossed_spread(values), (rests[1] - rests[0]) / 4
    assert found.rest == pytest.approx(np.sqrt(rests[0] / 12))
    assert found.rows**2 * 4 + found.rest**2 == pytest.approx(explained)
    assert found.rows_p == pytest.approx(f.sf(explained / (rests[0] / 12), 4, 12))
    turned = (found.columns, found.rows, pytest.approx(found.rest), found.columns_p, found.rows_p)
    assert crossed_spread(values.T) == turned


def test_equal_values_have_no_spread_and_no_test():
    assert crossed_spread(np.ones((3, 2))) == (0.0, 0.0, 0.0, None, None)


def test_a_table_of_one_row_or_without_a_number_is_refused():
    with pytest.raises(ValueError, match="two rows and two columns, got shape"):
        crossed_spread(np.ones((1, 4)))
    with pytest.raises(ValueError, match="finite"):
        crossed_spread(np.array([[1.0, np.nan], [0.0, 1.0]]))


def test_the_spread_of_trainings_is_that_of_rows_whatever_corridors_do():
    values = table(np.random.default_rng(0), shape=(20, 30))
    crossed = crossed_spread(values)
    assert spread_of(values) == pytest.approx((crossed.rows, crossed.rest))
    assert spread_of(np.array([[1.0, 0.0], [0.0, 1.0]])) == (0.0, 1.0)  # trainings differ by chance alone


@pytest.mark.parametrize("apart", [0.0, 4.0])
def test_the_interval_of_a_study_is_as_wide_as_was_expected(apart):
    """Of groups to which corridors do the same, and of groups to which they do not."""
    rng, ours, theirs = np.random.default_rng(1), Spread(2.0, 5.0), Spread(0.5, 3.0)
    widths = []
    for _ in range(100):
        hard = rng.normal(0.0, 3.0, 28)  # the same corridors for both
        first, second = (table(rng, one.trainings, 0.0, one.episodes, (10, 28)) for one in (ours, theirs))
        found = crossed_difference(first + hard + rng.normal(0.0, apart, 28), second + hard)
        widths.append(np.ptp(found.interval) / 2)
    assert np.mean(widths) == pytest.approx(expected_half_width(ours, theirs, apart, 10, 28), rel=0.1)


def test_what_corridors_do_to_two_groups_alike_is_no_spread_of_their_difference():
    rng, squares = np.random.default_rng(2), []
    for _ in range(200):
        first, second = (table(rng, 1.0, 3.0, 2.0, (10, 28)) for _ in range(2))
        shared = rng.normal(0.0, 9.0, 28)
        squares.append(corridor_spread(first + shared, second + shared) ** 2)
    assert np.mean(squares) == pytest.approx(2 * 3.0**2, rel=0.15)


def test_corridors_do_not_narrow_what_trainings_leave_open_and_one_training_leaves_all():
    one, other = Spread(2.0, 5.0), Spread(0.0, 5.0)
    widths = [expected_half_width(one, other, 0.0, 10, corridors) for corridors in (14, 28, 10**6)]
    assert widths == sorted(widths, reverse=True)
    assert widths[-1] > 2.0 / 10**0.5
    assert expected_half_width(one, other, 0.0, 40, 14) < widths[0] / 2
    assert expected_half_width(Spread(0.0, 0.0), Spread(0.0, 0.0), 0.0, 3, 14) == 0.0
    with pytest.raises(ValueError, match="needs two of them, got 1"):
        expected_half_width(one, other, 0.0, 1, 14)
