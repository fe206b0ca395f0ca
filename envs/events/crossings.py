"""The event camera's kernels: which pixels crossed which levels between two frames, and when.

A pixel whose luminance stays within its quiet band cannot fire, and costs few operations. The band is
computed in float32 as a share, up and down, of the light that belongs to the remembered level. It is narrower
than the exact band by more than all rounding errors. If each pixel has its own thresholds or noise, both ends
of its band are stored instead. The band lies inside [0, largest float32], so a value that is not a luminance
is outside it too. Pixels outside their band are decided in float64, in blocks, so that their logarithms are
computed in wide instructions.

A frame therefore reads and writes 8 bytes of each pixel (12 if bands are stored), and 16 more of each pixel
outside its band.

`EventCamera` passes `model` and `memory` as plain tuples of few arrays, which numba reads faster than named
tuples; `steps` and `remember` name them. Input is assumed valid, except that `steps` and `first_invalid` look
for values that are not luminances.
"""

from enum import IntEnum
from typing import NamedTuple

import numba
import numpy as np

from envs.compiled import inlined, kernel
from envs.events.emission import EVENT, Span, Trains, concatenated, events_of, limit_events
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
BAND_MARGIN = 2.0**-21  # relative; above the rounding of a band that is computed in float32
MOST_QUIET = 80.0  # change of the response whose factor on the light still fits float32
LEAST_LIGHT = 1e-30  # light of a remembered level below which float32 rounds more coarsely
NEVER_QUIET = np.float32(-np.inf)  # light of a level whose pixel is decided in every frame
MOST_CROSSINGS = 2**30  # one frame adds fewer than 2**27, the whole range of light in smallest thresholds
BLOCK = 1024  # pixels decided together

# The remembered level, read and written only if a pixel is outside its quiet band.
LEVEL = np.dtype([("first_level", "f8"), ("on_count", "i4"), ("off_count", "i4")])


class Rule(NamedTuple):
    """Rule by which a pixel fires.

    Attributes:
        refractory_us: Refractory period after an event [us]; 0: none.
        max_events: Largest number of events of one pixel in one frame.
        carries: Whether events beyond `max_events` fire in later frames; otherwise they are lost.
        forgets: Whether the remembered level is the response at the last frame.
        legacy: Whether events are counted and timed as in the paper's published code.
    """

    refractory_us: int
    max_events: int
    carries: bool
    forgets: bool
    legacy: bool


class Thresholds(NamedTuple):
    """Thresholds of each pixel, float64 (N,), or one for all pixels, (1,).

    Attributes:
        on, off: Change of the response that fires an event.
        quiet_up, quiet_down: Change of the response up to which a pixel cannot fire, less a rounding margin.
        share_up, share_down: The corresponding change of light, as a share of the level's light or of the
            knee, whichever is more; less than exact by more than the rounding of a band in float32.
    """

    on: np.ndarray
    off: np.ndarray
    quiet_up: np.ndarray
    quiet_down: np.ndarray
    share_up: np.ndarray
    share_down: np.ndarray


class Model(NamedTuple):
    """The properties that all pixels share, fixed for a camera."""

    rule: Rule
    curve: Curve
    thresholds: Thresholds


class Memory(NamedTuple):
    """Memory of the N pixels; changed in place.

    The remembered level is `first_level` + `on_count` ON thresholds - `off_count` OFF thresholds. Counts,
    unlike a sum, do not drift. After 2**30 crossings of one pixel (18 minutes at one per microsecond)
    `count_crossings` starts again with a first level that has been rounded once.

    Attributes:
        previous: Last frame, float32.
        level_light: Light of the remembered level, plus the curve's shift, float32; -inf: never quiet.
        quiet_low, quiet_high: Quiet band of luminance, both ends included, float32; set if `is_banded`.
        first_level: Response at the first frame, or after the last refractory period, float64.
        on_count, off_count: Number of thresholds crossed since `first_level`, int32.
        refractory_end_us: End of the last refractory period [us], int64; (0,) without refractory periods.
        is_banded: Whether both ends of the bands are stored instead of `level_light`, bool (1,).
    """

    previous: np.ndarray
    level_light: np.ndarray
    quiet_low: np.ndarray
    quiet_high: np.ndarray
    first_level: np.ndarray
    on_count: np.ndarray
    off_count: np.ndarray
    refractory_end_us: np.ndarray
    is_banded: np.ndarray


