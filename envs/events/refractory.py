"""Kernels of a pixel's dead time after an event: what it fires then, and where it looks on from.

Names are those of `envs.events.crossings`. Input is taken as valid.
"""

import numba
import numpy as np

from envs.events.emission import moment

# Two luminances rounded to float32 leave their log difference uncertain by this much: a level
# this near counts as reached, so that a step of exactly k thresholds gives k events.
TOLERANCE = 2.0**-23


@numba.njit(cache=True, error_model="numpy")
def train_with_dead_time(pixel, times, held, refractory_us):
    """Signed crossings, start, stride, remembered level, and whether anything changed.

    While the level moves one way at one pace, all events after the first are one dead time
    and one threshold apart.
    """
    before, after, remembered, on, off = pixel
    t0, t1 = times
    ended, way = held >= t0, after - before
    since = held - t0 if ended else 0
    if ended:
        remembered = before + way * (since / (t1 - t0))
    sign, size = (1, on) if after > remembered else (-1, off)
    if way == 0.0 or abs(after - remembered) + TOLERANCE < size:
        return 0, 0.0, 0.0, remembered, ended
    pace = (t1 - t0) / abs(way)
    first = moment((sign * (remembered - before) + size) * pace, 0.0, 0, t1 - t0)
    gap = np.rint(size * pace)
    left = (t1 - t0) + gap - (size - TOLERANCE) * pace - first
    n = 1 + int(max(left / (refractory_us + gap), 0.0))
    return sign * n, float(first), refractory_us + gap, remembered, True


@numba.njit(cache=True, error_model="numpy")
def resume(pixels, crossings, trains, times, refractory_us, state):
    """Start the dead time of each last event; compact the pixels that are out of it and return how many.

    The others have no quiet band: they are decided in every frame, until their dead time ends.
    """
    band, level, held = state
    t0, t1 = times
    free = 0
    for j in range(pixels.size):
        i, n, remembered = pixels[j], abs(crossings[j]), trains[4, j]
        if n > 0:
            held[i] = t0 + moment(trains[0, j], trains[1, j], n - 1, t1 - t0) + refractory_us
            if held[i] >= t1:
                band[0, i], band[1, i] = 1.0, 0.0
                continue
            remembered = trains[2, j] + (trains[3, j] - trains[2, j]) * ((held[i] - t0) / (t1 - t0))
        level[0, i], level[1, i], level[2, i] = remembered, 0.0, 0.0
        pixels[free] = i
        free += 1
    return free
