"""Estimate contrast thresholds from counts of events and the light of frames.

Right after an event a pixel's response is its remembered level, and this level is a staircase: the response
at the k-th event is c + on * (ON events so far) - off * (OFF events so far). Both thresholds are estimated
from runs of sixteen events of a pixel, so that slow drift (leakage) has no effect. The counts are uncertain,
because noise causes events too. So the equations are not least squares; they use instrumental variables from
the frames alone: the response, and the sum of its rises.
"""

from typing import NamedTuple

import numpy as np

from jobs.analysis.statistics import CONFIDENCE
from jobs.tools.calibrate.footage import Light, Trains, looked_up
from jobs.tools.calibrate.found import TAILS, Found, at_most, missing, neither, resampled, with_interval

RUN = 16  # consecutive events of a pixel that are compared with each other
FEWEST_EVENTS = 200  # of all pixels together
FEWEST_IN_HALF = 24  # events in each half of a pixel's runs, for its own thresholds
HIGHEST = 10.0  # highest threshold of a camera (envs.config.CameraConfig)
NEGLIGIBLE = 1e-3  # mismatch at the level of rounding
WIDEST = 1.0  # widest interval, about four standard errors, as a share of the value


class Stairs(NamedTuple):
    """Events and the light at their times, each minus its mean over the event's run, float64 (N,).

    Attributes:
        response: Response of the pixel at the event.
        on, off: Numbers of ON and OFF events so far, including this one.
        rise: Sum of the rises of the response so far.
        polarity: Polarity of the event.
        half: 2 * (pixel number) + (1 if the event is in an odd run), int64 (N,).
    """

    response: np.ndarray
    on: np.ndarray
    off: np.ndarray
    rise: np.ndarray
    polarity: np.ndarray
    half: np.ndarray


class Equations(NamedTuple):
    """Two pairs of equations for (on, off) of each pixel, each pair from one half of its runs.

    Attributes:
        matrix: Coefficients: half, pixel, equation, unknown; float64 (2, P, 2, 2).
        right: Right-hand sides, float64 (2, P, 2).
        events: Number of events in each pair, float64 (2, P).
    """

    matrix: np.ndarray
    right: np.ndarray
    events: np.ndarray


