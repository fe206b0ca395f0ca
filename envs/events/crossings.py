"""The event camera's kernels: which pixels crossed which levels between two frames, and when.

A pixel whose luminance stays within its quiet band cannot fire, and costs two comparisons. The
band is kept in linear luminance and lies inside [0, largest float32], so anything that is not a
luminance falls outside it as well. Pixels outside their band are decided in float64, in blocks,
so that their logarithms are computed in wide instructions.

`EventCamera` hands over `model` and `memory` as plain tuples of few arrays, which numba reads faster
than named ones; `steps` and `remember` name them. Input is valid, except that `steps` and `first_invalid`
look for values that are not luminances.
"""

from enum import IntEnum
from typing import NamedTuple

import numba
import numpy as np

from envs.compiled import inlined, kernel
from envs.events.emission import EVENT, Span, Trains, events_of, limit_events
from envs.events.photoreceptor import MAX_LUMINANCE, Curve, light_of, respond
from envs.events.refractory import (
    TOLERANCE,
    Motions,
    Pixel,
    start_refractory_periods,
    train_after_refractory_period,
)

MARGIN = 1e-9  # relative; far above the error of float64 exp
HALF_ULP = 2.0**-23  # relative; above the rounding of a bound to float32
BLOCK = 1024  # pixels decided together


class Rule(NamedTuple):
    """How a pixel fires.

    Attributes:
        refractory_us: Refractory period after an event [us]; 0: none.
        max_events: Most events of one pixel in one frame.
        carries: Events beyond the most fire in later frames; otherwise they are lost.
        forgets: The remembered level is the last frame's.
        legacy: Events are counted and timed as in the paper's published code.
    """

    refractory_us: int
    max_events: int
    carries: bool
    forgets: bool
    legacy: bool


class Thresholds(NamedTuple):
    """Thresholds of all pixels, float64 (N,), or of one that stands for all, (1,).

    Attributes:
        on, off: Change of the response that fires an event.
        quiet_up, quiet_down: Change up to which a pixel cannot fire, rounding allowed for.
    """

    on: np.ndarray
    off: np.ndarray
    quiet_up: np.ndarray
    quiet_down: np.ndarray


class Model(NamedTuple):
    """What all pixels have in common, fixed for a camera."""

    rule: Rule
    curve: Curve
    thresholds: Thresholds


class Memory(NamedTuple):
    """What the N pixels remember; changed in place.

    The remembered level is `first_level` + `on_count` thresholds - `off_count` thresholds: a
    count, unlike a sum, does not drift.

    Attributes:
        previous: Last frame, float32.
        quiet_low, quiet_high: Quiet band of luminance, both ends included, float32.
        first_level: Response at the first frame, or after the last refractory period, float64.
        on_count, off_count: Thresholds crossed since, float64.
        refractory_end_us: End of the last refractory period, int64; of length 0 without any.
    """

    previous: np.ndarray
    quiet_low: np.ndarray
    quiet_high: np.ndarray
    first_level: np.ndarray
    on_count: np.ndarray
    off_count: np.ndarray
    refractory_end_us: np.ndarray


class Room(NamedTuple):
    """Room for a block of pixels, (BLOCK,) each: float64, but `exponents` int64 and `lights` float32."""

    before: np.ndarray
    after: np.ndarray
    low: np.ndarray
    high: np.ndarray
    levels: np.ndarray
    exponents: np.ndarray
    lights: np.ndarray


class Column(IntEnum):
    """Where each column begins in the table of a block, float64 (8 * BLOCK,).

    One flat array with constant distances, because LLVM then knows that the columns do not
    overlap, and compiles the loops over them to wide instructions.
    """

    BEFORE = 0  # response at the last frame
    AFTER = BLOCK  # response at this frame
    REMEMBERED = 2 * BLOCK  # remembered level
    ON = 3 * BLOCK  # threshold
    OFF = 4 * BLOCK  # threshold
    COUNT = 5 * BLOCK  # levels crossed, negative if downwards
    START = 6 * BLOCK  # time of the first event after the last frame [us]
    STRIDE = 7 * BLOCK  # time from one event to the next [us]


