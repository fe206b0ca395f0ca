import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.events import EVENT, event_image, pack_window, unpack_window
from envs.events.windows import pack_windows

PIXELS = st.integers(0, 65535)
ROWS = st.lists(st.tuples(st.integers(1, 5000), PIXELS, PIXELS, st.sampled_from([-1, 1])), max_size=12)
NOTHING = np.empty(0, EVENT)


def as_events(rows, start_us=0):
    events = np.array(sorted(rows), EVENT) if rows else NOTHING.copy()
    events["t"] += start_us
    return events


@settings(max_examples=50)
@given(ROWS, st.integers(-(2**40), 2**40))
def test_packing_and_unpacking_gives_the_events_back(rows, start_us):
    window = pack_window(as_events(rows, start_us), start_us, 5000, 12)
    assert window.dtype == np.int32
    assert window.shape == (13, 4)
    assert window[0].tolist() == [len(rows), 0, 5000, 0]
    assert not window[len(rows) + 1 :].any()
    events, window_us = unpack_window(window)
    assert window_us == 5000
    assert np.array_equal(events, as_events(rows))


def test_over_capacity_the_newest_are_kept_and_the_others_counted():
    events = as_events([(t, t, 2 * t, 1) for t in range(1, 11)])
    window = pack_window(events, 0, 10, 4)
    assert window[0].tolist() == [4, 6, 10, 0]
    assert window[1:, 0].tolist() == [7, 8, 9, 10]


def rows_of(*rows):
    return np.array(list(rows), EVENT)


@pytest.mark.parametrize(
    ("events", "window_us", "capacity", "message"),
    [
        (rows_of((0, 1, 1, 1)), 10, 4, "event 0"),
        (rows_of((11, 1, 1, 1)), 10, 4, "event 0"),
        (rows_of((5, 1, 1, 0)), 10, 4, "event 0"),
        (rows_of((5, 1, 1, 1), (4, 1, 1, 1)), 10, 4, "event 1"),
        (NOTHING, 0, 4, "window_us"),
        (NOTHING, 2**31, 4, "window_us"),
        (NOTHING, 10, 0, "capacity"),
        (np.zeros((3, 4)), 10, 4, "EVENT"),
    ],
)
def test_what_is_no_window_of_events_is_refused(events, window_us, capacity, message):
    with pytest.raises(ValueError, match=message):
        pack_window(events, 0, window_us, capacity)


def test_what_cannot_be_unpacked_is_refused():
    window = np.zeros((3, 4), np.int32)
    window[0, 0] = 3
    for wrong, message in ((np.zeros((3, 4)), "int32"), (window, "cannot hold 3")):
        with pytest.raises(ValueError, match=message):
            unpack_window(wrong)


def test_the_picture_shows_the_last_polarity_of_each_pixel_and_no_event_may_lie_outside():
    events = as_events([(1, 2, 0, 1), (2, 2, 0, -1), (3, 0, 1, -1), (4, 0, 1, 1)])
    assert event_image(events, 3, 2).tolist() == [[0, 0, 125], [255, 0, 0]]
    assert event_image(events, 3, 2).dtype == np.uint8
    for x, y in ((3, 0), (0, 2)):
        with pytest.raises(ValueError, match="event 0"):
            event_image(as_events([(1, x, y, 1)]), 3, 2)


@pytest.mark.parametrize("capacity", [3, None])
def test_windows_packed_together_are_those_packed_alone(capacity):
    rng, span_us, starts_us = np.random.default_rng(0), 1000, [0, 500, 7000, 9000]
    parts = []
    for start_us, count in zip(starts_us, (20, 0, 1, 7), strict=True):
        columns = (
            rng.integers(1, span_us + 1, count),
            *rng.integers(9, size=(2, count)),
            rng.choice([-1, 1], count),
        )
        parts.append(as_events(list(zip(*columns, strict=True)), start_us))
    ends = np.cumsum([0, *(part.size for part in parts)])
    lengths_us = np.full(4, span_us)
    windows = pack_windows(np.concatenate(parts), ends, np.array(starts_us), lengths_us, capacity)
    assert len(windows) == 4
    for window, events, start_us in zip(windows, parts, starts_us, strict=True):
        size = max(events.size, 1) if capacity is None else capacity
        alone = pack_window(events, start_us, span_us, size)[: events.size + 1 if capacity is None else None]
        assert window.tobytes() == alone.tobytes()
