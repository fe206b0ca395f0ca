"""Find hot pixels, which fire far more often than the light explains."""

import numpy as np

from jobs.analysis.statistics import wilson_interval
from jobs.tools.calibrate.footage import Light, Trains
from jobs.tools.calibrate.found import Found, missing, resampled, with_interval

RARE = 0.98  # quantile of the pixels that defines the usual count; at most the rest is hot
TIMES, SIGMAS, FEWEST = 2.0, 8.0, 10.0


def unexplained(trains: Trains, light: Light, thresholds: tuple[float, float]) -> np.ndarray:
    """Count the events of each pixel beyond those that its response explains, float64 (P,), >= 0."""
    count = np.bincount(trains.pixel, minlength=light.response.shape[1]).astype(np.float64)
    rise = light.travel[-1]
    fall = rise - (light.response[-1] - light.response[0])
    return np.maximum(count - rise / thresholds[0] - fall / thresholds[1], 0.0)


def hot_pixels(unexplained: np.ndarray) -> np.ndarray:
    """Return the hot pixels, bool (P,).

    A hot pixel has more unexplained events than twice the 98 % quantile, eight standard deviations and ten
    events together.
    """
    usual = float(np.quantile(unexplained, RARE))
    return unexplained > TIMES * usual + SIGMAS * np.sqrt(TIMES * usual) + FEWEST


def hot_settings(
    unexplained: np.ndarray, hot: np.ndarray, seconds: float, rng: np.random.Generator
) -> tuple[Found, Found]:
    """Estimate the share of hot pixels, and their event rate beyond the other pixels' rate [Hz]."""
    low, high = wilson_interval(int(hot.sum()), hot.size)
    share = Found(float(hot.mean()), low, high)
    if not hot.any():
        return share, missing("no hot pixel")
    beyond = (unexplained[hot] - unexplained[~hot].mean()) / seconds
    weights = resampled(beyond.size, rng)
    spread = rng.poisson(np.maximum(weights @ beyond, 0.0) * seconds) / seconds
    return share, with_interval(beyond.mean(), spread / beyond.size)