class Room(NamedTuple):
    """Room for a block of pixels, (BLOCK,) each: float64, except `exponents` int64 and `lights` float32."""

    before: np.ndarray
    after: np.ndarray
    low: np.ndarray
    high: np.ndarray
    levels: np.ndarray
    exponents: np.ndarray
    lights: np.ndarray


class Column(IntEnum):
    """Start of each column in the table of a block, float64 (8 * BLOCK,).

    The table is one flat array with constant distances. LLVM then knows that the columns do not
    overlap, and compiles the loops over them to wide instructions.
    """

    BEFORE = 0  # response at the last frame
    AFTER = BLOCK  # response at this frame
    REMEMBERED = 2 * BLOCK  # remembered level
    ON = 3 * BLOCK  # threshold
    OFF = 4 * BLOCK  # threshold
    COUNT = 5 * BLOCK  # number of levels crossed, negative if downwards
    START = 6 * BLOCK  # time of the first event after the last frame [us]
    STRIDE = 7 * BLOCK  # time from one event to the next [us]


def threshold_rows(on: np.ndarray, off: np.ndarray, reach: int, curve: Curve) -> np.ndarray:
    """Return the rows of `Thresholds`, float64 (6, N) or (6, 1).

    With the curve "log", a change d of the response multiplies the light by exp(d). The curve "lin_log" is
    nowhere steeper than 1 / max(y, knee) above a light y; below y, it lies above the logarithm and its slope
    is at most 1 / knee.

    Args:
        on: ON thresholds, float64 (N,) or (1,).
        off: OFF thresholds, of the same shape.
        reach: Number of thresholds to the first event: 1, or 2 if the first is lost ("legacy").
        curve: Response curve.
    """
    up, down = reach * on - TOLERANCE - MARGIN, reach * off - TOLERANCE - MARGIN
    most = np.minimum((up, down), MOST_QUIET)
    shares = np.stack((np.expm1(most[0]) if curve.knee == 0.0 else most[0], -np.expm1(-most[1])))
    return np.stack((on, off, up, down, *(shares - BAND_MARGIN * (1.0 + shares))))


def memory_rows(num_pixels: int, has_refractory_period: bool) -> tuple[np.ndarray, ...]:
    """Allocate the arrays of a `Memory`, which `remember` sets: float32 (4, N), LEVEL (N,), the last two."""
    ends = np.zeros(num_pixels if has_refractory_period else 0, np.int64)
    return np.zeros((4, num_pixels), np.float32), np.zeros(num_pixels, LEVEL), ends, np.zeros(1, np.bool_)


@numba.njit(cache=True, error_model="numpy")
def make_room():
    """Allocate room for the blocks of one step."""
    rows = np.empty((5, BLOCK))
    numbers, lights = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.float32)
    return Room(rows[0], rows[1], rows[2], rows[3], rows[4], numbers, lights)


@numba.njit(cache=True, error_model="numpy", inline="always")
def named(model, memory):
    """Return the model and the memory as named tuples."""
    rule, curve, limits = model
    lights, levels, ends, is_banded = memory
    thresholds = Thresholds(limits[0], limits[1], limits[2], limits[3], limits[4], limits[5])
    light, low, high = lights[1], lights[2], lights[3]
    counts = levels.on_count, levels.off_count
    return (
        Model(Rule(*rule), Curve(*curve), thresholds),
        Memory(lights[0], light, low, high, levels.first_level, counts[0], counts[1], ends, is_banded),
    )


@numba.njit(cache=True, error_model="numpy")
def first_invalid(luminance):
    """Return the index of the first value that is not finite and >= 0, or -1."""
    valid = True
    for i in range(luminance.size):  # no branch, so that it compiles to wide instructions
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
    memory.on_count[:] = 0
    memory.off_count[:] = 0
    memory.refractory_end_us[:] = np.iinfo(np.int64).min
    memory.is_banded[0] = model.thresholds.on.size > 1
    _remember_levels(luminance, model, memory)


