"""Events of pixels that are looked at column by column, each column at times of its own.

Between two looks the light of a pixel is taken as linear in time. So it is where an edge moves
through the pixel at constant speed, because a pixel sees the mean over its area. The response to
light then is not linear, and each crossing has a time of its own: when the light is what the
crossed level responds to.

Which levels are crossed is decided as in `envs.events.crossings`, for a camera that remembers
("reference") and has no refractory period.
"""

from typing import NamedTuple

import numba
import numpy as np

from envs.compiled import kernel
from envs.config import CameraConfig
from envs.events.crossings import BLOCK, Memory, Model, Room, level_of, respond_at, scan, set_quiet_bands
from envs.events.emission import EVENT, MAX_EVENTS_PER_FRAME, sorted_events
from envs.events.photoreceptor import light_of
from envs.events.refractory import TOLERANCE


class Ramps(NamedTuple):
    """Light of pixels that fire, from one look at each to the next.

    Attributes:
        pixels: Flat indices, int64.
        crossings: Levels crossed, negative if downwards, int64.
        sent: How many of them become events, int64.
        level, stride: The first level crossed, and from one to the next, float64.
        light: Luminance at the first look, float64.
        pace: Time that a change of luminance by 1 takes [us]; 0: all is due at once, float64.
        start_us: Time of the first look, int64.
        length_us: Time between the looks, int64.
    """

    pixels: np.ndarray
    crossings: np.ndarray
    sent: np.ndarray
    level: np.ndarray
    stride: np.ndarray
    light: np.ndarray
    pace: np.ndarray
    start_us: np.ndarray
    length_us: np.ndarray


class Watch(NamedTuple):
    """A camera that is looked through column by column.

    Attributes:
        model: `Model`.
        memory: `Memory` of all pixels.
        seen_us: int64 (W,), when each column was looked at last [us].
        scratch: As `crossings.steps` takes it.
        ramps: Room for the `Ramps` between two renders.
        room: `Room` for a block of pixels.
    """

    model: Model
    memory: Memory
    seen_us: np.ndarray
    scratch: tuple
    ramps: Ramps
    room: Room


def make_ramps(size: int) -> Ramps:
    """Room for `size` ramps."""
    whole, real = np.empty((5, size), np.int64), np.empty((4, size))
    return Ramps(whole[0], whole[1], whole[2], real[0], real[1], real[2], real[3], whole[3], whole[4])


def can_look(camera: CameraConfig) -> bool:
    """Whether a camera follows the rules of this file; others need whole images."""
    events = camera.width * camera.height * camera.max_events_per_pixel
    exact = camera.encoding == "linear32" and camera.refractory_us == 0
    return camera.memory == "reference" and exact and events <= MAX_EVENTS_PER_FRAME


@kernel
def look_at(image, first, last, t_us, watch, kept):
    """Look at columns `first` .. `last` - 1 of an image: keep the ramps of their pixels that fire.

    Args:
        image: float32 (H, W), linear luminance.
        first: The first column.
        last: The column after the last.
        t_us: The time [us], later than the last look at each of them.
        watch: `Watch`, which remembers what is seen; its ramps have room for these pixels.
        kept: How many of the ramps are in use.

    Returns:
        First invalid pixel or -1, ramps in use, and events lost.
    """
    flat, (flags, outside) = image.reshape(image.size), watch.scratch
    model, memory, ramps = watch.model, watch.memory, watch.ramps
    whole = last - first == image.shape[1]
    found = (
        scan(flat, memory, flags, outside) if whole else _scan_columns(image, first, last, memory, outside)
    )
    begun, lost, room = kept, 0, watch.room
    for begin in range(0, found, BLOCK):
        pixels = outside[begin : min(begin + BLOCK, found)]
        bad = respond_at(pixels, flat, model.curve, room.after, room)
        if bad >= 0:
            return bad, begun, 0
        respond_at(pixels, memory.previous, model.curve, room.before, room)
        kept = _keep(pixels, flat, t_us, watch, kept)
    for j in range(begun, kept):
        lost += abs(ramps.crossings[j]) - ramps.sent[j]
    _advance(begun, kept, watch)
    _copy_columns(image, first, last, memory.previous)
    for column in range(first, last):
        watch.seen_us[column] = t_us
    return -1, kept, 0 if model.rule.carries else lost


