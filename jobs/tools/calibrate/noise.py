"""Estimate leakage and shot noise from pixels under constant light, by matching simulated event rates.

In a still pixel leakage causes ON events, and shot noise alternating ON and OFF events. A refractory period
or unequal thresholds change the observed rates of both. So both are estimated together: pixels are simulated
under the same light, and leakage and shot noise adjusted until the ON and OFF rates match the recording.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from envs.config import CameraConfig, FaultsConfig
from envs.events.pixel_noise import SHOT_NOISE_FALL
from jobs.tools.calibrate.footage import Footage, Trains, simulate, trains_of
from jobs.tools.calibrate.found import Found, neither

BURN_IN = 0.25  # share of the time to skip, until noise has distributed the pixels' levels
FEWEST_PIXELS = 16
SIMULATED_PIXELS = 5000
ROUNDS, NUDGE = 3, 0.2
LEAST_NUDGE_HZ = 0.01
HIDDEN = 1e-3  # smallest determinant of the slopes that allows a solution
STEP_US = 250_000


class Rates(NamedTuple):
    """Rates of ON and OFF events of a still pixel, with their uncertainty.

    Attributes:
        mean: Mean rates, float64 (2,) [Hz].
        covariance: Covariance of the means, float64 (2, 2) [Hz^2].
    """

    mean: np.ndarray
    covariance: np.ndarray


def still_rates(trains: Trains, still: np.ndarray, span_us: tuple[int, int]) -> Rates:
    """Compute the rates of the still pixels, bool (P,), in the later three quarters of a span [us]."""
    begin = span_us[0] + BURN_IN * (span_us[1] - span_us[0])
    late = trains.t_us > begin
    counts = np.stack(
        [
            np.bincount(trains.pixel[late & (trains.p == sign)], minlength=still.size)[still]
            for sign in (1, -1)
        ]
    )
    seconds = (span_us[1] - begin) * 1e-6
    # At least the variance of a single event.
    covariance = (np.cov(counts) + np.eye(2) / counts.shape[1]) / counts.shape[1]
    return Rates(counts.mean(axis=1) / seconds, covariance / seconds**2)


def simulated_rates(
    leak_hz: float, shot_hz: float, camera: CameraConfig, luminance: float, span_us: tuple[int, int]
) -> Rates:
    """Compute the rates of simulated pixels; deterministic."""
    side = math.isqrt(SIMULATED_PIXELS)
    camera = dataclasses.replace(camera, width=side, height=side)
    times_us = np.append(np.arange(*span_us, STEP_US), span_us[1])
    frames = np.broadcast_to(np.float32(luminance), (len(times_us), side, side))
    events = simulate(
        Footage(frames, times_us), camera, FaultsConfig(leak_hz=leak_hz, shot_noise_hz=shot_hz), seed=0
    )
    return still_rates(trains_of(events, side), np.ones(side * side, bool), span_us)


def noise_rates(
    seen: Rates, camera: CameraConfig, luminance: float, span_us: tuple[int, int]
) -> tuple[Found, Found]:
    """Estimate `leak_hz` and `shot_noise_hz` [Hz] from rates of still pixels; luminance with white = 1.

    The intervals combine the uncertainties of observed and simulated rates, propagated through the slopes of
    the rates against leakage and shot noise.
    """
    ratio = (camera.contrast_threshold_off or camera.contrast_threshold) / camera.contrast_threshold
    on, off = seen.mean
    values = np.array([max(on - ratio * off, 0.0), 2.0 * off / (1.0 - SHOT_NOISE_FALL * min(luminance, 1.0))])

    def simulated(rates: np.ndarray) -> Rates:
        return simulated_rates(float(rates[0]), float(rates[1]), camera, luminance, span_us)

    for _ in range(ROUNDS):
        made, nudges = simulated(values), np.diag(NUDGE * values + LEAST_NUDGE_HZ)
        slope = np.stack(
            [(simulated(values + nudge).mean - made.mean) / nudge.sum() for nudge in nudges], axis=1
        )
        if abs(np.linalg.det(slope)) < HIDDEN:
            return neither("leakage and shot noise look the same behind this refractory period")
        step = np.linalg.solve(slope, seen.mean - made.mean)
        values = np.clip(values + step, 0.2 * values, 5.0 * values + LEAST_NUDGE_HZ)
    inverse = np.linalg.inv(slope)
    error = 1.96 * np.sqrt(np.diag(inverse @ (seen.covariance + made.covariance) @ inverse.T))
    pairs = zip(values.tolist(), error.tolist(), strict=True)
    leak, shot = (Found(value, max(value - half, 0.0), value + half) for value, half in pairs)
    return leak, shot
