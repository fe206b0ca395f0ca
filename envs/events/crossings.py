"""The event camera's kernels: which pixels crossed which levels between two frames, and when.

A quiet pixel costs two compares: its quiet band is kept in linear luminance and lies inside
[0, largest float32], so that whatever is not a luminance is outside it as well. Pixels
outside are decided in float64, by whole blocks, so that their logarithms are computed in
wide instructions. All functions but `first_invalid`, `steps` and `step` take their input as valid.

Names: `luminance` float32 (N,), this frame; `previous` float32 (N,), the last one; `band`
float32 (2, N), quiet from row 0 to row 1, both included; `level` float64 (3, N), first level,
ON count and OFF count since; `held` int64 (N,), end of each pixel's last dead time [us], or of
length 0 without dead times; `thresholds` float64 (4, N) or (4, 1), see `threshold_rows`;
`curve` see `response_curve`; `rule` is (refractory_us, max_events_per_pixel, carries, forgets,
legacy).
"""

import numba
import numpy as np

from envs.events.emission import EVENT, events_of, limit_events
from envs.events.photoreceptor import LARGEST, light_of, respond
from envs.events.refractory import TOLERANCE, resume, train_with_dead_time

MARGIN = 1e-9  # relative; far above the error of float64 exp
HALF_ULP = 2.0**-23  # relative; above the rounding of a bound to float32
BLOCK = 1024  # pixels decided together
# Where each column of a block's table starts; the response before is the first.
AFTER, MEMORY, ON, OFF, COUNT, START, STRIDE = (column * BLOCK for column in range(1, 8))


def threshold_rows(on: np.ndarray, off: np.ndarray, reach: int) -> np.ndarray:
    """The kernels' form of the thresholds of all pixels, or of one that stands for all.

    Args:
        on: ON thresholds, float64 (N,) or (1,).
        off: OFF thresholds, as many.
        reach: Thresholds to the first event: 1, or 2 where the first is lost ("legacy").

    Returns:
        float64 (4, N) or (4, 1): ON and OFF threshold, quiet way up and quiet way down.
    """
    return np.stack((on, off, reach * on - TOLERANCE - MARGIN, reach * off - TOLERANCE - MARGIN))


@numba.njit(cache=True, error_model="numpy")
def first_invalid(luminance):
    """Index of the first value that is not finite and >= 0, or -1."""
    valid = True
    for i in range(luminance.size):  # without a branch: it compiles to wide instructions
        valid &= (luminance[i] >= 0.0) & (luminance[i] <= LARGEST)
    if valid:
        return -1
    for i in range(luminance.size):
        if not 0.0 <= luminance[i] <= LARGEST:
            return i
    return -1


@numba.njit(cache=True, error_model="numpy")
def remember(luminance, curve, thresholds, state):
    """Start all memories from one frame."""
    previous, band, level, held = state
    previous[:] = luminance
    level[1:] = 0.0
    held[:] = np.iinfo(np.int64).min
    _look(luminance, curve, thresholds, band, level[0])


@numba.njit(cache=True, error_model="numpy")
def _look(luminance, curve, thresholds, band, level):
    """Responses of all pixels into `level`, of length 0 if not wanted, and quiet bands around them."""
    pixels, levels, work = _block(luminance.size)
    for first in range(0, luminance.size, BLOCK):
        number = min(BLOCK, luminance.size - first)
        respond(curve, luminance[first : first + number], levels, work[2])
        level[first : first + number] = levels[: level[first : first + number].size]
        for j in range(number):
            pixels[j] = first + j
        _set_bands(pixels[:number], levels, curve, thresholds, band, work)


@numba.njit(cache=True, error_model="numpy")
def _block(size):
    """Memory for pixels that are treated together: indices, levels, and levels and exponents to work with."""
    size = min(size, BLOCK)
    work = np.empty(size), np.empty(size), np.empty(size, np.int64)
    return np.empty(size, np.int64), np.empty(size), work


@numba.njit(cache=True, error_model="numpy")
def _set_bands(pixels, levels, curve, thresholds, band, work):
    """Quiet bands of `pixels` around `levels`."""
    low, high = work[0][: pixels.size], work[1][: pixels.size]
    for j in range(pixels.size):
        k = pixels[j] if thresholds.shape[1] > 1 else 0
        low[j], high[j] = levels[j] - thresholds[3, k], levels[j] + thresholds[2, k]
    light_of(curve, low, work[2])
    light_of(curve, high, work[2])
    for j in range(pixels.size):
        band[0, pixels[j]] = _bound(low[j], 1.0 + HALF_ULP)
        band[1, pixels[j]] = _bound(high[j], 1.0 - HALF_ULP)