@numba.njit(cache=True, error_model="numpy")
def _remember_levels(luminance, model, memory):
    """Set the first levels of all pixels to their responses, and the quiet bands around these levels."""
    room = make_room()
    for first in range(0, luminance.size, BLOCK):
        pixels = np.arange(first, min(first + BLOCK, luminance.size))
        levels = room.levels[: pixels.size]
        respond(model.curve, luminance[first : first + pixels.size], levels, room.exponents)
        for j in range(pixels.size):
            memory.first_level[first + j] = levels[j]
        set_quiet_bands(pixels, levels, model, memory, room)


@kernel
def set_quiet_bands(pixels, levels, model, memory, room):
    """Set the quiet bands of at most BLOCK `pixels` that remember `levels`."""
    low, high, thresholds = room.low[: pixels.size], room.high[: pixels.size], model.thresholds
    if not memory.is_banded[0]:
        _set_level_lights(pixels, levels, model.curve, memory, room)
        return
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
    """Return a bound of the quiet band as float32: never farther out than `value`, never invalid."""
    return np.float32(min(max(value * inwards, 0.0), MAX_LUMINANCE))


@inlined
def _set_level_lights(pixels, levels, curve, memory, room):
    """Store the lights that belong to `levels`; `scan` computes the quiet bands from them."""
    lights = room.low[: pixels.size]
    for j in range(pixels.size):
        lights[j] = levels[j]
    light_of(curve, lights, room.exponents)
    for j in range(pixels.size):
        light = lights[j] + curve.shift
        usable = curve.knee > 0.0 or light > LEAST_LIGHT
        memory.level_light[pixels[j]] = np.float32(light) if usable else NEVER_QUIET


@numba.njit(cache=True, error_model="numpy")
def steps(frames, times_us, width, limit, model, memory, scratch):
    """Compute the events of several successive frames; nothing changes if a value is not a luminance.

    Args:
        frames: float32 (K, N).
        times_us: int64 (K + 1,), times of the previous frame and of these frames, increasing [us].
        width: Pixels of a row.
        limit: Largest number of events in one frame, all pixels together.
        model: Values of a `Model`: the fields of `Rule`, the fields of `Curve`, and `threshold_rows`.
        memory: From `memory_rows`.
        scratch: One flag per pixel, uint64 (ceil(N / 8),), and room for pixels, int64 (8 ceil(N / 8),).

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
    return -1, dropped, concatenated(batches, total)


@numba.njit(cache=True, error_model="numpy")
def _step(luminance, span, width, limit, model, memory, scratch):
    """Compute the events of one frame; return first invalid pixel or -1, number of events lost, events."""
    flags, outside = scratch
    found = scan(luminance, 0, model, memory, flags, outside)
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
def scan(luminance, begin, model, memory, flags, outside):
    """Write the pixels outside their quiet band, from pixel `begin` on, in order; return their number.

    The loops over pixels have no branch, so that they compile to wide instructions.
    """
    flag, end = flags.view(np.uint8), begin + luminance.size
    if memory.is_banded[0]:
        low, high = memory.quiet_low[begin:end], memory.quiet_high[begin:end]
        for i in range(luminance.size):
            flag[i] = not ((luminance[i] >= low[i]) & (luminance[i] <= high[i]))
    else:
        light, shift = memory.level_light[begin:end], np.float32(model.curve.shift)
        knee, most = np.float32(model.curve.knee), np.float32(MAX_LUMINANCE)
        up, down = np.float32(model.thresholds.share_up[0]), np.float32(model.thresholds.share_down[0])
        for i in range(luminance.size):
            raised, reach = luminance[i] + shift, max(light[i], knee)
            quiet = (raised >= light[i] - down * reach) & (raised <= min(light[i] + up * reach, most))
            flag[i] = not (quiet & (luminance[i] >= np.float32(0.0)))
    return write_flagged(flags, luminance.size, begin, outside)


@inlined
def write_flagged(flags, size, begin, places):
    """Write `begin` + i for each i < `size` whose flag is set, in order; return the number written.

    Eight flags are tested together, because most are not set.

    Args:
        flags: One flag per byte, uint64 (ceil(size / 8),) or more; cleared from flag `size` on.
        size: Number of flags.
        begin: Offset of the written numbers.
        places: Filled with the numbers, int64, room for eight per word of `flags`.
    """
    flag, found, words = flags.view(np.uint8), 0, (size + 7) // 8
    for i in range(size, 8 * words):
        flag[i] = False
    for word in range(words):
        if flags[word] != 0:
            for i in range(8 * word, 8 * word + 8):
                places[found] = begin + i
                found += flag[i]
    return found


@numba.njit(cache=True, error_model="numpy")
def _decide(luminance, span, model, memory, trains, motions):
    """Find which of the pixels outside their band fire or end a refractory period, and write their trains.

    Returns:
        First invalid pixel or -1, and the number of trains.
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
    """Write the responses of `pixels`; return the first pixel with an invalid luminance, or -1."""
    lights = room.lights
    for j in range(pixels.size):
        lights[j] = luminance[pixels[j]]
        if not 0.0 <= lights[j] <= MAX_LUMINANCE:
            return pixels[j]
    respond(curve, lights[: pixels.size], levels, room.exponents)
    return -1


