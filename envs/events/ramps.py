"""Events of a column camera, which looks at the columns of an image separately, each at its own times.

Images are stored column after column: pixel x, y of an image of H rows is number x * H + y.

Between two looks the light of a pixel is taken as linear in time. This is exact while an edge moves
through the pixel at constant speed, because a pixel sees the mean over its area. The response to
light is then not linear, so the time of each crossing is computed from the light: it is the time at
which the light reaches the value that belongs to the crossed level.
With photoreceptors of limited bandwidth (`envs.events.lowpass`) the response follows an exponential
through its values at the last look, half-way and now.

The crossed levels are found as in `envs.events.crossings`, for a camera with memory "reference"
and no refractory period.
"""

from typing import NamedTuple

import numba
import numpy as np

from envs.compiled import kernel
from envs.config import CameraConfig
from envs.events.camera import EventCamera
from envs.events.crossings import (
    BLOCK,
    Memory,
    Model,
    Room,
    count_crossings,
    first_invalid,
    level_of,
    remember,
    respond_at,
    scan,
    set_quiet_bands,
)
from envs.events.emission import EVENT, MAX_EVENTS_PER_FRAME, sorted_events
from envs.events.lowpass import ColumnFilter, column_filter, filter_columns, start_columns
from envs.events.photoreceptor import Curve, light_of, natural_logarithm
from envs.events.refractory import TOLERANCE

STRAIGHT, STEEPEST = 1e-3, 1e6  # ratio of a ramp's halves: straight within 1 +- STRAIGHT; limited to STEEPEST


class Ramps(NamedTuple):
    """The changes in firing pixels from one look to the next: of luminance, or of the filtered response.

    Attributes:
        pixels: Numbers of the pixels, int64.
        columns: Columns of the pixels, int64.
        crossings: Number of levels crossed, negative if downwards, int64.
        sent: Number of crossings that become events, int64.
        level, stride: The first level crossed, and the distance from one level to the next, float64.
        base: Luminance at the first look, or the response if it is filtered, float64.
        pace: Time that a change of `base` by 1 takes [us]; 0: all events are due at once, float64.
        ratio: Change in the second half of the time over the change in the first half; 1: the ramp is
            a line, otherwise an exponential, float64.
        start_us: Time of the first look, int64.
        length_us: Time between the looks, int64.
    """

    pixels: np.ndarray
    columns: np.ndarray
    crossings: np.ndarray
    sent: np.ndarray
    level: np.ndarray
    stride: np.ndarray
    base: np.ndarray
    pace: np.ndarray
    ratio: np.ndarray
    start_us: np.ndarray
    length_us: np.ndarray


class Watch(NamedTuple):
    """A column camera, in the form that kernels take.

    Attributes:
        model: `Model`.
        memory: `Memory` of all pixels.
        seen_us: int64 (W,), time of the last look at each column [us].
        scratch: The scratch of `crossings.steps`.
        ramps: Room for the `Ramps` between two renders.
        room: `Room` for a block of pixels.
        bandwidth: Low-pass filter of the photoreceptors.
    """

    model: Model
    memory: Memory
    seen_us: np.ndarray
    scratch: tuple
    ramps: Ramps
    room: Room
    bandwidth: ColumnFilter


def make_ramps(size: int) -> Ramps:
    """Allocate room for `size` ramps."""
    whole, real = np.empty((6, size), np.int64), np.empty((5, size))
    return Ramps(*whole[:4], *real, *whole[4:])


def can_look(camera: CameraConfig) -> bool:
    """Whether this file can simulate a camera with these settings; other cameras need whole images."""
    events = camera.width * camera.height * camera.max_events_per_pixel
    exact = camera.encoding == "linear32" and camera.refractory_us == 0
    return camera.memory == "reference" and exact and events <= MAX_EVENTS_PER_FRAME


