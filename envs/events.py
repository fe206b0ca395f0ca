"""The event camera: linear luminance frames in, time-ordered brightness-change events out.

A pixel fires when the logarithm of its luminance has moved by the contrast threshold from
the level that it remembers (appendix E.1, read so that equations 5 to 8 are well founded).
With `memory="reference"` that level moves only by whole thresholds, as in a real sensor, so
slow change is never lost; it is held as the first log level plus integer counts, so it does
not drift. With `memory="frame"` it is the previous frame, as the paper has it, and what
stays below the threshold is forgotten.
"""

import dataclasses
import operator
from typing import Any

import numpy as np

from envs import crossings
from envs.config import CameraConfig
from envs.crossings import EVENT

__all__ = ["EVENT", "EventCamera"]

T_LIMIT_US = 2**52  # exact in float64, 142 years


class EventCamera:
    """One event camera with its per-pixel memory.

    Attributes:
        config: The settings, `CameraConfig`.
        dropped: Events lost to `max_events_per_pixel` in the last step.
        t_us: Time of the last frame [us].
    """

    def __init__(self, width: int | CameraConfig = 64, height: int = 64, **fields: Any) -> None:
        """Make a camera from sizes and fields, or from a `CameraConfig` and fields to replace.

        Raises:
            ValueError: A setting is unknown, of the wrong type or out of range.
        """
        if isinstance(width, CameraConfig):
            config = dataclasses.replace(width, **fields)
        else:
            config = CameraConfig(width=width, height=height, **fields)
        self.config = config
        self.dropped = 0
        self.t_us: int | None = None
        on, off = config.contrast_threshold, config.contrast_threshold_off
        self._response = (on, on if off is None else off, config.luminance_floor)
        self._forgets = config.memory == "frame"
        self._shape = (config.height, config.width)
        pixels = config.width * config.height
        self._previous = np.zeros(pixels, np.float32)  # last frame
        self._band = np.zeros((2, pixels), np.float32)  # quiet from row 0 to row 1, both included
        self._level = np.zeros((3, pixels))  # first log luminance, ON count, OFF count
        self._words = np.zeros((pixels + 7) // 8, np.uint64)  # scratch: one flag a pixel, padded
        self._outside = np.zeros(8 * self._words.size, np.int64)  # scratch: pixels to decide

    def reset(self, luminance: np.ndarray, t_us: int) -> None:
        """Remember a first frame; it makes no events.

        Args:
            luminance: float32 (H, W), linear, finite, >= 0.
            t_us: Its time [us].

        Raises:
            ValueError: Wrong shape, dtype, value or time; the camera is unchanged.
        """
        flat, t_us = self._checked(luminance, t_us)
        bad = int(crossings.first_invalid(flat))
        if bad >= 0:
            raise self._refusal(flat, bad)
        crossings.remember(flat, self._response, self._previous, self._band, self._level)
        self.t_us, self.dropped = t_us, 0

    def step(self, luminance: np.ndarray, t_us: int) -> np.ndarray:
        """Events between the last frame and this one (appendix E.1).

        Times are interpolated linearly in log luminance and rounded to whole microseconds.

        Args:
            luminance: float32 (H, W), linear, finite, >= 0. It is copied.
            t_us: Its time [us], later than the last frame's.

        Returns:
            EVENT array with t in (t_last, t_us], sorted by (t, y, x, order in the pixel).

        Raises:
            ValueError: No reset yet, or wrong shape, dtype, value or time; the camera is
                unchanged and takes the next good frame.
        """
        flat, t_us = self._checked(luminance, t_us)
        if self.t_us is None:
            raise ValueError("EventCamera.step needs a first frame; call reset(luminance, t_us) before it.")
        if t_us <= self.t_us:
            raise ValueError(f"t_us must increase from frame to frame; got {t_us} after {self.t_us}.")
        bad, dropped, events = crossings.step(
            flat,
            (self.t_us, t_us, self.config.width, self.config.max_events_per_pixel),
            self._forgets,
            self._response,
            (self._previous, self._band, self._level, self._words, self._outside),
        )
        if bad >= 0:
            raise self._refusal(flat, bad)
        self.t_us, self.dropped = t_us, dropped
        return events

    def _checked(self, luminance: np.ndarray, t_us: int) -> tuple[np.ndarray, int]:
        """The frame as a flat contiguous array and the time as an int."""
        if getattr(luminance, "dtype", None) != np.float32 or luminance.shape != self._shape:
            dtype, shape = getattr(luminance, "dtype", type(luminance)), getattr(luminance, "shape", None)
            raise ValueError(f"luminance must be float32 {self._shape}; got {dtype} of shape {shape}.")
        try:
            t_us = operator.index(t_us)
        except TypeError:
            raise ValueError(f"t_us must be an integer number of microseconds; got {t_us!r}.") from None
        if not -T_LIMIT_US < t_us < T_LIMIT_US:
            raise ValueError(f"t_us must lie within +-2**52; got {t_us}.")
        return luminance.ravel(), t_us

    def _refusal(self, flat: np.ndarray, pixel: int) -> ValueError:
        """The error for a value that is not a luminance."""
        y, x = divmod(pixel, self.config.width)
        return ValueError(f"luminance must be finite and >= 0; pixel x={x}, y={y} is {flat[pixel]!s}.")
