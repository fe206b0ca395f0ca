"""Compare simulated events with recorded ones: rates, intervals, polarities, neighbours."""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter

from jobs.tools.calibrate.footage import trains_of

INTERVALS_MS = np.geomspace(0.1, 200.0, 34)


class Likeness(NamedTuple):
    """Figures of one set of events.

    Attributes:
        rate_hz: Events per pixel and second [Hz].
        on_share: Share of ON events.
        same_share: Share of events with the polarity of the pixel's previous event.
        median_ms: Median interval between two events of a pixel [ms].
        neighbours: Correlation between the net events of a pixel and its right neighbour, frame by frame.
        real: Correlation between blurred net events and the recorded ones, frame by frame; 1 for the
            recording itself.
        intervals: Share of the intervals in each of `INTERVALS_MS`, float64 (33,).
    """

    rate_hz: float
    on_share: float
    same_share: float
    median_ms: float
    neighbours: float
    real: float
    intervals: np.ndarray


def net_images(events: np.ndarray, times_us: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Sum the polarities of each pixel between each frame and the next, float64 (K - 1, H, W)."""
    interval = np.searchsorted(times_us, events["t"], side="left") - 1
    inside = (interval >= 0) & (interval < times_us.size - 1)
    flat = (interval * shape[0] + events["y"]) * shape[1] + events["x"]
    size = (times_us.size - 1) * shape[0] * shape[1]
    return np.bincount(flat[inside], events["p"][inside], size).reshape(-1, *shape)


def likeness(
    events: np.ndarray, recorded: np.ndarray, times_us: np.ndarray, shape: tuple[int, int]
) -> Likeness:
    """Compare EVENT with the recorded events, both between the first and the last frame time [us]."""
    trains = trains_of(events, shape[1])
    same = np.diff(trains.pixel) == 0
    lasted = np.diff(trains.t_us)[same] * 1e-3
    alike = (np.diff(trains.p) == 0.0)[same]
    images = net_images(events, times_us, shape)
    blurred = [
        gaussian_filter(part, (0, 1, 1)).ravel() for part in (images, net_images(recorded, times_us, shape))
    ]
    counts = np.histogram(lasted, INTERVALS_MS)[0]
    return Likeness(
        len(events) / (shape[0] * shape[1]) / (1e-6 * (times_us[-1] - times_us[0])),
        float((trains.p > 0.0).mean()),
        float(alike.mean()),
        float(np.median(lasted)),
        float(np.corrcoef(images[..., :-1].ravel(), images[..., 1:].ravel())[0, 1]),
        float(np.corrcoef(*blurred)[0, 1]),
        counts / max(counts.sum(), 1),
    )
