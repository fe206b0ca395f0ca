"""How many events a sequence of frames misses because nothing is seen between two of them."""

import math

import numpy as np

from envs.config import CameraConfig
from envs.events import EventCamera

MOST_PIXELS = 1 << 14  # that are looked at; they lie on an even grid
FEWEST_INTERVALS = 4
FEWEST_EVENTS = 100
REPEATED = 0.02  # of the largest change from frame to frame, up to which a frame repeats another


class FrameLoss:
    """Compares the events of all frames with those of every other frame.

    Halving the frame rate loses a share s of the events. If what is lost is in proportion to the time between
    frames, the frames as they are miss the share s / (1 + s) of all events. That is about the truth for edges
    that move, and more than the truth for light that changes smoothly. Noise of the frames counts as motion.
    A frame that repeats the one before it shows nothing new, so it is left out.
    """

    def __init__(self, camera: CameraConfig) -> None:
        """Make two ideal cameras with the thresholds, the response and the floor of `camera`."""
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
        """Take the next frame, float32 (H, W), linear."""
        sample = np.ascontiguousarray(luminance[:: self._stride, :: self._stride])
        if self._repeats(sample):
            return
        if self._frames == 0:
            self._every.reset(sample, t_us)
            self._other.reset(sample, t_us)
        else:
            self._since += self._every.step(sample, t_us).size
            if self._frames % 2 == 0:  # both have come to the same time
                self._of_every, self._since = self._of_every + self._since, 0
                self._of_other += self._other.step(sample, t_us).size
        self._frames += 1

    def _repeats(self, sample: np.ndarray) -> bool:
        """Whether a frame is the last one again, as coded; if not, remember it."""
        if self._last is not None:
            change = float(np.abs(sample - self._last).mean(dtype=np.float64))
            if change <= REPEATED * self._largest_change:
                return True
            self._largest_change = max(self._largest_change, change)
        self._last = sample.copy()
        return False

    @property
    def at_half_rate(self) -> float | None:
        """Share of the events that every other frame loses; None: too few frames or events to tell."""
        if self._frames <= FEWEST_INTERVALS or self._of_every < FEWEST_EVENTS:
            return None
        return max(0.0, 1.0 - self._of_other / self._of_every)

    @property
    def share(self) -> float | None:
        """About which share of the scene's events the frames miss; None: too few frames or events to tell."""
        lost = self.at_half_rate
        return None if lost is None else lost / (1.0 + lost)