class ColumnCamera:
    """An event camera that looks at single columns, with the model and memory of an `EventCamera`.

    Attributes:
        state: Model, memory and scratch as in `EventCamera`, but with pixels numbered as in this file.
        bandwidth: Low-pass filter of the photoreceptors, `ColumnFilter`.
    """

    def __init__(self, config: CameraConfig) -> None:
        """Create the camera; requires `can_look(config)`."""
        (rule, curve, limits), memory, scratch = EventCamera(config).state
        self._shape = config.height, config.width
        if limits.shape[1] > 1:
            limits = limits.reshape(-1, *self._shape).swapaxes(1, 2).reshape(limits.shape)
        self.state = (rule, curve, limits), memory, scratch
        self.bandwidth = column_filter(config)

    @property
    def pixels(self) -> np.ndarray:
        """Return the flat pixel y * W + x of each pixel of the memory, int64 (W * H,)."""
        return np.arange(self._shape[0] * self._shape[1]).reshape(self._shape).T.ravel()

    @property
    def last_frame(self) -> np.ndarray:
        """Return the last frame before any filter, float32 (H, W); not a copy."""
        limited = self.bandwidth.seen.size > 0
        frame: np.ndarray = self.bandwidth.pixels.light if limited else self.state[1][0][0]
        return frame.reshape(self._shape[::-1]).T

    def reset(self, luminance: np.ndarray) -> None:
        """Remember a valid first frame, float32 (H, W); it gives no events."""
        flat = luminance.T.ravel()
        if self.bandwidth.seen.size:
            start_columns(flat, Curve(*self.state[0][1]), self.bandwidth)
        remember(flat, *self.state[:2])


@kernel
def look_at(image, first, last, t_us, watch, kept):
    """Look at columns `first` .. `last` - 1 of an image: store the ramps of their firing pixels.

    Args:
        image: float32 (W, H), linear luminance, column after column.
        first: The first column.
        last: The column after the last.
        t_us: The time [us], later than the last look at each of these columns.
        watch: `Watch`, whose memory is updated; its ramps have room for these pixels.
        kept: Number of ramps in use.

    Returns:
        First invalid pixel or -1, number of ramps in use, and number of events lost.
    """
    flat, scratch = image.reshape(image.size), watch.scratch
    flags, outside = scratch
    model, memory, ramps = watch.model, watch.memory, watch.ramps
    begin, end = first * image.shape[1], last * image.shape[1]
    if watch.bandwidth.seen.size > 0:
        bad = first_invalid(flat[begin:end])
        if bad >= 0:
            return begin + bad, kept, 0
        filter_columns(flat, first, last, t_us, watch.seen_us, model.curve, watch.bandwidth, scratch)
        flat = watch.bandwidth.seen
    seen, past = flat[begin:end], memory.previous[begin:end]
    found = scan(seen, begin, model, memory, flags, outside)
    begun, room = kept, watch.room
    for start in range(0, found, BLOCK):
        pixels = outside[start : min(start + BLOCK, found)]
        bad = respond_at(pixels, flat, model.curve, room.after, room)
        if bad >= 0:
            return bad, begun, 0
        respond_at(pixels, memory.previous, model.curve, room.before, room)
        _recall(pixels, model.thresholds, memory, room.levels)
        kept = _keep(pixels, flat, t_us, watch, kept)
    lost = _lost(begun, kept, ramps)
    _advance(begun, kept, watch)
    for i in range(seen.size):  # from 0, or numba would check each index for being negative
        past[i] = seen[i]
    for column in range(first, last):
        watch.seen_us[column] = t_us
    return -1, kept, 0 if model.rule.carries else lost


@kernel
def _lost(begun, kept, ramps):
    """Count the crossings of the newest ramps that send no event."""
    lost = 0
    for j in range(begun, kept):
        lost += abs(ramps.crossings[j]) - ramps.sent[j]
    return lost