@numba.njit(cache=True, error_model="numpy", inline="always")
def _bound(value, inwards):
    """A bound of the quiet band as float32, never further out than `value` and never invalid."""
    return np.float32(min(max(value * inwards, 0.0), LARGEST))


@numba.njit(cache=True, error_model="numpy")
def steps(frames, times, sensor, rule, curve, thresholds, state, scratch):
    """Frames (K, N) one after the other: (bad or -1, events dropped, events).

    Args:
        frames: Float32.
        times: int64 (K + 1,), of the frame before them and theirs, increasing [us].
        sensor: Width, and most events of one frame.
        rule: See above.
        curve: See above.
        thresholds: See above.
        state: `previous`, `band`, `level` and `held`.
        scratch: Flags and pixels to work with.

    Returns:
        Where the first invalid value stands in the flat frames, or -1; nothing is taken then.
        The number of events dropped. EVENT array, sorted.
    """
    bad = first_invalid(frames.ravel()) if len(frames) > 1 else -1
    if bad >= 0:
        return bad, 0, np.empty(0, EVENT)
    batches, dropped, total = [], 0, 0
    for k in range(len(frames)):
        frame = (times[k], times[k + 1], sensor[0], sensor[1])
        bad, lost, events = step(frames[k], frame, rule, curve, thresholds, state, scratch)
        if bad >= 0:
            return bad, 0, np.empty(0, EVENT)
        batches.append(events)
        dropped, total = dropped + lost, total + events.size
    if len(batches) == 1:
        return -1, dropped, batches[0]
    joined, first = np.empty(total, EVENT), 0
    for events in batches:
        joined[first : first + events.size] = events
        first += events.size
    return -1, dropped, joined


@numba.njit(cache=True, error_model="numpy")
def step(luminance, frame, rule, curve, thresholds, state, scratch):
    """One frame: (first invalid pixel or -1, events dropped, events). State changes only if all is valid.

    `frame` is (time of the last frame, time of this one, width, most events in all).
    """
    t0, t1, width, limit = frame
    previous, band, _, _ = state
    words, outside = scratch
    found = _scan(luminance, band, words, outside)
    crossings, trains = np.empty(found, np.int64), np.empty((2 if rule[0] == 0 else 5, found))
    bad, active = _decide(luminance, (t0, t1), rule, curve, thresholds, state, (outside, crossings, trains))
    if bad >= 0:
        return bad, 0, np.empty(0, EVENT)
    pixels, crossings, trains = outside[:active], crossings[:active], trains[:, :active]
    sent = np.empty(active, np.int64)
    wanted = 0
    for j in range(active):
        wanted += abs(crossings[j])
        sent[j] = min(abs(crossings[j]), rule[1])
    total = limit_events(trains, sent, t1 - t0, limit)
    events = events_of((t0, t1, width), pixels, crossings, sent, trains, total)
    _advance(luminance, (t0, t1), rule, curve, thresholds, state, (pixels, crossings, sent, trains))
    previous[:] = luminance
    return -1, 0 if rule[2] else wanted - total, events


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
def _decide(luminance, times, rule, curve, thresholds, state, out):
    """Keep, of the pixels outside their band, those that fire or end a dead time, and describe their trains.

    `trains` has the rows start and stride; with dead times also the response before and after,
    and the remembered level.

    Returns:
        (first invalid pixel or -1, number kept).
    """
    previous, _, level, held = state
    outside, crossings, trains = out
    table, lights, exponents = np.empty(8 * BLOCK), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.int64)
    kept = 0
    for first in range(0, crossings.size, BLOCK):
        pixels = outside[first : min(first + BLOCK, crossings.size)]
        bad = _respond_at(pixels, luminance, curve, table[AFTER:], lights, exponents)
        if bad >= 0:
            return bad, 0
        _respond_at(pixels, previous, curve, table, lights, exponents)
        _recall(pixels, level, thresholds, rule[3], table)
        so_far = (outside, crossings, trains, kept)
        if rule[0] > 0:
            kept = _keep_with_dead_time(pixels, times, rule[0], held, table, so_far)
        else:
            _compare(pixels.size, times[1] - times[0], rule, table)
            kept = _keep(pixels, times[1] - times[0], rule, table, so_far)
    return -1, kept