@kernel
def _scan_columns(image, first, last, memory, outside):
    """Write the pixels of some columns outside their quiet band, in raster order; return how many."""
    found = 0
    for row in range(image.shape[0]):
        i = row * image.shape[1] + first
        for column in range(first, last):
            light = image[row, column]
            outside[found] = i
            found += not ((light >= memory.quiet_low[i]) & (light <= memory.quiet_high[i]))
            i += 1
    return found


@kernel
def _copy_columns(image, first, last, previous):
    """Remember some columns of an image."""
    for row in range(image.shape[0]):
        i = row * image.shape[1]
        for column in range(first, last):
            previous[i + column] = image[row, column]


@kernel
def _keep(pixels, flat, t_us, watch, kept):
    """Append the ramps of the pixels that fire; return how many there are now."""
    rule, thresholds = watch.model.rule, watch.model.thresholds
    memory, seen_us, ramps, room = watch.memory, watch.seen_us, watch.ramps, watch.room
    for j in range(pixels.size):
        i = pixels[j]
        k = i if thresholds.on.size > 1 else 0
        on, off = thresholds.on[k], thresholds.off[k]
        remembered, way = level_of(memory, i, on, off), room.after[j] - room.before[j]
        change = room.after[j] - remembered
        step = on if change > 0.0 else -off
        count = np.int64((abs(change) + TOLERANCE) / abs(step))
        if count == 0 or not (rule.carries or way != 0.0):
            continue
        length_us = t_us - seen_us[i % seen_us.size]
        light, sign = np.float64(memory.previous[i]), np.int64(1) if change > 0.0 else np.int64(-1)
        ramps.pixels[kept], ramps.crossings[kept] = i, sign * count
        ramps.sent[kept] = min(count, rule.max_events)
        ramps.level[kept], ramps.stride[kept], ramps.light[kept] = remembered + step, step, light
        ramps.pace[kept] = length_us / (np.float64(flat[i]) - light) if way * change > 0.0 else 0.0
        ramps.start_us[kept], ramps.length_us[kept] = t_us - length_us, length_us
        kept += 1
    return kept


@kernel
def _advance(begun, kept, watch):
    """Move remembered levels and quiet bands of the pixels of the newest ramps."""
    model, memory, ramps, levels = watch.model, watch.memory, watch.ramps, watch.room.levels
    thresholds = model.thresholds
    for begin in range(begun, kept, BLOCK):
        pixels = ramps.pixels[begin : min(begin + BLOCK, kept)]
        for j in range(pixels.size):
            i, crossings = pixels[j], ramps.crossings[begin + j]
            crossed = ramps.sent[begin + j] if model.rule.carries else abs(crossings)
            if crossings > 0:
                memory.on_count[i] += crossed
            else:
                memory.off_count[i] += crossed
            k = i if thresholds.on.size > 1 else 0
            levels[j] = level_of(memory, i, thresholds.on[k], thresholds.off[k])
        set_quiet_bands(pixels, levels, model, memory, watch.room)


@numba.njit(cache=True, error_model="numpy")
def events_of_ramps(watch, kept, span):
    """EVENT array of the ramps, sorted by (t, y, x, order in the pixel).

    Args:
        watch: `Watch`, whose ramps of a pixel are in the order of time.
        kept: How many of the ramps are in use.
        span: `Span` in which they lie.
    """
    ramps, width = watch.ramps, watch.seen_us.size
    total = ramps.sent[:kept].sum()
    lights, times, places = np.empty(total), np.empty(total, np.int64), np.empty(total, np.uint32)
    event = 0
    for j in range(kept):
        for k in range(ramps.sent[j]):
            lights[event] = ramps.level[j] + k * ramps.stride[j]
            event += 1
    light_of(watch.model.curve, lights, np.empty(total, np.int64))
    event = 0
    for j in range(kept):
        y = ramps.pixels[j] // width
        place = np.uint32((y << 13) | ((ramps.pixels[j] - y * width) << 1) | (ramps.crossings[j] > 0))
        start, length = ramps.start_us[j] - span.start_us, np.float64(ramps.length_us[j])
        for _ in range(ramps.sent[j]):
            after = np.rint((lights[event] - ramps.light[j]) * ramps.pace[j])
            times[event] = start + np.int64(min(max(after, 1.0), length))
            places[event] = place
            event += 1
    events = sorted_events(times, places, span)
    _order_ties(events)
    return events


@numba.njit(cache=True, error_model="numpy")
def _order_ties(events):
    """Sort events of the same microsecond by (y, x); they come as few sorted runs, one of each look."""
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
    """Whether an event is to come after another of the same microsecond."""
    if one.t != other.t:
        return False
    return one.y > other.y or (one.y == other.y and one.x > other.x)