@kernel
def _recall(pixels, thresholds, memory, levels):
    """Write the remembered levels of `pixels`, in a loop without branches, so that memory reads overlap."""
    for j in range(pixels.size):
        k = pixels[j] if thresholds.on.size > 1 else 0
        levels[j] = level_of(memory, pixels[j], thresholds.on[k], thresholds.off[k])


@kernel
def _keep(pixels, flat, t_us, watch, kept):
    """Append the ramps of the pixels that fire; return the new number of ramps."""
    rule, thresholds = watch.model.rule, watch.model.thresholds
    memory, seen_us, ramps, room = watch.memory, watch.seen_us, watch.ramps, watch.room
    height = flat.size // seen_us.size
    column = pixels[0] // height
    for j in range(pixels.size):
        i = pixels[j]
        while i >= (column + 1) * height:
            column += 1
        k = i if thresholds.on.size > 1 else 0
        on, off = thresholds.on[k], thresholds.off[k]
        remembered, way = room.levels[j], room.after[j] - room.before[j]
        change = room.after[j] - remembered
        step = on if change > 0.0 else -off
        count = np.int64((abs(change) + TOLERANCE) / abs(step))
        if count == 0 or not (rule.carries or way != 0.0):
            continue
        length_us = t_us - seen_us[column]
        light, sign = np.float64(memory.previous[i]), np.int64(1) if change > 0.0 else np.int64(-1)
        ramps.pixels[kept], ramps.columns[kept] = i, column
        ramps.crossings[kept], ramps.sent[kept] = sign * count, min(count, rule.max_events)
        ramps.level[kept], ramps.stride[kept], ramps.base[kept] = remembered + step, step, light
        ramps.pace[kept] = length_us / (np.float64(flat[i]) - light) if way * change > 0.0 else 0.0
        ramps.start_us[kept], ramps.length_us[kept] = t_us - length_us, length_us
        if watch.bandwidth.seen.size > 0:
            _bend(kept, room.before[j], watch.bandwidth.half[i], room.after[j], ramps)
        kept += 1
    return kept


@kernel
def _bend(k, before, half, after, ramps):
    """Set ramp `k` to go through three responses, equally spaced in time.

    If both halves change in the same direction, the ramp is an exponential. Otherwise the levels are crossed
    evenly, in the half that changes in the direction of the whole.
    """
    first, second, length = half - before, after - half, ramps.length_us[k]
    ramps.base[k], ramps.ratio[k] = before, 1.0
    if ramps.pace[k] == 0.0:
        return
    if first * second > 0.0:
        ramps.pace[k], ramps.ratio[k] = length / (after - before), second / first
    elif first * (after - before) > 0.0:
        ramps.pace[k] = 0.5 * length / first
    elif (ramps.level[k] - before) * (after - before) <= 0.0:  # a crossing was due before the first look
        ramps.pace[k] = length / (after - before)
    else:
        ramps.base[k], ramps.pace[k] = half, 0.5 * length / second
        ramps.start_us[k] += length // 2
        ramps.length_us[k] = length - length // 2


@kernel
def _advance(begun, kept, watch):
    """Update the remembered levels and quiet bands of the pixels of the newest ramps."""
    model, memory, ramps, levels = watch.model, watch.memory, watch.ramps, watch.room.levels
    thresholds = model.thresholds
    for begin in range(begun, kept, BLOCK):
        pixels = ramps.pixels[begin : min(begin + BLOCK, kept)]
        for j in range(pixels.size):
            i, n = pixels[j], ramps.crossings[begin + j]
            crossed = ramps.sent[begin + j] if model.rule.carries else abs(n)
            k = i if thresholds.on.size > 1 else 0
            levels[j] = count_crossings(memory, i, crossed, n > 0, thresholds.on[k], thresholds.off[k])
        set_quiet_bands(pixels, levels, model, memory, watch.room)