@numba.njit(cache=True, error_model="numpy")
def _recall(pixels, model, memory, table):
    """Write the block's thresholds and remembered levels into the table."""
    thresholds = model.thresholds
    for j in range(pixels.size):
        k = pixels[j] if thresholds.on.size > 1 else 0
        on, off = thresholds.on[k], thresholds.off[k]
        table[Column.ON + j], table[Column.OFF + j] = on, off
        level = table[Column.BEFORE + j] if model.rule.forgets else level_of(memory, pixels[j], on, off)
        table[Column.REMEMBERED + j] = level


@inlined
def level_of(memory, i, on, off):
    """Return the remembered level; equal thresholds multiply the exact net count, which rounds only once."""
    if on == off:
        return memory.first_level[i] + (memory.on_count[i] - memory.off_count[i]) * on
    return memory.first_level[i] + memory.on_count[i] * on - memory.off_count[i] * off


@inlined
def count_crossings(memory, i, crossed, rises, on, off):
    """Count thresholds that a pixel crossed; return the new remembered level."""
    if rises:
        memory.on_count[i] += crossed
    else:
        memory.off_count[i] += crossed
    level = level_of(memory, i, on, off)
    if max(memory.on_count[i], memory.off_count[i]) > MOST_CROSSINGS:  # the counts must not overflow
        memory.first_level[i], memory.on_count[i], memory.off_count[i] = level, 0, 0
    return level


@numba.njit(cache=True, error_model="numpy")
def _compare(size, span, rule, table):
    """Compute the block's counts, starts and strides, without branches.

    A still pixel fires only events carried over. A level that was reached before this frame is due at
    once; if its pixel now moves in the other direction, the pace is 0.
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
    """Append the trains of the pixels that fire; return the new number of trains."""
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
    """Append the trains of pixels that fire or end a refractory period; return the new number of trains."""
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
    """Update remembered levels and quiet bands of pixels that fired or ended a refractory period."""
    rule, thresholds, pixels = model.rule, model.thresholds, trains.pixels
    if rule.forgets:
        _remember_levels(luminance, model, memory)
        return
    if rule.refractory_us > 0:
        pixels = pixels[: start_refractory_periods(trains, motions, span, rule.refractory_us, memory)]
    room = make_room()
    levels = room.levels
    for first in range(0, pixels.size, BLOCK):
        block = pixels[first : min(first + BLOCK, pixels.size)]
        for j in range(block.size):
            k = block[j] if thresholds.on.size > 1 else 0
            on, off = thresholds.on[k], thresholds.off[k]
            if rule.refractory_us > 0:
                levels[j] = level_of(memory, block[j], on, off)
            else:
                n = trains.crossings[first + j]
                crossed = trains.sent[first + j] if rule.carries else abs(n)
                levels[j] = count_crossings(memory, block[j], crossed, n > 0, on, off)
        set_quiet_bands(block, levels, model, memory, room)