def staircase(trains: Trains, light: Light, refractory_us: float) -> Stairs:
    """Return the events of P pixels as steps of staircases.

    Changes of the response during dead times are subtracted, because a pixel takes the light at the end of
    its dead time as its level.
    """
    start = np.searchsorted(trains.pixel, trains.pixel)
    place = np.arange(trains.pixel.size) - start
    at = looked_up(light.response, light.times_us, trains.pixel, trains.t_us)
    lost = np.zeros(at.size)
    if refractory_us > 0:
        later = trains.t_us + round(refractory_us)
        lost = looked_up(light.response, light.times_us, trains.pixel, later) - at
    before = np.cumsum(lost) - lost
    rise = looked_up(light.travel, light.times_us, trains.pixel, trains.t_us)
    run = np.cumsum(place % RUN == 0) - 1
    counts = np.cumsum(trains.p > 0.0), np.cumsum(trains.p < 0.0)
    columns = at - (before - before[start]), *counts, rise, trains.p
    size = np.bincount(run)
    response, on, off, rise, polarity = (part - (np.bincount(run, part) / size)[run] for part in columns)
    return Stairs(response, on, off, rise, polarity, 2 * trains.pixel + (place // RUN) % 2)


def equations(trains: Trains, light: Light, refractory_us: float) -> Equations:
    """Return the equations of all P pixels of `light`."""
    response, on, off, rise, _, half = staircase(trains, light, refractory_us)
    rows = 2 * light.response.shape[1]
    sums = [np.bincount(half, a * b, rows) for a in (response, rise) for b in (on, -off, response)]
    table = np.stack(sums, axis=-1).reshape(-1, 2, 2, 3).swapaxes(0, 1)  # half, pixel, instrument, unknown
    events = np.bincount(half, minlength=rows).astype(np.float64).reshape(-1, 2).T
    return Equations(table[..., :2], table[..., 2], events)


def thresholds(found: Equations, rng: np.random.Generator) -> tuple[Found, Found]:
    """Estimate the ON and OFF threshold of all pixels together, with intervals over pixels."""
    matrix, right = found.matrix.sum(axis=0), found.right.sum(axis=0)
    if found.events.sum() < FEWEST_EVENTS:
        return neither(f"fewer than {FEWEST_EVENTS} events between the frames")
    if is_singular(matrix.sum(axis=0)):
        return neither("frames that never change the light of a pixel by a threshold")
    value = np.linalg.solve(matrix.sum(axis=0), right.sum(axis=0))
    weights = resampled(len(right), rng)
    drawn, sums = np.tensordot(weights, matrix, 1), weights @ right
    sound = ~is_singular(drawn)
    if sound.mean() < CONFIDENCE:
        return neither("too few pixels whose light changes")
    drawn = np.linalg.solve(drawn[sound], sums[sound][..., None])[..., 0]
    on, off = (with_interval(value[k], drawn[:, k]) for k in range(2))
    # With frames of another scene the solution is arbitrary, and its interval wide.
    width = np.max((on.high - on.low, off.high - off.low) / value)
    if not (np.min((on.low, off.low)) > 0.0 and max(value) <= HIGHEST and width < WIDEST):
        return neither(
            "frames and events do not fit each other: check the clock and `calibrate.frame_delay_us`"
        )
    return on, off


def is_singular(matrix: np.ndarray) -> np.ndarray:
    """Test which of the equations, (..., 2, 2), have no unique solution; bool (...)."""
    determinant = matrix[..., 0, 0] * matrix[..., 1, 1] - matrix[..., 0, 1] * matrix[..., 1, 0]
    return ~(np.abs(determinant) > 1e-9 * np.square(matrix).sum(axis=(-2, -1)))


def mismatch(found: Equations, values: tuple[float, float], rng: np.random.Generator) -> Found:
    """Compute the standard deviation of the thresholds over pixels, as a share of the mean.

    Each pixel's thresholds are estimated twice, from the two halves of its runs. The pixel's own deviation is
    common to both, while chance is not: so the covariance of the two is the variance over pixels. If the
    mismatch may be 0, only an upper limit is returned.
    """
    good = (found.events >= FEWEST_IN_HALF).all(axis=0)
    matrix = found.matrix[:, good]
    size = np.sqrt(np.square(matrix).sum(axis=(2, 3)))
    sound = (np.abs(np.linalg.det(matrix)) > 1e-3 * np.square(size)).all(axis=0)
    if sound.sum() < 50:
        return missing(f"fewer than 50 pixels with {2 * FEWEST_IN_HALF} events or more between the frames")
    halves = np.linalg.solve(matrix[:, sound], found.right[:, good][:, sound][..., None])[..., 0]
    share = np.clip(halves / np.asarray(values), 0.0, 3.0)
    weights = resampled(int(sound.sum()), rng)
    mean = np.tensordot(weights, share, (1, 1)) / weights.shape[1]  # draw, half, polarity
    product = np.tensordot(weights, share[0] * share[1], 1) / weights.shape[1]
    drawn = (product - mean[:, 0] * mean[:, 1]).mean(axis=1)
    deviations = share - share.mean(axis=1, keepdims=True)
    variance = float((deviations[0] * deviations[1]).mean())
    low, high = np.quantile(drawn, TAILS)
    if not low > NEGLIGIBLE**2:  # widened like a corrected value
        return at_most(float(np.sqrt(max(variance, 0.0) + 2**0.5 * (high - variance))))
    if variance > 1.0:
        return missing("frames and events do not fit each other: thresholds differ by more than their mean")
    return Found(variance**0.5, float(low**0.5), float(high**0.5))