@numba.njit(cache=True, error_model="numpy")
def events_of_ramps(watch, kept, span):
    """Return the EVENT array of the ramps, sorted by (t, y, x, order in the pixel).

    Args:
        watch: `Watch`, in which the ramps of each pixel are in the order of time.
        kept: Number of ramps in use.
        span: `Span` that contains the ramps.
    """
    ramps, height = watch.ramps, watch.memory.previous.size // watch.seen_us.size
    order, total = _row_after_row(ramps, kept, height), ramps.sent[:kept].sum()
    after, times, places = np.empty(total), np.empty(total, np.int64), np.empty(total, np.uint32)
    event = 0
    for j in order:
        for k in range(ramps.sent[j]):
            after[event] = ramps.level[j] + k * ramps.stride[j]
            event += 1
    if watch.bandwidth.seen.size > 0:
        _straighten(ramps, order, after)
    else:
        light_of(watch.model.curve, after, np.empty(total, np.int64))
    event = 0
    for j in order:
        x = ramps.columns[j]
        place = np.uint32(((ramps.pixels[j] - x * height) << 13) | (x << 1) | (ramps.crossings[j] > 0))
        start, length = ramps.start_us[j] - span.start_us, np.float64(ramps.length_us[j])
        for _ in range(ramps.sent[j]):
            late = np.rint((after[event] - ramps.base[j]) * ramps.pace[j])
            times[event] = start + np.int64(min(max(late, 1.0), length))
            places[event] = place
            event += 1
    events = sorted_events(times, places, span)
    _order_ties(events)
    return events


@numba.njit(cache=True, error_model="numpy")
def _straighten(ramps, order, levels):
    """Replace the levels of exponential ramps by the levels that a line would cross at the same times."""
    ratios, bent, event = np.empty(order.size), np.ones(levels.size), 0
    for place, j in enumerate(order):
        ratio = min(max(ramps.ratio[j], 1.0 / STEEPEST), STEEPEST)
        ratios[place] = ratio if abs(ratio - 1.0) > STRAIGHT else 1.0
        share = ramps.pace[j] / ramps.length_us[j] * (ratios[place] * ratios[place] - 1.0)
        for _ in range(ramps.sent[j]):
            bent[event] = max(1.0 + (levels[event] - ramps.base[j]) * share, 1.0 / STEEPEST**2)
            event += 1
    natural_logarithm(bent, np.empty(levels.size, np.int64))
    natural_logarithm(ratios, np.empty(order.size, np.int64))
    event = 0
    for place, j in enumerate(order):
        for _ in range(ramps.sent[j]):
            if ratios[place] != 0.0:
                late = 0.5 * ramps.length_us[j] * bent[event] / ratios[place]
                levels[event] = ramps.base[j] + late / ramps.pace[j]
            event += 1


@numba.njit(cache=True, error_model="numpy")
def _row_after_row(ramps, kept, height):
    """Return indices of the ramps, int64 (N,), ordered by image row; ramps of a row keep their order."""
    starts, order = np.zeros(height + 1, np.int64), np.empty(kept, np.int64)
    for j in range(kept):
        starts[ramps.pixels[j] - ramps.columns[j] * height + 1] += 1
    for row in range(height):
        starts[row + 1] += starts[row]
    for j in range(kept):
        row = ramps.pixels[j] - ramps.columns[j] * height
        order[starts[row]] = j
        starts[row] += 1
    return order


@numba.njit(cache=True, error_model="numpy")
def _order_ties(events):
    """Sort events of the same microsecond by (y, x); they come as few sorted runs, one per look."""
    moved = np.empty(1, EVENT)
    for i in range(1, events.size):
        j = i
        while j > 0 and _is_after(events[j - 1], events[i]):
            j -= 1
        if j < i:
            moved[0] = events[i]
            for k in range(i, j, -1):
                events[k] = events[k - 1]
            events[j] = moved[0]


@numba.njit(cache=True, error_model="numpy", inline="always")
def _is_after(one, other):
    """Whether two events have the same time and `one` sorts after `other` by (y, x)."""
    if one.t != other.t:
        return False
    return one.y > other.y or (one.y == other.y and one.x > other.x)
