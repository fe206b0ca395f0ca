"""The event camera: linear luminance frames in, time-ordered brightness-change events out.

A pixel fires when its response to light (by default the logarithm) has moved by the contrast
threshold from the level that it remembers (appendix E.1, read so that equations 5 to 8 are
well defined). The setting `memory` selects this level:

- "reference": the level moves only by whole thresholds, as in a real sensor, so events do not
  depend on the frame rate. It is stored as a first level and counts, so it does not drift.
- "frame": the level is the response at the previous frame, as in the paper; changes below the
  threshold are forgotten.
- "legacy": the published code of the paper (microsoft/event-vae-rl, event_sim.py). It loses the
  first of the whole thresholds within the difference of two frames, so a step of less than two
  thresholds gives no event. The others are stamped from the start of the interval on, event k
  of n at t_last + k (t - t_last) / n. To match it set `max_events_per_pixel=10` and
  `luminance_floor=0.001 / 255`. Two things differ from the published code: the first event gets
  the time t_last + 1 us instead of t_last, which belongs to the frame before; and microseconds
  are not added to nanoseconds.

Frames between control steps make the events of "reference" more accurate. "frame" and "legacy"
compare each frame with the one before and forget the rest, so more frames cost them events:
give them one frame per control step.
"""

import dataclasses
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np

from envs.config import LUMINANCE_FLOOR, CameraConfig, with_floor
from envs.events import crossings
from envs.events.emission import EVENT, MAX_EVENTS_PER_FRAME
from envs.events.lowpass import filter_frames, filter_rates, low_pass, start_filter
from envs.events.photoreceptor import Curve, encode, encoding_tables, response_curve

__all__ = ["EVENT", "EventCamera"]

LUMINANCE = np.dtype(np.float32)
T_LIMIT_US = 2**52  # 142 years; exact in float64
MIN_THRESHOLD_SHARE = 0.1  # of the nominal threshold, under mismatch
MIN_THRESHOLD = 1e-6


def pixel_thresholds(config: CameraConfig) -> tuple[np.ndarray, np.ndarray]:
    """Return the ON and OFF thresholds, float64 (H * W,) each, or (1,) without mismatch.

    With mismatch they are drawn from `threshold_seed`, normally distributed around the nominal threshold,
    independent for ON and OFF, and never below a tenth of the nominal threshold nor below 1e-6.
    """
    on = config.contrast_threshold
    off = on if config.contrast_threshold_off is None else config.contrast_threshold_off
    nominal = np.array([[on], [off]])
    if config.threshold_mismatch == 0.0:
        return nominal[0], nominal[1]
    draws = np.random.default_rng(config.threshold_seed).standard_normal((2, config.height * config.width))
    share = np.maximum(1.0 + config.threshold_mismatch * draws, MIN_THRESHOLD_SHARE)
    thresholds = np.maximum(nominal * share, MIN_THRESHOLD)
    return thresholds[0], thresholds[1]


