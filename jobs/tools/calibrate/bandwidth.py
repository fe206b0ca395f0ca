"""Estimate the bandwidth of the photoreceptors: with the right one, a pixel's events fit one staircase.

The response lags behind fast light, the more the lower the bandwidth. With a wrong bandwidth, events of
rises and falls, and of fast and slow changes, imply different levels. Noise makes a pixel fire early, on
average by the same fraction of a threshold in all rises and falls; this fraction is subtracted.
"""

import dataclasses

import numpy as np

from envs.config import CameraConfig
from envs.events.lowpass import filter_rates
from jobs.tools.calibrate.footage import Trains, light_behind, of_columns
from jobs.tools.calibrate.found import TAILS, Found, missing, resampled, with_interval
from jobs.tools.calibrate.thresholds import equations, staircase

MOST_PIXELS = 128  # number of the most active pixels to use
LOWEST_HZ, HIGHEST_HZ, COARSE, FINE = 2.0, 4000.0, 10, 7
NO_FIT = 1e9  # misfit [thresholds] if no staircase can be fitted
# Largest frame interval in time constants: between frames the light is unknown and assumed to be linear.
COARSEST = 4.0
UNLIMITED = "frames and events fit an unlimited bandwidth as well"


def misfit(
    trains: Trains, luminance: np.ndarray, times_us: np.ndarray, camera: CameraConfig, refractory_us: float
) -> np.ndarray:
    """Sum the deviations of each pixel's events from one staircase, in thresholds, float64 (P,).

    Args:
        trains: Events of P pixels.
        luminance: Luminance of the frames, white = 1, float32 (K, P).
        times_us: Times of the frames [us].
        camera: The camera with the bandwidth to try.
        refractory_us: Dead time [us].
    """
    light = light_behind(luminance, times_us, camera)
    table = equations(trains, light, refractory_us)
    try:
        on, off = np.linalg.solve(table.matrix.sum(axis=(0, 1)), table.right.sum(axis=(0, 1)))
    except np.linalg.LinAlgError:
        return np.full(luminance.shape[1], NO_FIT)
    if not min(on, off) > 0.0:
        return np.full(luminance.shape[1], NO_FIT)
    stairs = staircase(trains, light, refractory_us)
    rest = (stairs.response - on * stairs.on + off * stairs.off) / (0.5 * (on + off))
    early = (rest @ stairs.polarity) / max(stairs.polarity @ stairs.polarity, 1e-9)
    return np.bincount(stairs.half // 2, np.abs(rest - early * stairs.polarity), luminance.shape[1])


def bandwidth(
    trains: Trains,
    luminance: np.ndarray,
    times_us: np.ndarray,
    camera: CameraConfig,
    refractory_us: float,
    rng: np.random.Generator,
) -> Found:
    """Estimate the photoreceptors' cutoff [Hz], with an interval over pixels; arguments as in `misfit`."""
    active = np.bincount(trains.pixel, minlength=luminance.shape[1])
    chosen = np.sort(np.argsort(-active, kind="stable")[:MOST_PIXELS])
    trains, luminance = of_columns(trains, chosen), np.ascontiguousarray(luminance[:, chosen])

    def tried(cutoffs: np.ndarray) -> np.ndarray:
        cameras = [dataclasses.replace(camera, cutoff_hz=cutoff_hz) for cutoff_hz in cutoffs.tolist()]
        return np.stack([misfit(trains, luminance, times_us, one, refractory_us) for one in cameras])

    cutoffs = np.geomspace(LOWEST_HZ, HIGHEST_HZ, COARSE)
    found, unlimited = tried(cutoffs), tried(np.zeros(1))[0]
    is_highest = found.sum(axis=1).argmin() == COARSE - 1
    for _ in range(2):
        best, step = int(found.sum(axis=1).argmin()), cutoffs[1] / cutoffs[0]
        cutoffs = cutoffs[best] * step ** np.linspace(-1.0, 1.0, FINE)
        found = tried(cutoffs)
    weights = resampled(luminance.shape[1], rng)
    worse = weights @ (unlimited - found[found.sum(axis=1).argmin()])
    if is_highest or not np.quantile(worse, TAILS[0]) > 0.0:
        return missing(UNLIMITED)
    value = float(lowest(cutoffs, found.sum(axis=1)[None])[0])
    apart_ms = 1e-3 * float(np.median(np.diff(times_us)))
    constant_ms = 1e3 * time_constant_s(value, luminance, camera)
    if apart_ms > COARSEST * constant_ms:
        return missing(f"frames {apart_ms:.3g} ms apart cannot tell a time constant of {constant_ms:.2g} ms")
    return with_interval(value, lowest(cutoffs, weights @ found.T))


def time_constant_s(cutoff_hz: float, luminance: np.ndarray, camera: CameraConfig) -> float:
    """Return the time constant of the filter at the median luminance [s]; white = 1."""
    black, white = filter_rates(dataclasses.replace(camera, cutoff_hz=cutoff_hz))
    return 1.0 / (black + white * float(np.median(luminance)))


def lowest(cutoffs: np.ndarray, totals: np.ndarray) -> np.ndarray:
    """Return the minimum of each row of totals (D, F), refined by a parabola in log cutoff."""
    place = np.clip(totals.argmin(axis=1), 1, totals.shape[1] - 2)
    rows = np.arange(len(totals))
    before, at, after = (totals[rows, place + k] for k in (-1, 0, 1))
    bend = before - 2.0 * at + after
    shift = np.where(bend > 0.0, 0.5 * (before - after) / np.where(bend > 0.0, bend, 1.0), 0.0)
    return cutoffs[place] * (cutoffs[1] / cutoffs[0]) ** np.clip(shift, -1.0, 1.0)