@numba.njit(cache=True, error_model="numpy")
def _respond_at(pixels, luminance, curve, levels, lights, exponents):
    """Write the responses to the luminance of `pixels`; the first pixel whose luminance is none, or -1."""
    for j in range(pixels.size):
        lights[j] = luminance[pixels[j]]
        if not 0.0 <= lights[j] <= LARGEST:
            return pixels[j]
    respond(curve, lights[: pixels.size], levels, exponents)
    return -1


@numba.njit(cache=True, error_model="numpy")
def _recall(pixels, level, thresholds, forgets, table):
    """Fill the table's remembered levels and thresholds."""
    for j in range(pixels.size):
        k = pixels[j] if thresholds.shape[1] > 1 else 0
        on, off = thresholds[0, k], thresholds[1, k]
        table[ON + j], table[OFF + j] = on, off
        table[MEMORY + j] = table[j] if forgets else _level(level, pixels[j], on, off)


@numba.njit(cache=True, error_model="numpy", inline="always")
def _level(level, i, on, off):
    """Remembered level; equal thresholds multiply the exact net count once."""
    if on == off:
        return level[0, i] + (level[1, i] - level[2, i]) * on
    return level[0, i] + level[1, i] * on - level[2, i] * off


@numba.njit(cache=True, error_model="numpy")
def _compare(size, interval, rule, table):
    """Fill the table's signed counts, starts and strides, without branches.

    A still pixel fires only what it carries over. A level reached before this frame is due at
    once: its pixel may by now move the other way, which gives pace 0.
    """
    _, _, carries, _, legacy = rule
    for j in range(size):
        before, after, remembered = table[j], table[AFTER + j], table[MEMORY + j]
        way, change = after - before, after - remembered
        step = table[ON + j] if change > 0.0 else -table[OFF + j]
        count = max(np.floor((abs(change) + TOLERANCE) / abs(step)) - legacy, 0.0)
        count = count if carries | (way != 0.0) else 0.0
        table[COUNT + j] = np.copysign(count, change)
        pace = interval / way
        pace = pace if way * change > 0.0 else 0.0
        table[START + j] = (remembered + step - before) * pace
        table[STRIDE + j] = step * pace


@numba.njit(cache=True, error_model="numpy")
def _keep(pixels, interval, rule, table, out):
    """Append the pixels that fire to the kept ones; return how many these are now."""
    _, cap, _, _, legacy = rule
    outside, crossings, trains, kept = out
    for j in range(pixels.size):
        count = table[COUNT + j]
        outside[kept], crossings[kept] = pixels[j], int(count)
        trains[0, kept], trains[1, kept] = table[START + j], table[STRIDE + j]
        if legacy:
            trains[0, kept], trains[1, kept] = 0.0, interval / min(abs(count), float(cap))
        kept += count != 0.0
    return kept


@numba.njit(cache=True, error_model="numpy")
def _keep_with_dead_time(pixels, times, refractory_us, held, table, out):
    """Append the pixels that fire or end a dead time to the kept ones; return how many these are now."""
    outside, crossings, trains, kept = out
    for j in range(pixels.size):
        i = pixels[j]
        if held[i] < times[1]:
            pixel = (table[j], table[AFTER + j], table[MEMORY + j], table[ON + j], table[OFF + j])
            n, start, stride, remembered, keep = train_with_dead_time(pixel, times, held[i], refractory_us)
            if keep:
                outside[kept], crossings[kept] = i, n
                trains[0, kept], trains[1, kept] = start, stride
                trains[2, kept], trains[3, kept], trains[4, kept] = pixel[0], pixel[1], remembered
                kept += 1
    return kept


@numba.njit(cache=True, error_model="numpy")
def _advance(luminance, times, rule, curve, thresholds, state, found):
    """Move the remembered levels and the quiet bands of the pixels that fired or ended a dead time."""
    _, band, level, held = state
    pixels, crossings, sent, trains = found
    refractory_us, _, carries, forgets, _ = rule
    if forgets:
        _look(luminance, curve, thresholds, band, level[0, :0])
        return
    if refractory_us > 0:
        pixels = pixels[: resume(pixels, crossings, trains, times, refractory_us, (band, level, held))]
    else:
        for j in range(pixels.size):
            level[2 - (crossings[j] > 0), pixels[j]] += sent[j] if carries else abs(crossings[j])
    _, levels, work = _block(pixels.size)
    for first in range(0, pixels.size, BLOCK):
        block = pixels[first : min(first + BLOCK, pixels.size)]
        for j in range(block.size):
            k = block[j] if thresholds.shape[1] > 1 else 0
            levels[j] = _level(level, block[j], thresholds[0, k], thresholds[1, k])
        _set_bands(block, levels, curve, thresholds, band, work)
