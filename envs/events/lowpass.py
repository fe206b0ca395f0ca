"""The bandwidth of a photoreceptor: a first-order low-pass filter between light and pixel.

A camera sees through it the light that would have had the filtered response. The response is taken as
linear from one frame to the next, as the camera takes it, and the filter's equation is then solved exactly:
frames between two others change nothing but what they show. Where a camera looks at columns, and takes the
light as linear between two looks, the response is taken as linear up to half-way and from there on.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from envs.compiled import inlined, kernel
from envs.config import CameraConfig
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
    """The bandwidth of a camera that looks at columns of H of its N pixels; of no pixels if it is unlimited.

    Attributes:
        pixels: `LowPass`.
        seen: float32 (N,), what the camera sees.
        half: float64 (N,), the responses behind the filter half-way to the last look.
        rates: As `filter_rates` gives them.
        room: Room for a column, float64 (4, H), and int64 (H,).
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
    room = np.zeros((4, config.height)), np.zeros(config.height, np.int64)
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
def _follow(filtered: np.ndarray, lights: tuple, responses: tuple, rates: tuple, room: tuple) -> None:
    """Let photoreceptors follow responses that are linear in time; the bandwidth is that of the mean light.

    Args:
        filtered: What is behind the filter, float64 (H,), changed in place.
        lights: Luminance before and after, float32 (H,) each.
        responses: To it, float64 (H,) each.
        rates: In black, and what white adds, times the time between [rad].
        room: float64 (H,) twice, and int64 (H,).
    """
    (past, light), (before, after), (periods, decay, exponents) = lights, responses, room
    black, white = rates
    for i in range(filtered.size):
        periods[i] = black + white * (0.5 * past[i] + 0.5 * light[i])
        decay[i] = -min(periods[i], MOST_PERIODS)
    exponential(decay, exponents)
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
    """
    pixels, (black, white), (table, exponents) = bandwidth.pixels, bandwidth.rates, bandwidth.room
    middle, after = table[0], table[1]  # unpacked, their strides would be unknown, and no loop over them wide
    room, height = (table[2], table[3], exponents), exponents.size
    for column in range(first, last):
        begin, seconds = column * height, (t_us - seen_us[column]) * 0.5e-6  # of each half
        light, past = luminance[begin : begin + height], pixels.light[begin : begin + height]
        response, filtered = pixels.response[begin : begin + height], pixels.filtered[begin : begin + height]
        seen, rates = bandwidth.seen[begin : begin + height], (black * seconds, white * seconds)
        half = bandwidth.half[begin : begin + height]
        for i in range(height):
            seen[i] = np.float32(0.5) * past[i] + np.float32(0.5) * light[i]
        respond(curve, seen, middle, exponents)
        respond(curve, light, after, exponents)
        _follow(filtered, (past, seen), (response, middle), rates, room)
        for i in range(height):
            half[i] = filtered[i]
        _follow(filtered, (seen, light), (middle, after), rates, room)
        for i in range(height):
            response[i], middle[i] = after[i], filtered[i]
        light_of(curve, middle, exponents)
        for i in range(height):
            seen[i] = np.float32(min(max(middle[i], 0.0), MAX_LUMINANCE))
            past[i] = light[i]
