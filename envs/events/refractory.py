"""The refractory period of a pixel after an event: the events that follow, and the level it restarts from.

Input is assumed valid. `memory` is a `Memory` of `envs.events.crossings`.
"""

from typing import NamedTuple

import numba
import numpy as np

from envs.compiled import inlined
from envs.events.emission import moment

# Uncertainty of the log difference of two luminances rounded to float32. A level this near counts
# as reached, so that a step of exactly k thresholds gives k events.
TOLERANCE = 2.0**-23


class Pixel(NamedTuple):
    """One pixel between two frames.

    Attributes:
        before, after: Responses at the last frame and at this one.
        remembered: Remembered level.
        on, off: Thresholds.
        refractory_end_us: End of the pixel's last refractory period [us].
    """

    before: float
    after: float
    remembered: float
    on: float
    off: float
    refractory_end_us: int


class Motions(NamedTuple):
    """For each train's pixel: responses at both frames and the level remembered between, float64 (N,)."""

    before: np.ndarray
    after: np.ndarray
    remembered: np.ndarray


@numba.njit(cache=True, error_model="numpy")
def train_after_refractory_period(pixel, span, refractory_us):
    """Return signed crossings, start, stride, remembered level, and whether anything changed.

    While the response moves in one direction at one pace, two successive events are one refractory
    period plus the time for one threshold apart.
    """
    interval = span.end_us - span.start_us
    ended, way = pixel.refractory_end_us >= span.start_us, pixel.after - pixel.before
    since = pixel.refractory_end_us - span.start_us if ended else 0
    remembered = pixel.before + way * (since / interval) if ended else pixel.remembered
    sign, size = (1, pixel.on) if pixel.after > remembered else (-1, pixel.off)
    if way == 0.0 or abs(pixel.after - remembered) + TOLERANCE < size:
        return 0, 0.0, 0.0, remembered, ended
    pace = interval / abs(way)
    first = moment((sign * (remembered - pixel.before) + size) * pace, 0.0, 0, interval)
    gap = np.rint(size * pace)
    left = interval + gap - (size - TOLERANCE) * pace - first
    n = 1 + int(max(left / (refractory_us + gap), 0.0))
    return sign * n, float(first), refractory_us + gap, remembered, True


@numba.njit(cache=True, error_model="numpy")
def start_refractory_periods(trains, motions, span, refractory_us, memory):
    """Start a refractory period at each pixel's last event; return how many pixels are out of theirs.

    These pixels are moved to the front of `trains.pixels`. The others lose their quiet band, so they are
    decided in every frame until their period ends.
    """
    interval, free = span.end_us - span.start_us, 0
    for j in range(trains.pixels.size):
        i, n, remembered = trains.pixels[j], abs(trains.crossings[j]), motions.remembered[j]
        if n > 0:
            end_us = (
                span.start_us + moment(trains.start[j], trains.stride[j], n - 1, interval) + refractory_us
            )
            memory.refractory_end_us[i] = end_us
            if end_us >= span.end_us:
                never_be_quiet(memory, i)
                continue
            way = motions.after[j] - motions.before[j]
            remembered = motions.before[j] + way * ((end_us - span.start_us) / interval)
        memory.first_level[i], memory.on_count[i], memory.off_count[i] = remembered, 0, 0
        trains.pixels[free] = i
        free += 1
    return free


@inlined
def never_be_quiet(memory, i):
    """Make the camera decide a pixel in every frame, until its quiet band is set again."""
    memory.level_light[i], memory.quiet_low[i], memory.quiet_high[i] = -np.inf, 1.0, 0.0
