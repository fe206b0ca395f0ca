import numpy as np
import pytest

from models.encoder.event_batch import (
    EventBatch,
    Grid,
    batch_packed,
    batch_rows,
    batch_windows,
    distinct,
    event_rows,
    thin,
)
from tests.support.encoders import events

GRID = Grid(width=5, height=3, time_bins=10)


def packed(capacity, window_us, rows):
    window = np.zeros((capacity + 1, 4), np.int32)
    window[0] = [len(rows), 0, window_us, 0]
    window[1 : len(rows) + 1] = np.array(rows, np.int32).reshape(-1, 4)
    return window


def test_an_address_holds_polarity_row_column_and_time_bin():
    batch = batch_windows([(events((101, 4, 2, 1), (150, 0, 0, -1), (200, 1, 1, -1)), 100, 100)], GRID)
    assert batch.code.tolist() == [15 + 2 * 5 + 4, 0, 6]
    assert batch.bin.tolist() == [0, 5, 9]
    assert batch.offsets.tolist() == [0, 3]


def test_windows_in_every_form_have_the_same_addresses_and_empty_ones_keep_their_place():
    rows = [[], [(3, 1, 2, -1), (7, 4, 0, 1)], [], [(9, 4, 0, 1)]]
    expected = batch_windows([(events(*own), 0, 10) for own in rows], GRID)
    assert expected.offsets.tolist() == [0, 0, 2, 2, 3]
    short = [packed(len(own), 10, own) for own in rows]
    stack = np.stack([packed(4, 10, own) for own in rows])
    stack[0] = 0  # an empty window too
    for form in (short, tuple(short), stack):
        found = batch_packed(form, GRID)
        for name in ("code", "bin", "offsets"):
            assert np.array_equal(getattr(found, name), getattr(expected, name))
    assert batch_packed([], GRID).offsets.tolist() == [0]


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (packed(2, 10, [(1, 0, 0, 1), (1, 5, 0, 1)]), "window 1: event 1 has x=5, y=0, p=1"),
        (packed(2, 10, [(1, -1, 0, 1)]), "window 1: event 0 has x=-1"),
        (np.array([[3, 0, 10, 0]] * 3, np.int32), "window 1 announces 3 events, its capacity is 2"),
        (np.array([[-1, 0, 10, 0]] * 3, np.int32), "window 1 announces -1 events, its capacity is 2"),
        (np.zeros((0, 4), np.int32), "window 1: a packed window is int32 .*got int32 \\(0, 4\\)"),
        (np.zeros((2, 3), np.int32), "window 1: a packed window is int32 .*got int32 \\(2, 3\\)"),
        (np.zeros((2, 4)), "window 1: a packed window is int32 .*got float64 \\(2, 4\\)"),
    ],
)
def test_a_refusal_names_the_first_window_that_it_is_about(bad, message):
    fine = packed(3, 10, [(3, 1, 2, -1)])
    with pytest.raises(ValueError, match=message):
        batch_packed([fine, bad, fine, bad], GRID)


FINE = events((1, 0, 0, 1))
FLOATS = np.array([(np.nan, 0, 0, 1)] * 2, np.dtype([("t", "f8"), ("x", "u2"), ("y", "u2"), ("p", "i1")]))


