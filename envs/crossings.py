"""The event camera's kernels: which pixels crossed which levels, when, in time order.

A quiet pixel costs two compares: its quiet band is kept in linear luminance and lies inside
[0, largest float32], so that whatever is not a luminance is outside it as well. Pixels
outside are decided in float64. All functions but `first_invalid` and `step` take their
input as valid.

Names: `luminance` float32 (N,), this frame; `previous` float32 (N,), the last one; `band`
float32 (2, N), quiet from row 0 to row 1, both included; `level` float64 (3, N), first log
luminance, ON count and OFF count; `response` the ON threshold, the OFF threshold and the
luminance floor.
"""

import numba
import numpy as np

EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])

# Two luminances rounded to float32 leave their log difference uncertain by this much: a level
# this near counts as reached, so that a step of exactly k thresholds gives k events.
LOG_TOLERANCE = 2.0**-23
MARGIN = 1e-9  # relative; far above the error of float64 exp and log
HALF_ULP = 2.0**-23  # relative; above the rounding of a bound to float32
LARGEST = float(np.finfo(np.float32).max)
DIGIT_BITS = 8
DIGITS = 1 << DIGIT_BITS


@numba.njit(cache=True, error_model="numpy")
def first_invalid(luminance):
    """Index of the first value that is not finite and >= 0, or -1."""
    for i in range(luminance.size):
        if not 0.0 <= luminance[i] <= LARGEST:
            return i
    return -1


@numba.njit(cache=True, error_model="numpy")
def remember(luminance, response, previous, band, level):
    """Start all memories from one frame."""
    floor = response[2]
    for i in range(luminance.size):
        level[0, i] = np.log(luminance[i] + floor)
        level[1, i] = 0.0
        level[2, i] = 0.0
    _band_around(luminance, response, band)
    previous[:] = luminance


@numba.njit(cache=True, error_model="numpy")
def _band_around(luminance, response, band):
    """Quiet bands of all pixels whose remembered levels are the logs of `luminance`."""
    on, off, floor = response
    rise = np.exp(on - LOG_TOLERANCE) * (1.0 - MARGIN)
    fall = np.exp(LOG_TOLERANCE - off) * (1.0 + MARGIN)
    for i in range(luminance.size):
        light = luminance[i] + floor
        band[0, i] = _bound(light * fall - floor, 1.0 + HALF_ULP)
        band[1, i] = _bound(light * rise - floor, 1.0 - HALF_ULP)


@numba.njit(cache=True, error_model="numpy", inline="always")
def _bound(value, inwards):
    """A bound of the quiet band as float32, never further out than `value` and never invalid."""
    return np.float32(min(max(value * inwards, 0.0), LARGEST))


@numba.njit(cache=True, error_model="numpy")
def step(luminance, frame, forgets, response, state):
    """One frame: (first invalid pixel or -1, events dropped, events). State changes only if all is valid."""
    t0, t1, width, cap = frame
    previous, band, level, words, outside = state
    found = _scan(luminance, band, words, outside)
    crossings = np.empty(found, np.int64)
    logs = np.empty((3, found))
    bad, firing, total, dropped = _count(luminance, (forgets, cap), response, state, (crossings, logs))
    if bad >= 0:
        return bad, 0, np.empty(0, EVENT)
    times = np.empty(total, np.int64)
    places = np.empty(total, np.int64)
    _emit((t1 - t0, width, cap), response, outside[:firing], (crossings, logs), (times, places))
    _advance(firing, forgets, response, (luminance, band, level, outside), crossings)
    previous[:] = luminance
    times, places = _sorted_by_time(times, places, t1 - t0)
    events = np.empty(total, EVENT)
    for i in range(total):
        event, place = events[i], places[i]
        event.t = t0 + times[i]
        event.x = (place >> 1) & 0xFFFF
        event.y = place >> 17
        event.p = 2 * (place & 1) - 1
    return -1, dropped, events


@numba.njit(cache=True, error_model="numpy")
def _scan(luminance, band, words, outside):
    """Write the pixels outside their quiet band, in raster order; return how many.

    The first loop has no branch, so that it compiles to wide instructions; the second looks
    at eight flags at a time.
    """
    flags = words.view(np.uint8)
    for i in range(luminance.size):
        flags[i] = not ((luminance[i] >= band[0, i]) & (luminance[i] <= band[1, i]))
    found = 0
    for word in range(words.size):
        if words[word] != 0:
            for i in range(8 * word, 8 * word + 8):
                outside[found] = i
                found += flags[i]
    return found