def threshold_rows(on: np.ndarray, off: np.ndarray, reach: int) -> np.ndarray:
    """Rows of `Thresholds`, float64 (4, N) or (4, 1).

    Args:
        on: ON thresholds, float64 (N,) or (1,).
        off: OFF thresholds, as many.
        reach: Thresholds to the first event: 1, or 2 where the first is lost ("legacy").
    """
    return np.stack((on, off, reach * on - TOLERANCE - MARGIN, reach * off - TOLERANCE - MARGIN))


def memory_rows(num_pixels: int, has_refractory_period: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of a `Memory`, to be set by `remember`: float32 (3, N), float64 (3, N), and the last one."""
    ends = np.zeros(num_pixels if has_refractory_period else 0, np.int64)
    return np.zeros((3, num_pixels), np.float32), np.zeros((3, num_pixels)), ends


@numba.njit(cache=True, error_model="numpy")
def make_room():
    """Room for the blocks of one step."""
    rows = np.empty((5, BLOCK))
    numbers, lights = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.float32)
    return Room(rows[0], rows[1], rows[2], rows[3], rows[4], numbers, lights)


@numba.njit(cache=True, error_model="numpy", inline="always")
def named(model, memory):
    """The model and the memory, with names."""
    rule, curve, limits = model
    lights, levels, ends = memory
    return (
        Model(Rule(*rule), Curve(*curve), Thresholds(limits[0], limits[1], limits[2], limits[3])),
        Memory(lights[0], lights[1], lights[2], levels[0], levels[1], levels[2], ends),
    )


@numba.njit(cache=True, error_model="numpy")
def first_invalid(luminance):
    """Index of the first value that is not finite and >= 0, or -1."""
    valid = True
    for i in range(luminance.size):  # without a branch: it compiles to wide instructions
        valid &= (luminance[i] >= 0.0) & (luminance[i] <= MAX_LUMINANCE)
    if valid:
        return -1
    for i in range(luminance.size):
        if not 0.0 <= luminance[i] <= MAX_LUMINANCE:
            return i
    return -1


@numba.njit(cache=True, error_model="numpy")
def remember(luminance, model, memory):
    """Start all memories from one frame, float32 (N,)."""
    model, memory = named(model, memory)
    memory.previous[:] = luminance
    memory.on_count[:] = 0.0
    memory.off_count[:] = 0.0
    memory.refractory_end_us[:] = np.iinfo(np.int64).min
    _remember_levels(luminance, model, memory)


@numba.njit(cache=True, error_model="numpy")
def _remember_levels(luminance, model, memory):
    """Take the responses of all pixels as their first levels, and set the quiet bands around them."""
    room = make_room()
    for first in range(0, luminance.size, BLOCK):
        pixels = np.arange(first, min(first + BLOCK, luminance.size))
        levels = memory.first_level[first : first + pixels.size]
        respond(model.curve, luminance[first : first + pixels.size], levels, room.exponents)
        set_quiet_bands(pixels, levels, model, memory, room)


@kernel
def set_quiet_bands(pixels, levels, model, memory, room):
    """Quiet bands of at most BLOCK `pixels` that remember `levels`."""
    low, high, thresholds = room.low[: pixels.size], room.high[: pixels.size], model.thresholds
    for j in range(pixels.size):
        k = pixels[j] if thresholds.on.size > 1 else 0
        low[j], high[j] = levels[j] - thresholds.quiet_down[k], levels[j] + thresholds.quiet_up[k]
    light_of(model.curve, low, room.exponents)
    light_of(model.curve, high, room.exponents)
    for j in range(pixels.size):
        memory.quiet_low[pixels[j]] = _bound(low[j], 1.0 + HALF_ULP)
        memory.quiet_high[pixels[j]] = _bound(high[j], 1.0 - HALF_ULP)


@inlined
def _bound(value, inwards):
    """A bound of the quiet band as float32, never further out than `value` and never invalid."""
    return np.float32(min(max(value * inwards, 0.0), MAX_LUMINANCE))


@numba.njit(cache=True, error_model="numpy")
def steps(frames, times_us, width, limit, model, memory, scratch):
    """Events of several frames, one after the other; nothing changes if a value is no luminance.

    Args:
        frames: float32 (K, N).
        times_us: int64 (K + 1,), of the frame before them and theirs, increasing [us].
        width: Pixels of a row.
        limit: Most events of one frame, of all pixels together.
        model: Values of a `Model`: those of `Rule`, those of `Curve`, and `threshold_rows`.
        memory: As `memory_rows`.
        scratch: One flag a pixel, uint64 (ceil(N / 8),), and room for pixels, int64 (8 ceil(N / 8),).

    Returns:
        Index of the first invalid value in the flat frames, or -1; the number of events lost;
        EVENT array, sorted by (t, y, x, order in the pixel).
    """
    model, memory = named(model, memory)
    bad = first_invalid(frames.ravel()) if len(frames) > 1 else -1
    if bad >= 0:
        return bad, 0, np.empty(0, EVENT)
    batches, dropped, total = [], 0, 0
    for k in range(len(frames)):
        span = Span(times_us[k], times_us[k + 1])
        bad, lost, events = _step(frames[k], span, width, limit, model, memory, scratch)
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
def _step(luminance, span, width, limit, model, memory, scratch):
    """One frame: (first invalid pixel or -1, events lost, events)."""
    flags, outside = scratch
    found = scan(luminance, memory.quiet_low, memory.quiet_high, flags, outside)
    counts, times = np.empty((2, found), np.int64), np.empty((2, found))
    responses = np.empty((3, found if model.rule.refractory_us > 0 else 0))
    motions = Motions(responses[0], responses[1], responses[2])
    trains = Trains(outside, counts[0], counts[1], times[0], times[1])
    bad, kept = _decide(luminance, span, model, memory, trains, motions)
    if bad >= 0:
        return bad, 0, np.empty(0, EVENT)
    trains = Trains(outside[:kept], counts[0], counts[1, :kept], times[0], times[1])
    wanted = 0
    for j in range(kept):
        wanted += abs(trains.crossings[j])
        trains.sent[j] = min(abs(trains.crossings[j]), model.rule.max_events)
    total = limit_events(trains, span, limit)
    events = events_of(trains, span, width, total)
    _advance(luminance, span, model, memory, trains, motions)
    memory.previous[:] = luminance
    return -1, 0 if model.rule.carries else wanted - total, events


@kernel
def scan(luminance, low, high, flags, outside):
    """Write the pixels outside their quiet band `low` .. `high`, in their order; return how many.

    The first loop has no branch, so that it compiles to wide instructions; the second looks
    at eight flags at a time.
    """
    flag, found, words = flags.view(np.uint8), 0, (luminance.size + 7) // 8
    for i in range(luminance.size):
        flag[i] = not ((luminance[i] >= low[i]) & (luminance[i] <= high[i]))
    for i in range(luminance.size, 8 * words):
        flag[i] = False
    for word in range(words):
        if flags[word] != 0:
            for i in range(8 * word, 8 * word + 8):
                outside[found] = i
                found += flag[i]
    return found


@numba.njit(cache=True, error_model="numpy")
def _decide(luminance, span, model, memory, trains, motions):
    """Keep, of the pixels outside their band, those that fire or end a refractory period.

    Returns:
        First invalid pixel or -1, and the number of trains kept.
    """
    table, room, kept = np.empty(8 * BLOCK), make_room(), 0
    for first in range(0, trains.crossings.size, BLOCK):
        pixels = trains.pixels[first : min(first + BLOCK, trains.crossings.size)]
        bad = respond_at(pixels, luminance, model.curve, table[Column.AFTER :], room)
        if bad >= 0:
            return bad, 0
        respond_at(pixels, memory.previous, model.curve, table, room)
        _recall(pixels, model, memory, table)
        if model.rule.refractory_us > 0:
            kept = _keep_refractory(pixels, span, model.rule, memory, table, trains, motions, kept)
        else:
            _compare(pixels.size, span, model.rule, table)
            kept = _keep(pixels, span, model.rule, table, trains, kept)
    return -1, kept


@kernel
def respond_at(pixels, luminance, curve, levels, room):
    """Write the responses to the luminance of `pixels`; the first pixel with an invalid one, or -1."""
    lights = room.lights
    for j in range(pixels.size):
        lights[j] = luminance[pixels[j]]
        if not 0.0 <= lights[j] <= MAX_LUMINANCE:
            return pixels[j]
    respond(curve, lights[: pixels.size], levels, room.exponents)
    return -1


@numba.njit(cache=True, error_model="numpy")
def _recall(pixels, model, memory, table):
    """Fill in the block's thresholds and remembered levels."""
    thresholds = model.thresholds
    for j in range(pixels.size):
        k = pixels[j] if thresholds.on.size > 1 else 0
        on, off = thresholds.on[k], thresholds.off[k]
        table[Column.ON + j], table[Column.OFF + j] = on, off
        level = table[Column.BEFORE + j] if model.rule.forgets else level_of(memory, pixels[j], on, off)
        table[Column.REMEMBERED + j] = level


@inlined
def level_of(memory, i, on, off):
    """Remembered level; equal thresholds multiply the exact net count once."""
    if on == off:
        return memory.first_level[i] + (memory.on_count[i] - memory.off_count[i]) * on
    return memory.first_level[i] + memory.on_count[i] * on - memory.off_count[i] * off


@numba.njit(cache=True, error_model="numpy")
def _compare(size, span, rule, table):
    """Fill in the block's counts, starts and strides, without branches.

    A still pixel fires only what it carries over. A level reached before this frame is due at
    once: its pixel may by now move the other way, which gives pace 0.
    """
    interval = span.end_us - span.start_us
    for j in range(size):
        before, remembered = table[Column.BEFORE + j], table[Column.REMEMBERED + j]
        way, change = table[Column.AFTER + j] - before, table[Column.AFTER + j] - remembered
        step = table[Column.ON + j] if change > 0.0 else -table[Column.OFF + j]
        count = max(np.floor((abs(change) + TOLERANCE) / abs(step)) - rule.legacy, 0.0)
        count = count if rule.carries | (way != 0.0) else 0.0
        table[Column.COUNT + j] = np.copysign(count, change)
        pace = interval / way
        pace = pace if way * change > 0.0 else 0.0
        table[Column.START + j] = (remembered + step - before) * pace
        table[Column.STRIDE + j] = step * pace


@numba.njit(cache=True, error_model="numpy")
def _keep(pixels, span, rule, table, trains, kept):
    """Append the trains of the pixels that fire; return how many trains there are now."""
    for j in range(pixels.size):
        count = table[Column.COUNT + j]
        trains.pixels[kept], trains.crossings[kept] = pixels[j], int(count)
        trains.start[kept], trains.stride[kept] = table[Column.START + j], table[Column.STRIDE + j]
        if rule.legacy:
            interval = span.end_us - span.start_us
            trains.start[kept], trains.stride[kept] = 0.0, interval / min(abs(count), float(rule.max_events))
        kept += count != 0.0
    return kept


@numba.njit(cache=True, error_model="numpy")
def _keep_refractory(pixels, span, rule, memory, table, trains, motions, kept):
    """Append the trains of the pixels that fire or end a refractory period; return how many there are."""
    for j in range(pixels.size):
        i = pixels[j]
        end_us = memory.refractory_end_us[i]
        if end_us < span.end_us:
            before, after = table[Column.BEFORE + j], table[Column.AFTER + j]
            on, off = table[Column.ON + j], table[Column.OFF + j]
            pixel = Pixel(before, after, table[Column.REMEMBERED + j], on, off, end_us)
            n, start, stride, level, keep = train_after_refractory_period(pixel, span, rule.refractory_us)
            if keep:
                trains.pixels[kept], trains.crossings[kept] = i, n
                trains.start[kept], trains.stride[kept] = start, stride
                motions.before[kept], motions.after[kept] = before, after
                motions.remembered[kept] = level
                kept += 1
    return kept


@numba.njit(cache=True, error_model="numpy")
def _advance(luminance, span, model, memory, trains, motions):
    """Move remembered levels and quiet bands of pixels that fired or ended a refractory period."""
    rule, thresholds, pixels = model.rule, model.thresholds, trains.pixels
    if rule.forgets:
        _remember_levels(luminance, model, memory)
        return
    if rule.refractory_us > 0:
        pixels = pixels[: start_refractory_periods(trains, motions, span, rule.refractory_us, memory)]
    else:
        for j in range(pixels.size):
            crossed = trains.sent[j] if rule.carries else abs(trains.crossings[j])
            if trains.crossings[j] > 0:
                memory.on_count[pixels[j]] += crossed
            else:
                memory.off_count[pixels[j]] += crossed
    room = make_room()
    levels = room.levels
    for first in range(0, pixels.size, BLOCK):
        block = pixels[first : min(first + BLOCK, pixels.size)]
        for j in range(block.size):
            k = block[j] if thresholds.on.size > 1 else 0
            levels[j] = level_of(memory, block[j], thresholds.on[k], thresholds.off[k])
        set_quiet_bands(block, levels, model, memory, room)
