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

EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
GRID = Grid(width=5, height=3, time_bins=10)


def events(*rows):
    return np.array(list(rows), EVENT)


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


def test_empty_windows_keep_their_place_among_others():
    window = events((1, 0, 0, 1))
    batch = batch_windows([(window[:0], 0, 10), (window, 0, 10), (window[:0], 0, 10)], GRID)
    assert len(batch) == 3
    assert batch.offsets.tolist() == [0, 0, 1, 1]


def test_packed_windows_have_the_addresses_of_their_events():
    rows = [(3, 1, 2, -1), (7, 4, 0, 1)]
    structured = batch_windows([(events(*rows), 0, 10), (events(), 0, 10)], GRID)
    from_packed = batch_packed(np.stack([packed(4, 10, rows), packed(4, 10, [])]), GRID)
    for name in ("code", "bin", "offsets"):
        assert np.array_equal(getattr(structured, name), getattr(from_packed, name))


def test_windows_of_any_lengths_are_the_stack_that_they_would_fill():
    windows = [packed(n, 10, [(n, 1, 2, -1), (9, 4, 0, 1)][:n]) for n in (2, 0, 1)]
    stack = np.stack([packed(5, 10, window[1:].tolist()) for window in windows])
    for other in (windows, tuple(windows)):
        found, expected = batch_packed(other, GRID), batch_packed(stack, GRID)
        assert found.offsets.tolist() == [0, 2, 2, 3]
        for name in ("code", "bin", "offsets"):
            assert np.array_equal(getattr(found, name), getattr(expected, name))
    assert batch_packed([], GRID).offsets.tolist() == [0]


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (packed(2, 10, [(1, 0, 0, 1), (1, 5, 0, 1)]), "window 1: event 1 has x=5, y=0, p=1"),
        (packed(2, 0, [(1, 0, 0, 1)]), "window 1: window_us must be in .* got 0"),
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


def test_a_packed_window_of_zeros_is_an_empty_window():
    assert batch_packed(np.zeros((2, 5, 4), np.int32), GRID).offsets.tolist() == [0, 0, 0]


@pytest.mark.parametrize("count", [-1, 5])
def test_a_packed_window_cannot_announce_more_than_it_holds(count):
    window = packed(4, 10, [])
    window[0, 0] = count
    with pytest.raises(ValueError, match="capacity is 4"):
        batch_packed(window[None], GRID)


@pytest.mark.parametrize("row", [(1, 5, 0, 1), (1, 0, 3, 1), (1, 65535, 0, 1), (1, 0, 0, 0), (1, 0, 0, 2)])
def test_an_event_off_the_sensor_or_without_polarity_is_refused_by_its_index(row):
    with pytest.raises(ValueError, match=f"event 1 has x={row[1]}, y={row[2]}, p={row[3]}"):
        batch_windows([(events((1, 0, 0, 1), row), 0, 10)], GRID)


FLOATS = np.array([(np.nan, 0, 0, 1)] * 2, np.dtype([("t", "f8"), ("x", "u2"), ("y", "u2"), ("p", "i1")]))
REFUSED = [
    (lambda: batch_packed(packed(4, 10, [(1, -1, 0, 1)])[None], GRID), "x=-1"),
    (lambda: batch_windows([(FLOATS, 0, 10)], GRID), "field t must hold integers"),
    (lambda: batch_windows([(events((1, 0, 0, 1)), 0, 0)], GRID), "window_us must be"),
    (lambda: batch_windows([(events((1, 0, 0, 1)), 0, -5)], GRID), "window_us must be"),
    (lambda: batch_windows([(events((1, 0, 0, 1)), 0, 2**60)], GRID), "window_us must be"),
]


@pytest.mark.parametrize(("call", "rule"), REFUSED)
def test_windows_that_cannot_be_are_refused_with_the_rule(call, rule):
    with pytest.raises(ValueError, match=rule):
        call()


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


def addresses(count, seed=0, width=40, height=30, time_bins=1024):
    rng = np.random.default_rng(seed)
    code = rng.integers(0, 2 * width * height, count)
    return np.stack([code, np.sort(rng.integers(0, time_bins, count))]).astype(np.int32)


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
    parts = [addresses(count, count, *grid) for count in (30, 0, 64)]
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
