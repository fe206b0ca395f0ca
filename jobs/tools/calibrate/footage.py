"""Frames of an event camera, its events ordered by pixel, and the response of its pixels to light."""

from typing import NamedTuple

import numpy as np

from envs.config import LUMINANCE_FLOOR, CameraConfig, FaultsConfig
from envs.events import EventCamera, RealSensor
from envs.events.lowpass import filter_frames, filter_rates, low_pass, start_filter
from envs.events.photoreceptor import Curve, light_of, respond, response_curve


class Footage(NamedTuple):
    """Frames of a sensor.

    Attributes:
        luminance: Linear luminance, white = 1, float32 (K, H, W).
        times_us: Times of the frames, ascending, int64 (K,) [us].
    """

    luminance: np.ndarray
    times_us: np.ndarray

    @property
    def flat(self) -> np.ndarray:
        """Return the luminance as float32 (K, H * W)."""
        return self.luminance.reshape(len(self.luminance), -1)

    @property
    def is_still(self) -> bool:
        """Whether all frames are equal."""
        return bool((self.luminance == self.luminance[0]).all())


class Trains(NamedTuple):
    """Events ordered by pixel, and by time within each pixel.

    Attributes:
        pixel: Flat pixel y * W + x, int64 (N,).
        t_us: Times [us], int64 (N,).
        p: Polarities, -1.0 or 1.0, float64 (N,).
    """

    pixel: np.ndarray
    t_us: np.ndarray
    p: np.ndarray


class Light(NamedTuple):
    """Response of pixels to the light of frames.

    Attributes:
        times_us: Times of the frames, int64 (K,) [us].
        response: Response of each pixel in each frame, float64 (K, P).
        travel: Sum of all rises of the response up to each frame, float64 (K, P).
    """

    times_us: np.ndarray
    response: np.ndarray
    travel: np.ndarray


def still_footage(shape: tuple[int, int], luminance: float, span_us: tuple[int, int]) -> Footage:
    """Return two equal frames of a uniform scene at the ends of a span [us]."""
    return Footage(np.full((2, *shape), luminance, np.float32), np.array(span_us, np.int64))


def simulate(footage: Footage, camera: CameraConfig, faults: FaultsConfig, seed: int) -> np.ndarray:
    """Simulate the events, EVENT, of a sensor that sees frames of its size."""
    eye, times = EventCamera(camera), footage.times_us.tolist()
    eye.reset(footage.luminance[0], times[0])
    sensor = RealSensor(camera, faults, (eye.state, eye.pixels), np.random.default_rng(seed), times[0])
    steps = zip(footage.luminance[1:], times[:-1], times[1:], strict=True)
    return np.concatenate([sensor.events(eye.step(frame, end), begin, end) for frame, begin, end in steps])


def trains_of(events: np.ndarray, width: int) -> Trains:
    """Convert EVENT (N,), sorted by t, of a sensor of this width into trains."""
    pixel = events["y"].astype(np.int64) * width + events["x"]
    order = np.argsort(pixel, kind="stable")
    return Trains(pixel[order], events["t"][order], events["p"][order].astype(np.float64))


def of_pixels(trains: Trains, chosen: np.ndarray) -> Trains:
    """Return the trains of the chosen pixels, bool (P,), with unchanged pixel numbers."""
    kept = chosen[trains.pixel]
    return Trains(*(part[kept] for part in trains))


def of_columns(trains: Trains, pixels: np.ndarray) -> Trains:
    """Return the trains of some pixels, int64 (Q,) ascending, renumbered by their index in `pixels`."""
    place = np.minimum(np.searchsorted(pixels, trains.pixel), max(pixels.size - 1, 0))
    kept = pixels[place] == trains.pixel if pixels.size else np.zeros(trains.pixel.size, bool)
    return Trains(place[kept], trains.t_us[kept], trains.p[kept])


def light_behind(luminance: np.ndarray, times_us: np.ndarray, camera: CameraConfig) -> Light:
    """Return the response to frames, float32 (K, P), white = 1, after the low-pass filter of a camera.

    A cutoff of 0 Hz does not filter.
    """
    curve = _curve(camera)
    if camera.cutoff_hz > 0.0:
        pixels = low_pass(luminance.shape[1])
        start_filter(np.ascontiguousarray(luminance[0]), curve, pixels)
        rest = np.ascontiguousarray(luminance[1:])
        rest = filter_frames(rest, times_us, curve, filter_rates(camera), pixels)
        luminance = np.concatenate((luminance[:1], rest))
    levels, room = np.empty(luminance.size), np.empty(luminance.size, np.int64)
    respond(curve, np.ascontiguousarray(luminance, np.float32).ravel(), levels, room)
    response = levels.reshape(luminance.shape)
    rises = np.maximum(np.diff(response, axis=0), 0.0)
    return Light(times_us, response, np.concatenate((np.zeros((1, rises.shape[1])), rises.cumsum(axis=0))))


def looked_up(values: np.ndarray, times_us: np.ndarray, pixel: np.ndarray, t_us: np.ndarray) -> np.ndarray:
    """Return values of frames (K, P) at pixels and times (N,).

    Values are linear between frames, and constant before the first and after the last.
    """
    late = np.clip(np.searchsorted(times_us, t_us), 1, times_us.size - 1)
    share = (t_us - times_us[late - 1]) / (times_us[late] - times_us[late - 1])
    share = np.clip(share, 0.0, 1.0)
    return values[late - 1, pixel] * (1.0 - share) + values[late, pixel] * share


def luminance_of(response: np.ndarray, camera: CameraConfig) -> np.ndarray:
    """Return the luminance, white = 1, of these responses; float64 (N,)."""
    levels = np.array(response, np.float64)
    light_of(_curve(camera), levels, np.empty(levels.size, np.int64))
    return np.clip(levels, 0.0, None)


def _curve(camera: CameraConfig) -> Curve:
    """Return the response curve of a camera's pixels."""
    return Curve(*response_curve(camera.response, camera.luminance_floor or LUMINANCE_FLOOR))
