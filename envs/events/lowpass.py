"""The bandwidth of a photoreceptor: a first-order low-pass filter between light and pixel.

A camera sees through it the light that would have had the filtered response. The response is taken as
linear from one frame to the next, as the camera takes it, and the filter's equation is then solved exactly:
frames between two others change nothing but what they show.
"""

import math
from typing import NamedTuple

import numba
import numpy as np

from envs.config import CameraConfig
from envs.events.photoreceptor import MAX_LUMINANCE, Curve, exponential, light_of, respond

# A photoreceptor is faster where it is brighter. v2e's filter: bandwidth ~ (grey + 20) / 275, of 255 greys.
DARK_SHARE, WHITE_SHARE = 20.0 / 275.0, 255.0 / 275.0
MOST_PERIODS = 60.0  # after which nothing is left of what was before


class LowPass(NamedTuple):
    """What N filtered pixels remember, float64 (N,) each; changed in place.

    Attributes:
        filtered: Response behind the filter.
        response: Response before it, at the last frame.
        light: Luminance of the last frame.
    """

    filtered: np.ndarray
    response: np.ndarray
    light: np.ndarray


def low_pass(config: CameraConfig) -> LowPass:
    """Room for the pixels of a camera; `start_filter` sets it."""
    return LowPass(*np.zeros((3, config.width * config.height)))


def filter_rates(config: CameraConfig) -> tuple[float, float]:
    """Angular frequency of the filter in black, and what white adds to it [rad/s]."""
    rate = 2.0 * math.pi * config.cutoff_hz
    return (rate * DARK_SHARE, rate * WHITE_SHARE) if config.cutoff_grows_with_light else (rate, 0.0)


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
            rate[i] = black + white * 0.5 * (pixels.light[i] + frames[k, i])
            decay[i] = -min(rate[i] * seconds, MOST_PERIODS)
        if white > 0.0:
            exponential(decay, exponents)
        else:
            decay[:] = math.exp(decay[0])
        for i in range(size):
            lag = (after[i] - pixels.response[i]) / (rate[i] * seconds)
            past = (pixels.filtered[i] - pixels.response[i] + lag) * decay[i]
            pixels.filtered[i] = after[i] - lag + past
            pixels.response[i], pixels.light[i] = after[i], frames[k, i]
            after[i] = pixels.filtered[i]
        light_of(curve, after, exponents)
        for i in range(size):
            seen[k, i] = np.float32(min(max(after[i], 0.0), MAX_LUMINANCE))
    return seen
