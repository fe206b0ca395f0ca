"""Estimate the refractory period: how long a pixel ignores changing light after an event.

At the end of its refractory period a pixel takes the current light as its level, and fires after a change by
one more threshold. So if the light changes by more than a threshold until the pixel's next event, the pixel
was deaf for all of the interval except the time of the last threshold. It was never deaf for longer than the
shortest interval; a still scene gives only this upper limit.
"""

import numpy as np

from jobs.tools.calibrate.footage import Light, Trains, looked_up
from jobs.tools.calibrate.found import DRAWS, Found, missing, with_interval

FEWEST_NEAR, NEAR = 5, 0.1  # intervals within a tenth; isolated shorter ones are artefacts of the readout
FEWEST, MOVED = 20, 1.4  # fewest deaf intervals; a deaf interval has a change by more thresholds than this
AGREE = 2.5  # largest factor between the estimate from deaf intervals and the shortest interval


def shortest_us(trains: Trains) -> float:
    """Return the shortest interval between a pixel's events [us], with four others at most a tenth longer.

    Infinite if there is no such interval.
    """
    intervals = np.sort(np.diff(trains.t_us)[np.diff(trains.pixel) == 0].astype(np.float64))
    far = np.searchsorted(intervals, (1.0 + NEAR) * intervals, side="right")
    credible = intervals[far - np.arange(intervals.size) >= FEWEST_NEAR]
    return float(credible[0]) if credible.size else np.inf


def refractory_period(
    trains: Trains, light: Light, thresholds: tuple[float, float], rng: np.random.Generator
) -> Found:
    """Estimate the refractory period [us]: the median over deaf intervals, with its 95 % interval."""
    at = looked_up(light.response, light.times_us, trains.pixel, trains.t_us)
    same = np.diff(trains.pixel) == 0
    polarity, lasted = trains.p[1:][same], np.diff(trains.t_us)[same].astype(np.float64)
    moved = np.diff(at)[same] * polarity / np.where(polarity > 0.0, *thresholds)
    deaf, shortest = moved > MOVED, shortest_us(trains)
    at_most = f"at most {shortest:.0f} us" if np.isfinite(shortest) else "no pixel fires often"
    if deaf.sum() < FEWEST:
        return missing(
            f"between two events of a pixel the light hardly moves by more than a threshold: {at_most}"
        )
    period = lasted[deaf] * (1.0 - 1.0 / moved[deaf])
    value = float(np.median(period))
    if not shortest / AGREE < value < shortest * AGREE:
        return missing(f"pixels miss events, but not for one time: {at_most}")
    drawn = np.median(rng.choice(period, (DRAWS, period.size)), axis=1)
    return with_interval(min(value, shortest), np.minimum(drawn, shortest))
