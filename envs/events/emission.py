"""From trains to events: the events of one pixel between two frames are evenly spaced in time."""

from typing import NamedTuple

import numba
import numpy as np

EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
# Every pixel of the largest sensor can fire once; sorting takes at most 0.6 GB.
MAX_EVENTS_PER_FRAME = 2**24
MIN_BITS, MAX_BITS = 6, 13  # of a digit in the sort; 13 bits need a table of 64 KiB


class Span(NamedTuple):
    """Times of the last frame and of this one [us]."""

    start_us: int
    end_us: int


class Trains(NamedTuple):
    """Events of N pixels between two frames.

    Event k = 0, 1, ... of a train comes `start + k * stride` microseconds after the last frame,
    rounded to a whole microsecond in [1, interval].

    Attributes:
        pixels: Flat indices of the pixels in increasing order, int64.
        crossings: Number of levels crossed, negative if downwards, int64.
        sent: Number of crossings that become events, int64.
        start, stride: Time of the first event, and time from one event to the next [us], float64.
    """

    pixels: np.ndarray
    crossings: np.ndarray
    sent: np.ndarray
    start: np.ndarray
    stride: np.ndarray


@numba.njit(cache=True, error_model="numpy", inline="always")
def moment(start, stride, k, interval):
    """Return the time of event `k` of a train [us after the last frame]."""
    return np.int64(min(max(np.rint(start + k * stride), 1.0), interval))


@numba.njit(cache=True, error_model="numpy")
def limit_events(trains, span, limit):
    """Lower `trains.sent` so that at most `limit` events remain, the earliest; return their number.

    If the first microsecond alone has more events, all trains keep the same number of events.
    """
    sent, total = trains.sent, trains.sent.sum()
    if total <= limit:
        return total
    interval = span.end_us - span.start_us
    early, late = 0, interval
    while late - early > 1:
        middle = (early + late) // 2
        if _count_until(trains, middle, interval) > limit:
            late = middle
        else:
            early = middle
    share = limit // sent.size
    for j in range(sent.size):
        sent[j] = _train_until(trains, j, early, interval) if early > 0 else min(sent[j], share)
    return sent.sum()


@numba.njit(cache=True, error_model="numpy")
def _count_until(trains, t, interval):
    """Count the events up to and including time `t`."""
    total = 0
    for j in range(trains.sent.size):
        total += _train_until(trains, j, t, interval)
    return total


@numba.njit(cache=True, error_model="numpy")
def _train_until(trains, j, t, interval):
    """Count the events of train `j` up to and including time `t`."""
    low, high = 0, trains.sent[j]
    while low < high:
        middle = (low + high) // 2
        if moment(trains.start[j], trains.stride[j], middle, interval) <= t:
            low = middle + 1
        else:
            high = middle
    return low


@numba.njit(cache=True, error_model="numpy")
def events_of(trains, span, width, total):
    """Return the EVENT array of all trains, sorted by (t, y, x, order in the pixel), in O(events).

    The radix sort by time is stable, so ties keep the raster order of the trains.

    Args:
        trains: `Trains`, of which `total` events are sent.
        span: `Span`.
        width: Pixels of a row.
        total: Sum of `trains.sent`.
    """
    interval = span.end_us - span.start_us
    times, places = _emitted(trains, interval, width, total)
    return sorted_events(times, places, span)


@numba.njit(cache=True, error_model="numpy")
def sorted_events(times, places, span):
    """Return the EVENT array in the order of time; ties keep the given order.

    Args:
        times: int64 (N,), after the start of the span [us], at most its length.
        places: uint32 (N,), y << 13 | x << 1 | is ON.
        span: `Span`.
    """
    total, interval = times.size, span.end_us - span.start_us
    events = np.empty(total, EVENT)
    if total == 0:
        return events
    passes, bits = _digits(interval, total)
    mask = (1 << bits) - 1
    for turn in range(passes - 1):
        times, places = _moved(times, places, turn * bits, mask)
    shift = (passes - 1) * bits
    place_of = _starts(times, shift, mask, interval >> shift)
    for i in range(total):
        t, place = times[i], places[i]
        digit = (t >> shift) & mask
        event = events[place_of[digit]]
        place_of[digit] += 1
        event.t = span.start_us + t
        event.x = (place >> 1) & 0xFFF
        event.y = place >> 13
        event.p = 2 * (place & 1) - 1
    return events


@numba.njit(cache=True, error_model="numpy")
def concatenated(parts, total):
    """Concatenate EVENT arrays with `total` events in all."""
    together, size = np.empty(total, EVENT), 0
    for events in parts:
        together[size : size + events.size] = events
        size += events.size
    return together


@numba.njit(cache=True, error_model="numpy")
def _emitted(trains, interval, width, total):
    """Return times [us since the last frame] and places (y << 13 | x << 1 | ON) of all events, by pixel."""
    times, places = np.empty(total, np.int64), np.empty(total, np.uint32)
    event, y = 0, 0
    for j in range(trains.pixels.size):
        pixel = trains.pixels[j]
        while pixel >= (y + 1) * width:
            y += 1
        place = np.uint32((y << 13) | ((pixel - y * width) << 1) | (trains.crossings[j] > 0))
        for k in range(trains.sent[j]):
            times[event] = moment(trains.start[j], trains.stride[j], k, interval)
            places[event] = place
            event += 1
    return times, places


@numba.njit(cache=True, error_model="numpy")
def _digits(interval, total):
    """Choose passes and bits per pass of the sort; a large table does not pay for few events."""
    needed = 1
    while interval >> needed > 0:
        needed += 1
    bits = MIN_BITS
    while bits < MAX_BITS and (1 << bits) < 8 * total:
        bits += 1
    passes = (needed + bits - 1) // bits
    return passes, (needed + passes - 1) // passes


@numba.njit(cache=True, error_model="numpy")
def _starts(times, shift, mask, largest):
    """Return the start index of each digit's events, in the order of that digit; digits are <= `largest`."""
    starts = np.zeros(largest + 2, np.int64)
    for t in times:
        starts[((t >> shift) & mask) + 1] += 1
    for digit in range(largest + 1):
        starts[digit + 1] += starts[digit]
    return starts


@numba.njit(cache=True, error_model="numpy")
def _moved(times, places, shift, mask):
    """Return times and places in the order of one digit; ties keep their order."""
    start = _starts(times, shift, mask, mask)
    moved_times, moved_places = np.empty_like(times), np.empty_like(places)
    for i in range(times.size):
        digit = (times[i] >> shift) & mask
        moved_times[start[digit]] = times[i]
        moved_places[start[digit]] = places[i]
        start[digit] += 1
    return moved_times, moved_places
