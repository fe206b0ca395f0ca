"""Estimate the fraction of events that a sequence of frames misses between the frames."""

import math

import numpy as np

from envs.config import CameraConfig
from envs.events import EventCamera

MOST_PIXELS = 1 << 14  # pixels to sample, on a regular grid
FEWEST_INTERVALS = 4
FEWEST_EVENTS = 100
REPEATED = 0.02  # a frame that changes by at most this fraction of the largest change repeats the last one


class FrameLoss:
    """Compare the events of all frames with the events of every other frame.

    Halving the frame rate loses a fraction s of the events. If the loss is proportional to the time between
    frames, the frames miss the fraction s / (1 + s) of all events. This is about right for moving edges, and
    too high for light that changes smoothly. Noise of the frames counts as motion. A frame that repeats the
    one before it shows nothing new and is left out.
    """

    def __init__(self, camera: CameraConfig) -> None:
        """Create two ideal cameras with the thresholds, response and luminance floor of `camera`."""
        self._stride = math.ceil(math.sqrt(camera.width * camera.height / MOST_PIXELS))
        ideal = CameraConfig(
            width=len(range(0, camera.width, self._stride)),
            height=len(range(0, camera.height, self._stride)),
            contrast_threshold=camera.contrast_threshold,
            contrast_threshold_off=camera.contrast_threshold_off,
            luminance_floor=camera.luminance_floor,
            response=camera.response,
            max_events_per_pixel=100_000,
        )
        self._every, self._other = EventCamera(ideal), EventCamera(ideal)
        self._frames, self._since = 0, 0
        self._of_every, self._of_other = 0, 0
        self._last: np.ndarray | None = None
        self._largest_change = 0.0

    def see(self, luminance: np.ndarray, t_us: int) -> None:
        """Add the next frame, float32 (H, W), linear."""
        sample = np.ascontiguousarray(luminance[:: self._stride, :: self._stride])
        if self._repeats(sample):
            return
        if self._frames == 0:
            self._every.reset(sample, t_us)
            self._other.reset(sample, t_us)
        else:
            self._since += self._every.step(sample, t_us).size
            if self._frames % 2 == 0:  # both cameras are at the same time
                self._of_every, self._since = self._of_every + self._since, 0
                self._of_other += self._other.step(sample, t_us).size
        self._frames += 1

    def _repeats(self, sample: np.ndarray) -> bool:
        """Whether a frame repeats the last one, apart from coding noise; if not, store it."""
        if self._last is not None:
            change = float(np.abs(sample - self._last).mean(dtype=np.float64))
            if change <= REPEATED * self._largest_change:
                return True
            self._largest_change = max(self._largest_change, change)
        self._last = sample.copy()
        return False

    @property
    def at_half_rate(self) -> float | None:
        """Fraction of events lost with every other frame; None: too few frames or events to estimate it."""
        if self._frames <= FEWEST_INTERVALS or self._of_every < FEWEST_EVENTS:
            return None
        return max(0.0, 1.0 - self._of_other / self._of_every)

    @property
    def share(self) -> float | None:
        """Estimated fraction of the scene's events that the frames miss; None: too few frames or events."""
        lost = self.at_half_rate
        return None if lost is None else lost / (1.0 + lost)