class EventCamera:
    """One event camera with its per-pixel memory.

    The same frames, times and settings give the same bytes on any machine, because the
    computation does not use a library's logarithm.

    Attributes:
        config: The settings, `CameraConfig`.
        dropped: Number of events lost in the last step, because a pixel exceeded
            `max_events_per_pixel` or the frame `MAX_EVENTS_PER_FRAME`; the earliest events stay.
            With excess "carry" the excess fires in later frames instead, and `dropped` is 0.
        t_us: Time of the last frame [us].
    """

    def __init__(self, width: int | CameraConfig = 64, height: int = 64, **fields: Any) -> None:
        """Create a camera from sizes and fields, or from a `CameraConfig` and fields to replace.

        Raises:
            ValueError: A setting is unknown, of the wrong type or out of range.
        """
        if isinstance(width, CameraConfig):
            config = dataclasses.replace(width, **fields)
        else:
            config = CameraConfig(width=width, height=height, **fields)
        self.config = config = with_floor(config)
        self.dropped = 0
        self.t_us: int | None = None
        self._shape = (config.height, config.width)
        self._tables = None if config.encoding == "linear32" else encoding_tables(config.encoding)
        rule = crossings.Rule(
            refractory_us=config.refractory_us,
            max_events=config.max_events_per_pixel,
            carries=config.excess == "carry",
            forgets=config.memory != "reference",
            legacy=config.memory == "legacy",
        )
        curve = response_curve(config.response, config.luminance_floor or LUMINANCE_FLOOR)
        thresholds = crossings.threshold_rows(*pixel_thresholds(config), 2 if rule.legacy else 1, curve)
        self._model = tuple(rule), tuple(curve), thresholds
        self._low_pass = low_pass(config.width * config.height) if config.cutoff_hz > 0.0 else None
        num_pixels = config.width * config.height
        self._memory = crossings.memory_rows(num_pixels, config.refractory_us > 0)
        num_words = (num_pixels + 7) // 8
        self._scratch = np.zeros(num_words, np.uint64), np.zeros(8 * num_words, np.int64)

    @property
    def state(self) -> tuple[Any, Any, Any]:
        """Model, memory and scratch, in the form that the kernels take."""
        return self._model, self._memory, self._scratch

    @property
    def pixels(self) -> np.ndarray:
        """Return the flat pixel y * W + x of each pixel of the memory, int64 (H * W,)."""
        return np.arange(self.config.width * self.config.height)

    def reset(self, luminance: np.ndarray, t_us: int) -> None:
        """Remember a first frame; it gives no events, and no pixel is in its refractory period.

        Args:
            luminance: float32 (H, W), linear, finite, >= 0; 1 is white.
            t_us: Time of the frame [us].

        Raises:
            ValueError: Wrong shape, dtype, value or time; the camera stays unchanged.
        """
        flat, t_us = self._checked(_stacked(luminance), 1), checked_time(t_us)
        bad = int(crossings.first_invalid(flat[0]))
        if bad >= 0:
            raise self._invalid(flat, bad)
        seen = flat if self._tables is None else self._encoded(flat)
        if self._low_pass is not None:
            start_filter(seen[0], Curve(*self._model[1]), self._low_pass)
        crossings.remember(seen[0], self._model, self._memory)
        self.t_us, self.dropped = t_us, 0

    def step(self, luminance: np.ndarray, t_us: int) -> np.ndarray:
        """Return the events between the last frame and this one (appendix E.1).

        Times are interpolated linearly in the response and rounded to whole microseconds.

        Args:
            luminance: float32 (H, W), linear, finite, >= 0; 1 is white. It is copied.
            t_us: Time of the frame [us], later than the last frame's.

        Returns:
            EVENT array with t in (t_last, t_us], sorted by (t, y, x, order in the pixel).

        Raises:
            ValueError: No reset yet, or wrong shape, dtype, value or time; the camera stays
                unchanged and accepts the next valid frame.
        """
        return self.steps(_stacked(luminance), (t_us,))

    def steps(self, frames: np.ndarray, times_us: Sequence[int]) -> np.ndarray:
        """Return the events of several successive frames in one call.

        Args:
            frames: float32 (K, H, W), K >= 1, each as for `step`.
            times_us: Times of the frames [us], increasing.

        Returns:
            EVENT array with t in (t_last, times_us[-1]], sorted; the same bytes as K calls of
            `step`. `dropped` counts the events lost in all K frames.

        Raises:
            ValueError: As for `step`; if one frame or time is invalid, the camera stays unchanged.
        """
        if self.t_us is None:
            raise ValueError("EventCamera.step needs a first frame; call reset(luminance, t_us) before it.")
        flat, times = self._checked(frames, len(times_us)), np.empty(len(times_us) + 1, np.int64)
        times[0] = last_us = self.t_us
        for k, t_us in enumerate(times_us, 1):
            times[k] = new_us = checked_time(t_us)
            if new_us <= last_us:
                raise ValueError(f"t_us must increase from frame to frame; got {t_us} after {last_us}.")
            last_us = new_us
        seen = flat if self._tables is None else self._encoded(flat)
        bad, dropped, events = crossings.steps(
            seen if self._low_pass is None else self._filtered(seen, times),
            times,
            self.config.width,
            MAX_EVENTS_PER_FRAME,
            self._model,
            self._memory,
            self._scratch,
        )
        if bad >= 0:
            raise self._invalid(flat, bad)
        self.t_us, self.dropped = last_us, dropped
        return events

    def _encoded(self, flat: np.ndarray) -> np.ndarray:
        """Return the frames (K, N) after the 8-bit encoding."""
        assert self._tables is not None  # noqa: S101  for the type checker
        encoded = np.empty_like(flat)
        bad = int(encode(flat.ravel(), *self._tables, encoded.ravel()))
        if bad >= 0:
            raise self._invalid(flat, bad)
        return encoded

    def _filtered(self, seen: np.ndarray, times_us: np.ndarray) -> np.ndarray:
        """Return the frames (K, N) after the low-pass filter of the photoreceptors."""
        bad = int(crossings.first_invalid(seen.ravel()))
        if bad >= 0:
            raise self._invalid(seen, bad)
        filtered: np.ndarray = filter_frames(
            seen, times_us, Curve(*self._model[1]), filter_rates(self.config), self._low_pass
        )
        return filtered

    def _checked(self, frames: np.ndarray, count: int) -> np.ndarray:
        """Return the frames as a contiguous (K, N) array."""
        if getattr(frames, "dtype", None) != LUMINANCE or frames.shape != (count, *self._shape) or not count:
            dtype, shape = getattr(frames, "dtype", type(frames)), getattr(frames, "shape", ())[1:]
            raise ValueError(f"luminance must be float32 {self._shape}; got {dtype} of shape {shape}.")
        return frames.reshape(count, -1)

    def _invalid(self, flat: np.ndarray, pixel: int) -> ValueError:
        """Return the error for a value that is not a luminance."""
        y, x = divmod(pixel % flat.shape[1], self.config.width)
        return ValueError(f"luminance must be finite and >= 0; pixel x={x}, y={y} is {flat.flat[pixel]!s}.")


def _stacked(luminance: np.ndarray) -> np.ndarray:
    """Return one frame as a stack of one; anything but an array is returned unchanged and raises later."""
    return luminance[None] if isinstance(luminance, np.ndarray) else luminance


def checked_time(t_us: int) -> int:
    """Return a time as an int. Raises ValueError unless it is a whole number within +-2**52 [us]."""
    try:
        t_us = operator.index(t_us)
    except TypeError:
        raise ValueError(f"t_us must be an integer number of microseconds; got {t_us!r}.") from None
    if not -T_LIMIT_US < t_us < T_LIMIT_US:
        raise ValueError(f"t_us must lie within +-2**52; got {t_us}.")
    return t_us
