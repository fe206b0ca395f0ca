"""The bandwidth of a photoreceptor: a first-order low-pass filter between light and pixel.

A camera sees through it the light that would have had the filtered response. The response is taken as
linear from one frame to the next, as the camera takes it, and the filter's equation is then solved exactly:
frames between two others change nothing but what they show. Where a camera looks at columns, and takes the
light as linear between two looks, the response is taken as linear up to half-way and from there on. There,
pixels whose light rests and whose filter has settled, three of four at 200 Hz, are left alone: the equation
would give them the same bits.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from envs.compiled import inlined, kernel
from envs.config import CameraConfig
from envs.events.crossings import BLOCK, write_flagged
from envs.events.photoreceptor import MAX_LUMINANCE, Curve, exponential, light_of, respond

# A photoreceptor is faster where it is brighter. v2e's filter: bandwidth ~ (grey + 20) / 275, of 255 greys.
DARK_SHARE, WHITE_SHARE = 20.0 / 275.0, 255.0 / 275.0
MOST_PERIODS = 60.0  # after which nothing is left of what was before
LITTLE = 1e-6  # of a period; in less the first order is exact to 1e-12 of the response


class LowPass(NamedTuple):
    """What N filtered pixels remember, (N,) each; changed in place.

    Attributes:
        filtered: Response behind the filter, float64.
        response: Response before it, at the last frame, float64.
        light: Luminance of the last frame, float32.
    """

    filtered: np.ndarray
    response: np.ndarray
    light: np.ndarray


class ColumnFilter(NamedTuple):
    """The bandwidth of a camera that looks at columns of its N pixels; of no pixels if it is unlimited.

    Attributes:
        pixels: `LowPass`.
        seen: float32 (N,), what the camera sees.
        half: float64 (N,), the responses behind the filter half-way to the last look at which they moved.
        rates: As `filter_rates` gives them.
        room: Room for a block of pixels, float64 (10, BLOCK), and int64 (BLOCK,).
    """

    pixels: LowPass
    seen: np.ndarray
    half: np.ndarray
    rates: tuple[float, float]
    room: tuple[np.ndarray, np.ndarray]


def low_pass(num_pixels: int) -> LowPass:
    """Room for the pixels of a camera; `start_filter` sets it."""
    return LowPass(np.zeros(num_pixels), np.zeros(num_pixels), np.zeros(num_pixels, np.float32))


def column_filter(config: CameraConfig) -> ColumnFilter:
    """Return the bandwidth of a camera, before a first image."""
    size = config.width * config.height if config.cutoff_hz > 0.0 else 0
    room = np.zeros((10, BLOCK)), np.zeros(BLOCK, np.int64)
    return ColumnFilter(
        low_pass(size), np.zeros(size, np.float32), np.zeros(size), filter_rates(config), room
    )


def filter_rates(config: CameraConfig) -> tuple[float, float]:
    """Angular frequency of the filter in black, and what white adds to it [rad/s]."""
    rate = 2.0 * math.pi * config.cutoff_hz
    return (rate * DARK_SHARE, rate * WHITE_SHARE) if config.cutoff_grows_with_light else (rate, 0.0)


UNLIMITED = column_filter(CameraConfig())


@numba.njit(cache=True, error_model="numpy")
def start_filter(luminance: np.ndarray, curve: Curve, pixels: LowPass) -> None:
    """Settle on a first frame, float32 (N,)."""
    respond(curve, luminance, pixels.response, np.empty(luminance.size, np.int64))
    pixels.filtered[:] = pixels.response
    pixels.light[:] = luminance


@numba.njit(cache=True, error_model="numpy")
def start_columns(luminance: np.ndarray, curve: Curve, bandwidth: ColumnFilter) -> None:
    """Settle on a first frame, float32 (N,), column after column."""
    start_filter(luminance, curve, bandwidth.pixels)
    bandwidth.half[:] = bandwidth.pixels.filtered
    lights = bandwidth.pixels.filtered.copy()
    light_of(curve, lights, np.empty(luminance.size, np.int64))
    for i in range(luminance.size):
        bandwidth.seen[i] = np.float32(min(max(lights[i], 0.0), MAX_LUMINANCE))


@numba.njit(cache=True, error_model="numpy")
def filter_frames(
    frames: np.ndarray, times_us: np.ndarray, curve: Curve, rates: tuple, pixels: LowPass
) -> np.ndarray:
    """Frames as they look behind the filter, float32 (K, N).

    With the response r(t) = r0 + s t over a frame interval T, and w the filter's angular frequency at the
    interval's mean light, v' = w (r - v) has the solution v(T) = r(T) - s / w + (v0 - r0 + s / w) exp(-w T).

    Args:
        frames: float32 (K, N), valid.
        times_us: int64 (K + 1,), of the frame before them and theirs [us].
        curve: `Curve` of the camera.
        rates: Angular frequency in black, and what white adds [rad/s].
        pixels: `LowPass`.
    """
    size, (black, white) = frames.shape[1], rates
    seen, exponents = np.empty(frames.shape, np.float32), np.empty(size, np.int64)
    after, rate, decay = np.empty(size), np.empty(size), np.empty(size)
    for k in range(len(frames)):
        seconds = (times_us[k + 1] - times_us[k]) * 1e-6
        respond(curve, frames[k], after, exponents)
        for i in range(size):
            rate[i] = black + white * 0.5 * (np.float64(pixels.light[i]) + frames[k, i])
            decay[i] = -min(rate[i] * seconds, MOST_PERIODS)
        exponential(decay, exponents)
        for i in range(size):
            slope = pixels.response[i], after[i], rate[i] * seconds
            pixels.filtered[i] = _followed(pixels.filtered[i], slope, decay[i])
            pixels.response[i], pixels.light[i] = after[i], frames[k, i]
            after[i] = pixels.filtered[i]
        light_of(curve, after, exponents)
        for i in range(size):
            seen[k, i] = np.float32(min(max(after[i], 0.0), MAX_LUMINANCE))
    return seen


@inlined
def _followed(filtered: float, slope: tuple, decay: float) -> float:
    """Return the filter's output after a response that is linear in time.

    Args:
        filtered: What was behind it.
        slope: The response before and after, and how much of a period of the filter, w T, lies between.
        decay: exp(-w T).
    """
    before, after, periods = slope
    lag = (after - before) / periods
    followed = after - lag + (filtered - before + lag) * decay
    little = filtered + (0.5 * (before + after) - filtered) * periods  # where that would be lost in rounding
    return followed if periods > LITTLE else little


@kernel
def _follow(
    filtered: np.ndarray, lights: tuple, responses: tuple, rates: tuple, seconds: np.ndarray, room: tuple
) -> None:
    """Let photoreceptors follow responses that are linear in time; the bandwidth is that of the mean light.

    Args:
        filtered: What is behind the filter, float64 (N,), changed in place.
        lights: Luminance before and after, float64 (N,) each.
        responses: To it, float64 (N,) each.
        rates: In black, and what white adds [rad/s].
        seconds: The time between, float64 (N,) [s].
        room: float64 (N,) twice, and int64 (N,).
    """
    (past, light), (before, after), (periods, decay, exponents) = lights, responses, room
    black, white = rates
    for i in range(filtered.size):
        periods[i] = black * seconds[i] + white * seconds[i] * (0.5 * past[i] + 0.5 * light[i])
        decay[i] = -min(periods[i], MOST_PERIODS)
    exponential(decay[: filtered.size], exponents)
    for i in range(filtered.size):
        filtered[i] = _followed(filtered[i], (before[i], after[i], periods[i]), decay[i])


@kernel
def filter_columns(
    luminance: np.ndarray,
    first: int,
    last: int,
    t_us: int,
    seen_us: np.ndarray,
    curve: Curve,
    bandwidth: ColumnFilter,
    scratch: tuple[np.ndarray, np.ndarray],
) -> None:
    """Let columns `first` .. `last` - 1 see new light, until when their photoreceptors follow it.

    Args:
        luminance: float32 (W * H,), valid, column after column.
        first: The first column.
        last: The column after the last.
        t_us: The time [us].
        seen_us: int64 (W,), earlier times when each column was looked at last [us].
        curve: `Curve` of the camera.
        bandwidth: `ColumnFilter`, changed in place.
        scratch: As `crossings.scan` takes `flags` and `outside`.
    """
    height, (flags, chosen) = luminance.size // seen_us.size, scratch
    found = _restless(luminance, first * height, last * height, bandwidth.pixels, flags, chosen)
    for begin in range(0, found, BLOCK):
        block = chosen[begin : min(begin + BLOCK, found)]
        _follow_block(block, luminance, t_us, seen_us, curve, bandwidth)


@kernel
def _restless(
    luminance: np.ndarray, begin: int, end: int, pixels: LowPass, flags: np.ndarray, chosen: np.ndarray
) -> int:
    """Write the pixels `begin` .. `end` - 1 whose light has changed or whose filter has not settled."""
    flag, size, light = flags.view(np.uint8), end - begin, luminance[begin:end]
    past, response, filtered = pixels.light[begin:end], pixels.response[begin:end], pixels.filtered[begin:end]
    for i in range(size):
        flag[i] = (light[i] != past[i]) | (filtered[i] != response[i])
    return write_flagged(flags, size, begin, chosen)


@kernel
def _follow_block(
    chosen: np.ndarray,
    luminance: np.ndarray,
    t_us: int,
    seen_us: np.ndarray,
    curve: Curve,
    bandwidth: ColumnFilter,
) -> None:
    """Lead at most BLOCK pixels through both halves of the time since they were looked at."""
    pixels, rates, (table, exponents) = bandwidth.pixels, bandwidth.rates, bandwidth.room
    size, height = chosen.size, luminance.size // seen_us.size
    # Not unpacked: their strides would be unknown, and no loop over them wide.
    past, middle, light = table[0][:size], table[1][:size], table[2][:size]
    before, half, after = table[3][:size], table[4][:size], table[5][:size]
    filtered, seconds, room = table[6][:size], table[7][:size], (table[8], table[9], exponents)
    column = chosen[0] // height
    for j in range(size):
        i = chosen[j]
        while i >= (column + 1) * height:
            column += 1
        past[j], light[j] = pixels.light[i], luminance[i]
        middle[j] = np.float32(0.5) * pixels.light[i] + np.float32(0.5) * luminance[i]
        before[j], filtered[j] = pixels.response[i], pixels.filtered[i]
        seconds[j] = (t_us - seen_us[column]) * 0.5e-6  # of each half
    respond(curve, middle, half, exponents)
    respond(curve, light, after, exponents)
    _follow(filtered, (past, middle), (before, half), rates, seconds, room)
    for j in range(size):
        bandwidth.half[chosen[j]] = filtered[j]
    _follow(filtered, (middle, light), (half, after), rates, seconds, room)
    for j in range(size):
        i = chosen[j]
        pixels.filtered[i], pixels.response[i], pixels.light[i] = filtered[j], after[j], luminance[i]
    light_of(curve, filtered, exponents)
    for j in range(size):
        bandwidth.seen[chosen[j]] = np.float32(min(max(filtered[j], 0.0), MAX_LUMINANCE))
