"""The bandwidth of a photoreceptor: a first-order low-pass filter between light and pixel.

The camera sees the light that would have the filtered response. The response is taken as linear from one
frame to the next, as in the camera, and the filter's equation is then solved exactly. Extra frames therefore
change the result only through the light that they show. A column camera takes the light as linear between
two looks; there the response is taken as linear in each half of the interval. Pixels with constant light and
a settled filter (three of four at 200 Hz) are skipped there, because the equation would not change a bit of
them.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from envs.compiled import inlined, kernel
from envs.config import CameraConfig
from envs.events.crossings import BLOCK, write_flagged
from envs.events.photoreceptor import MAX_LUMINANCE, Curve, exponential, light_of, respond

# A photoreceptor is faster in brighter light. v2e's filter: bandwidth ~ (grey + 20) / 275, of 255 greys.
DARK_SHARE, WHITE_SHARE = 20.0 / 275.0, 255.0 / 275.0
MOST_PERIODS = 60.0  # [time constants] after which the earlier state has no effect
LITTLE = 1e-6  # [time constants] below it the first order is exact to 1e-12 of the response


class LowPass(NamedTuple):
    """State of N filtered pixels, (N,) each; changed in place.

    Attributes:
        filtered: Response after the filter, float64.
        response: Response before the filter, at the last frame, float64.
        light: Luminance of the last frame, float32.
    """

    filtered: np.ndarray
    response: np.ndarray
    light: np.ndarray


class ColumnFilter(NamedTuple):
    """The low-pass filter of a column camera with N pixels; N is 0 if the bandwidth is unlimited.

    Attributes:
        pixels: `LowPass`.
        seen: float32 (N,), the luminance that the camera sees.
        half: float64 (N,), the filtered responses half-way to the last look at which they moved.
        rates: From `filter_rates`.
        room: Room for a block of pixels, float64 (10, BLOCK) and int64 (BLOCK,).
    """

    pixels: LowPass
    seen: np.ndarray
    half: np.ndarray
    rates: tuple[float, float]
    room: tuple[np.ndarray, np.ndarray]


def low_pass(num_pixels: int) -> LowPass:
    """Allocate the filter state of a camera's pixels; `start_filter` sets it."""
    return LowPass(np.zeros(num_pixels), np.zeros(num_pixels), np.zeros(num_pixels, np.float32))


def column_filter(config: CameraConfig) -> ColumnFilter:
    """Return the low-pass filter of a column camera, before its first image."""
    size = config.width * config.height if config.cutoff_hz > 0.0 else 0
    room = np.zeros((10, BLOCK)), np.zeros(BLOCK, np.int64)
    return ColumnFilter(
        low_pass(size), np.zeros(size, np.float32), np.zeros(size), filter_rates(config), room
    )


def filter_rates(config: CameraConfig) -> tuple[float, float]:
    """Return the angular frequency of the filter in black, and the increase from black to white [rad/s]."""
    rate = 2.0 * math.pi * config.cutoff_hz
    return (rate * DARK_SHARE, rate * WHITE_SHARE) if config.cutoff_grows_with_light else (rate, 0.0)


UNLIMITED = column_filter(CameraConfig())


@numba.njit(cache=True, error_model="numpy")
def start_filter(luminance: np.ndarray, curve: Curve, pixels: LowPass) -> None:
    """Settle the filter on a first frame, float32 (N,)."""
    respond(curve, luminance, pixels.response, np.empty(luminance.size, np.int64))
    pixels.filtered[:] = pixels.response
    pixels.light[:] = luminance


@numba.njit(cache=True, error_model="numpy")
def start_columns(luminance: np.ndarray, curve: Curve, bandwidth: ColumnFilter) -> None:
    """Settle the filter of a column camera on a first frame, float32 (N,), column after column."""
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
    """Return the frames after the filter, float32 (K, N).

    With the response r(t) = r0 + s t over a frame interval T, and w the filter's angular frequency at the
    interval's mean light, v' = w (r - v) has the solution v(T) = r(T) - s / w + (v0 - r0 + s / w) exp(-w T).

    Args:
        frames: float32 (K, N), valid.
        times_us: int64 (K + 1,), times of the previous frame and of these frames [us].
        curve: `Curve` of the camera.
        rates: Angular frequency in black, and the increase from black to white [rad/s].
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
        filtered: The filter's output before.
        slope: The response before and after, and the time between them in time constants, w T.
        decay: exp(-w T).
    """
    before, after, periods = slope
    lag = (after - before) / periods
    followed = after - lag + (filtered - before + lag) * decay
    little = filtered + (0.5 * (before + after) - filtered) * periods  # first order, safe from cancellation
    return followed if periods > LITTLE else little


@kernel
def _follow(
    filtered: np.ndarray, lights: tuple, responses: tuple, rates: tuple, seconds: np.ndarray, room: tuple
) -> None:
    """Filter responses that are linear in time, with the bandwidth at the mean light.

    Args:
        filtered: The filter's output, float64 (N,), changed in place.
        lights: Luminance before and after, float64 (N,) each.
        responses: Responses before and after, float64 (N,) each.
        rates: Angular frequency in black, and the increase from black to white [rad/s].
        seconds: Time between before and after, float64 (N,) [s].
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
    """Filter new light of columns `first` .. `last` - 1 since the last look at each of them.

    Args:
        luminance: float32 (W * H,), valid, column after column.
        first: The first column.
        last: The column after the last.
        t_us: The time of the new light [us].
        seen_us: int64 (W,), the time of the last look at each column, earlier than `t_us` [us].
        curve: `Curve` of the camera.
        bandwidth: `ColumnFilter`, changed in place.
        scratch: `flags` and `outside` as for `crossings.scan`.
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
    """Write those of the pixels `begin` .. `end` - 1 whose light changed or whose filter has not settled."""
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
    """Filter at most BLOCK pixels over both halves of the time since the last look at them."""
    pixels, rates, (table, exponents) = bandwidth.pixels, bandwidth.rates, bandwidth.room
    size, height = chosen.size, luminance.size // seen_us.size
    # Not unpacked: the strides would be unknown, and the loops would not compile to wide instructions.
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