@pytest.mark.parametrize(
    ("window", "rule"),
    [
        ((events((1, 0, 0, 1), (1, 5, 0, 1)), 0, 10), "event 1 has x=5, y=0, p=1"),
        ((events((1, 0, 0, 1), (1, 0, 3, 1)), 0, 10), "event 1 has x=0, y=3, p=1"),
        ((events((1, 0, 0, 1), (1, 0, 0, 0)), 0, 10), "event 1 has x=0, y=0, p=0"),
        ((FLOATS, 0, 10), "field t must hold integers"),
        ((FINE, 0, 0), "window_us must be"),
        ((FINE, 0, 2**60), "window_us must be"),
    ],
)
def test_windows_that_cannot_be_are_refused_with_the_rule(window, rule):
    with pytest.raises(ValueError, match=rule):
        batch_windows([window], GRID)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"code": np.array([30], np.int32)}, "code must lie in 0..29"),
        ({"code": np.array([-1], np.int32)}, "code must lie in"),
        ({"bin": np.array([10], np.int32)}, "bin must lie in 0..9"),
        ({"bin": np.array([1, 2], np.int32)}, "one per event"),
        ({"code": np.array([1.0])}, "must be int32"),
        ({"offsets": np.array([0, 2])}, "from 0 to 1 events"),
        ({"offsets": np.array([0, 1, 0, 1])}, "must not decrease"),
    ],
)
def test_addresses_outside_of_the_tables_are_refused(changes, message):
    fields = {"code": np.array([3], np.int32), "bin": np.array([2], np.int32), "offsets": np.array([0, 1])}
    with pytest.raises(ValueError, match=message):
        EventBatch(GRID, **{**fields, **changes})


def addresses(count, grid):
    rng = np.random.default_rng(count)
    code = rng.integers(0, 2 * grid.width * grid.height, count)
    return np.stack([code, np.sort(rng.integers(0, grid.time_bins, count))]).astype(np.int32)


def batch_of(grid, *parts):
    offsets = np.cumsum([0, *(part.shape[1] for part in parts)])
    return EventBatch(grid, *np.concatenate(parts, axis=1), offsets)


def test_the_events_that_are_kept_are_spread_evenly_over_each_window():
    counts = [0, 1, 63, 64, 65, 5000, 0, 200]
    parts = [np.stack([np.arange(count)] * 2).astype(np.int32) for count in counts]
    batch = thin(batch_of(Grid(50, 50, 5000), *parts), 64)
    assert np.diff(batch.offsets).tolist() == np.minimum(counts, 64).tolist()
    np.testing.assert_array_equal(batch.code, batch.bin)
    for count, kept in zip(counts, np.split(batch.code, batch.offsets[1:-1]), strict=True):
        if count <= 64:
            assert kept.tolist() == list(range(count))
        else:
            gaps = np.diff([-1, *kept, count])
            assert gaps[1:-1].max() <= count / 64 + 1
            assert max(gaps[0], gaps[-1]) <= count / 128 + 1.5


def test_a_row_says_kind_time_and_place_and_empty_rows_follow():
    address = np.array([[1200 + 5 * 40 + 7, 39], [300, 1023]], np.int32)
    rows = event_rows(batch_of(Grid(40, 30, 1024), address[:, :0], address), 4)
    assert rows.dtype == np.int16
    assert rows.tolist() == [[[0] * 4] * 4, [[1, 300, 7, 5], [2, 1023, 39, 0], [0] * 4, [0] * 4]]


def test_rows_hold_a_window_exactly_up_to_the_largest_sides_and_time_bins():
    grid = Grid(1 << 9, 1 << 7, 1 << 15)
    parts = [addresses(count, grid) for count in (30, 0, 64)]
    rows = event_rows(batch_of(grid, *parts), 64)
    batch = batch_rows(rows, grid)
    assert batch.offsets.tolist() == [0, 30, 30, 94]
    np.testing.assert_array_equal(np.stack([batch.code, batch.bin]), np.concatenate(parts, axis=1))
    shuffled = rows[:, np.random.default_rng(0).permutation(64)]
    np.testing.assert_array_equal(np.sort(batch_rows(shuffled, grid).code[:30]), np.sort(parts[0][0]))


def test_distinct_values_are_counted_and_found_again():
    values = np.array([7, 2, 7, 7, 0])
    present, multiplicity, rank = distinct(values)
    assert (present.tolist(), multiplicity.tolist()) == ([0, 2, 7], [1, 1, 3])
    np.testing.assert_array_equal(present[rank], values)
    assert [len(part) for part in distinct(values[:0])] == [0, 0, 0]
