"""Refractory period: how long a pixel is deaf after an event, where the light moves on in that time.

At the end of its refractory period a pixel takes the light as its level, and fires one threshold later. So
where the light moves by more than a threshold until a pixel's next event, the pixel was deaf for all of the
interval but the part in which the light moved by a threshold. It was never deaf for longer than the shortest
interval, which in a still scene is all that is known.
"""

import numpy as np

from jobs.tools.calibrate.footage import Light, Trains, looked_up
from jobs.tools.calibrate.found import DRAWS, Found, missing, with_interval

FEWEST_NEAR, NEAR = 5, 0.1  # so many intervals within a tenth: a single shorter one is a slip of the readout
FEWEST, MOVED = 20, 1.4  # deaf intervals, and thresholds that the light moves in one
AGREE = 2.5  # most that what deaf intervals say and the shortest one may differ by, as a factor


def shortest_us(trains: Trains) -> float:
    """Return the shortest interval with four others within a tenth of it [us]; infinite if there is none."""
    intervals = np.sort(np.diff(trains.t_us)[np.diff(trains.pixel) == 0].astype(np.float64))
    far = np.searchsorted(intervals, (1.0 + NEAR) * intervals, side="right")
    credible = intervals[far - np.arange(intervals.size) >= FEWEST_NEAR]
    return float(credible[0]) if credible.size else np.inf


def refractory_period(
    trains: Trains, light: Light, thresholds: tuple[float, float], rng: np.random.Generator
) -> Found:
    """Estimate the refractory period [us], the median over deaf intervals, with its interval over these."""
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
