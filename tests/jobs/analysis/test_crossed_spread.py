import numpy as np
import pytest
from scipy.stats import f, kstest

from jobs.analysis.statistics import crossed_spread


def tables(rng, rows, columns, rest, count):
    """Tables (count, 5, 4) of effects of rows, of columns and of neither with these standard deviations."""
    return (
        50.0
        + rng.normal(0.0, rows, (count, 5, 1))
        + rng.normal(0.0, columns, (count, 1, 4))
        + rng.normal(0.0, rest, (count, 5, 4))
    )


def test_rows_columns_and_rest_are_told_from_each_other():
    rng = np.random.default_rng(0)
    found = np.array([crossed_spread(one)[:3] for one in tables(rng, 9.0, 5.0, 2.0, 500)])
    np.testing.assert_allclose((found**2).mean(axis=0), np.square([9.0, 5.0, 2.0]), rtol=0.1)


def test_where_rows_do_not_differ_their_p_is_uniform_and_that_of_the_columns_is_not():
    rng = np.random.default_rng(1)
    found = [crossed_spread(one) for one in tables(rng, 0.0, 5.0, 2.0, 500)]
    assert kstest([one.rows_p for one in found], "uniform").pvalue > 0.01
    assert kstest([one.columns_p for one in found], "uniform").pvalue < 1e-6


def test_the_test_is_that_of_two_nested_linear_models():
    """The rest with and without effects of rows, by least squares."""
    values = tables(np.random.default_rng(2), 3.0, 5.0, 2.0, 1)[0]
    rows, columns = np.indices(values.shape)
    effects = [np.eye(5)[rows.ravel()], np.eye(4)[columns.ravel()]]
    rests = []
    for design in (np.hstack(effects), effects[1]):
        solution = np.linalg.lstsq(design, values.ravel(), rcond=None)[0]
        rests.append(((values.ravel() - design @ solution) ** 2).sum())
    found = crossed_spread(values)
    assert found.rest == pytest.approx(np.sqrt(rests[0] / 12))
    explained = (rests[1] - rests[0]) / 4
    assert found.rows**2 * 4 + found.rest**2 == pytest.approx(explained)
    assert found.rows_p == pytest.approx(f.sf(explained / (rests[0] / 12), 4, 12))


def test_exchanging_rows_and_columns_exchanges_what_is_said_of_them():
    values = tables(np.random.default_rng(3), 9.0, 5.0, 2.0, 1)[0]
    one, other = crossed_spread(values), crossed_spread(values.T)
    assert other == (one.columns, one.rows, pytest.approx(one.rest), one.columns_p, one.rows_p)


def test_equal_values_have_no_spread_and_no_test():
    assert crossed_spread(np.ones((3, 2))) == (0.0, 0.0, 0.0, None, None)


def test_one_row_or_no_number_is_refused():
    with pytest.raises(ValueError, match="two rows and two columns, got shape"):
        crossed_spread(np.ones((1, 4)))
    with pytest.raises(ValueError, match="finite"):
        crossed_spread(np.array([[1.0, np.nan], [0.0, 1.0]]))