@numba.njit(cache=True, error_model="numpy")
def _count(luminance, rule, response, state, out):
    """Signed crossings and log levels (before, after, remembered) of firing pixels, compacted in place."""
    forgets, cap = rule
    on, off, floor = response
    previous, _, level, _, outside = state
    crossings, logs = out
    firing, total, dropped = 0, 0, 0
    for j in range(crossings.size):
        i = outside[j]
        if not 0.0 <= luminance[i] <= LARGEST:
            return i, 0, 0, 0
        before = np.log(previous[i] + floor)
        after = np.log(luminance[i] + floor)
        if after == before:
            continue
        remembered = before if forgets else _level(level, i, on, off)
        change = after - remembered
        n = int((abs(change) + LOG_TOLERANCE) / (on if change > 0.0 else off))
        if n > 0:
            outside[firing] = i
            crossings[firing] = n if change > 0.0 else -n
            logs[0, firing], logs[1, firing], logs[2, firing] = before, after, remembered
            firing += 1
            total += min(n, cap)
            dropped += max(n - cap, 0)
    return -1, firing, total, dropped


@numba.njit(cache=True, error_model="numpy", inline="always")
def _level(level, i, on, off):
    """Remembered log level; equal thresholds multiply the exact net count once."""
    if on == off:
        return level[0, i] + (level[1, i] - level[2, i]) * on
    return level[0, i] + level[1, i] * on - level[2, i] * off


@numba.njit(cache=True, error_model="numpy")
def _emit(frame, response, pixels, found, out):
    """Times [us after the last frame] and places (y << 17 | x << 1 | ON) of all events, by pixel."""
    interval, width, cap = frame
    crossings, logs = found
    times, places = out
    event = 0
    for j in range(pixels.size):
        n = crossings[j]
        rises = n > 0
        step = response[0] if rises else -response[1]
        y = pixels[j] // width
        place = (y << 17) | ((pixels[j] - y * width) << 1) | rises
        before, after, remembered = logs[0, j], logs[1, j], logs[2, j]
        pace = interval / (after - before)
        for k in range(1, min(abs(n), cap) + 1):
            t = np.rint((remembered + k * step - before) * pace)
            times[event] = int(min(max(t, 1.0), interval))
            places[event] = place
            event += 1


@numba.njit(cache=True, error_model="numpy")
def _advance(firing, forgets, response, state, crossings):
    """Move the remembered levels by all levels crossed, emitted or dropped, and the bands with them."""
    luminance, band, level, pixels = state
    on, off, floor = response
    if forgets:
        _band_around(luminance, response, band)
        return
    rise = np.exp(on - LOG_TOLERANCE) * (1.0 - MARGIN)
    fall = np.exp(LOG_TOLERANCE - off) * (1.0 + MARGIN)
    for j in range(firing):
        i = pixels[j]
        level[1 if crossings[j] > 0 else 2, i] += abs(crossings[j])
        light = np.exp(_level(level, i, on, off))
        band[0, i] = _bound(light * fall - floor, 1.0 + HALF_ULP)
        band[1, i] = _bound(light * rise - floor, 1.0 - HALF_ULP)


@numba.njit(cache=True, error_model="numpy")
def _sorted_by_time(times, places, interval):
    """Stable radix sort by time: ties stay in raster order. O(events) for any interval."""
    other_times, other_places = np.empty_like(times), np.empty_like(places)
    shift = 0
    while interval >> shift > 0:
        start = np.zeros(DIGITS + 1, np.int64)
        for t in times:
            start[((t >> shift) & (DIGITS - 1)) + 1] += 1
        for digit in range(DIGITS):
            start[digit + 1] += start[digit]
        for i in range(times.size):
            digit = (times[i] >> shift) & (DIGITS - 1)
            other_times[start[digit]] = times[i]
            other_places[start[digit]] = places[i]
            start[digit] += 1
        times, other_times = other_times, times
        places, other_places = other_places, places
        shift += DIGIT_BITS
    return times, places
