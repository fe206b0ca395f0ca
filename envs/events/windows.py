"""Events of one control step as an array of fixed size, or as a picture (appendix D.1.2)."""

import itertools

import numba
import numpy as np

from core.pictures import GREY_OFF, GREY_ON
from envs.events.camera import EVENT

MAX_WINDOW_US = 2**31 - 1


def pack_window(events: np.ndarray, start_us: int, window_us: int, capacity: int) -> np.ndarray:
    """Pack the events of one window into an integer array of fixed size.

    Row 0 is [count, dropped, window_us, 0]; rows 1 to count are [t - start_us, x, y, p], in
    time order; the rest is 0. If there are more events than the capacity, the oldest are
    dropped and counted.

    Args:
        events: EVENT with t in (start_us, start_us + window_us], sorted by t.
        start_us: Start of the window [us].
        window_us: Length of the window [us].
        capacity: Largest number of events in the window.

    Returns:
        int32 (capacity + 1, 4).

    Raises:
        ValueError: Wrong dtype, window or capacity, or an event out of time or order.
    """
    if events.dtype != EVENT or events.ndim != 1:
        raise ValueError(f"events must be a 1-D EVENT array; got {events.dtype}, {events.ndim}-D.")
    if not 0 < window_us <= MAX_WINDOW_US or capacity < 1:
        raise ValueError(
            f"window_us must be in [1, {MAX_WINDOW_US}] and capacity >= 1; got {window_us} and {capacity}."
        )
    bad = _first_out_of_place(events, start_us, window_us)
    if bad >= 0:
        raise ValueError(
            f"events must be sorted by t within ({start_us}, {start_us + window_us}] us with p in {{-1, 1}}; "
            f"event {bad} is {events[bad]}."
        )
    window = np.zeros((capacity + 1, 4), np.int32)
    _fill(events, start_us, window_us, window)
    return window


def pack_windows(
    events: np.ndarray, ends: np.ndarray, starts_us: np.ndarray, lengths_us: np.ndarray, capacity: int | None
) -> np.ndarray | tuple[np.ndarray, ...]:
    """Pack several windows as `pack_window` does, without checking the events.

    Args:
        events: Valid EVENT of all windows, one after the other, such as the events of `EventCamera`.
        ends: int64 (B + 1,), window b has events ends[b] .. ends[b + 1] - 1.
        starts_us: Start of each window, int64 (B,) [us].
        lengths_us: Length of each window, int64 (B,) [us].
        capacity: Largest number of events in a window; None: each window has as many rows as it needs.

    Returns:
        int32 (B, capacity + 1, 4), or B arrays (N + 1, 4).
    """
    count = len(starts_us)
    if capacity is not None:
        windows = np.zeros((count, capacity + 1, 4), np.int32)
        _fill_all(events, ends, starts_us, lengths_us, windows)
        return windows
    rows = np.empty((events.size + count, 4), np.int32)
    _fill_flat(events, ends, starts_us, lengths_us, rows)
    begins = (ends + np.arange(count + 1)).tolist()
    return tuple([rows[begin:end] for begin, end in itertools.pairwise(begins)])


def unpack_window(window: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the events of a packed window, with t counted from its start, and the window's length [us].

    Args:
        window: int32 (capacity + 1, 4), from `pack_window`.

    Raises:
        ValueError: Wrong dtype or shape, or a count that the rows cannot hold.
    """
    if window.dtype != np.int32 or window.ndim != 2 or window.shape[1] != 4 or window.shape[0] < 1:
        raise ValueError(f"a window is int32 (capacity + 1, 4); got {window.dtype} {window.shape}.")
    count = int(window[0, 0])
    if not 0 <= count < window.shape[0]:
        raise ValueError(f"a window of {window.shape[0] - 1} rows cannot hold {count} events.")
    events = np.empty(count, EVENT)
    for column, name in enumerate(("t", "x", "y", "p")):
        events[name] = window[1 : count + 1, column]
    return events, int(window[0, 2])


def event_image(events: np.ndarray, width: int, height: int) -> np.ndarray:
    """Draw a picture of events: 255 if a pixel's last event was ON, 125 if OFF, else 0 (appendix D.1.2).

    Args:
        events: EVENT in time order.
        width: Width of the picture [pixels].
        height: Height of the picture [pixels].

    Returns:
        uint8 (H, W).

    Raises:
        ValueError: An event lies outside the picture.
    """
    image = np.zeros((height, width), np.uint8)
    bad = _draw(events, image)
    if bad >= 0:
        raise ValueError(f"events must lie within {width} x {height} pixels; event {bad} is {events[bad]}.")
    return image


@numba.njit(cache=True, error_model="numpy")
def _first_out_of_place(events, start_us, window_us):
    """Return the index of the first event outside the window, out of order or without polarity, or -1."""
    last = start_us + 1
    for i in range(events.size):
        event = events[i]
        if not last <= event.t <= start_us + window_us or abs(event.p) != 1:
            return i
        last = event.t
    return -1


@numba.njit(cache=True, error_model="numpy")
def _fill(events, start_us, window_us, window):
    """Write the newest events and row 0 into an empty window."""
    dropped = max(events.size - (window.shape[0] - 1), 0)
    window[0, 0], window[0, 1], window[0, 2] = events.size - dropped, dropped, window_us
    for i in range(dropped, events.size):
        event, row = events[i], i - dropped + 1
        window[row, 0], window[row, 1] = event.t - start_us, event.x
        window[row, 2], window[row, 3] = event.y, event.p


@numba.njit(cache=True, error_model="numpy")
def _fill_all(events, ends, starts_us, lengths_us, windows):
    """Fill the empty windows (B, capacity + 1, 4)."""
    for b in range(starts_us.size):
        _fill(events[ends[b] : ends[b + 1]], starts_us[b], lengths_us[b], windows[b])


@numba.njit(cache=True, error_model="numpy")
def _fill_flat(events, ends, starts_us, lengths_us, rows):
    """Fill windows that have just as many rows as they need, one after the other."""
    for b in range(starts_us.size):
        own = rows[ends[b] + b : ends[b + 1] + b + 1]
        own[0, 3] = 0
        _fill(events[ends[b] : ends[b + 1]], starts_us[b], lengths_us[b], own)


@numba.njit(cache=True, error_model="numpy")
def _draw(events, image):
    """Set the pixels of the events in order; return the first event outside, or -1."""
    for i in range(events.size):
        event = events[i]
        if event.y >= image.shape[0] or event.x >= image.shape[1]:
            return i
        image[event.y, event.x] = GREY_ON if event.p > 0 else GREY_OFF
    return -1
