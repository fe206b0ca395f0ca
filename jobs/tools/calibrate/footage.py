"""What an event camera sent, pixel by pixel, and the response of its pixels to the light of its frames."""

import dataclasses
from typing import NamedTuple

import numpy as np

from envs.config import LUMINANCE_FLOOR, CameraConfig
from envs.events.lowpass import filter_frames, filter_rates, low_pass, start_filter
from envs.events.photoreceptor import Curve, light_of, respond, response_curve


class Trains(NamedTuple):
    """Events ordered by pixel, and by time in each.

    Attributes:
        pixel: Flat pixel y * W + x, int64 (N,).
        t_us: Times [us], int64 (N,).
        p: Polarities, -1.0 or 1.0, float64 (N,).
    """

    pixel: np.ndarray
    t_us: np.ndarray
    p: np.ndarray


class Light(NamedTuple):
    """What pixels responded to.

    Attributes:
        times_us: Of the frames, int64 (K,) [us].
        response: Of each pixel in each frame, float64 (K, P).
        travel: How far it had risen until then, all rises together, float64 (K, P).
    """

    times_us: np.ndarray
    response: np.ndarray
    travel: np.ndarray


def trains_of(events: np.ndarray, width: int) -> Trains:
    """EVENT (N,), sorted by t, of a sensor with so many columns, as trains."""
    pixel = events["y"].astype(np.int64) * width + events["x"]
    order = np.argsort(pixel, kind="stable")
    return Trains(pixel[order], events["t"][order], events["p"][order].astype(np.float64))


def of_pixels(trains: Trains, chosen: np.ndarray) -> Trains:
    """Return the trains of the chosen pixels, bool (P,), which keep their numbers."""
    kept = chosen[trains.pixel]
    return Trains(*(part[kept] for part in trains))


def of_columns(trains: Trains, pixels: np.ndarray) -> Trains:
    """Return the trains of some pixels, int64 (Q,) ascending, numbered by their place there."""
    place = np.minimum(np.searchsorted(pixels, trains.pixel), max(pixels.size - 1, 0))
    kept = pixels[place] == trains.pixel if pixels.size else np.zeros(trains.pixel.size, bool)
    return Trains(place[kept], trains.t_us[kept], trains.p[kept])


def light_behind(luminance: np.ndarray, times_us: np.ndarray, camera: CameraConfig) -> Light:
    """Return the responses of the frames after a camera's bandwidth, float32 (K, P), white = 1.

    A bandwidth of 0 leaves all.
    """
    curve = Curve(*response_curve(camera.response, camera.luminance_floor or LUMINANCE_FLOOR))
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
    """Values of frames, (K, P), at pixels and times (N,): linear between frames, constant beyond the last."""
    late = np.clip(np.searchsorted(times_us, t_us), 1, times_us.size - 1)
    share = (t_us - times_us[late - 1]) / (times_us[late] - times_us[late - 1])
    share = np.clip(share, 0.0, 1.0)
    return values[late - 1, pixel] * (1.0 - share) + values[late, pixel] * share


def with_bandwidth(camera: CameraConfig, cutoff_hz: float) -> CameraConfig:
    """Return the camera with another bandwidth [Hz]; 0: unlimited."""
    return dataclasses.replace(camera, cutoff_hz=cutoff_hz)


def luminance_of(response: np.ndarray, camera: CameraConfig) -> np.ndarray:
    """Return the luminance, white = 1, of these responses; float64 (N,)."""
    levels = np.array(response, np.float64)
    light_of(
        Curve(*response_curve(camera.response, camera.luminance_floor or LUMINANCE_FLOOR)),
        levels,
        np.empty(levels.size, np.int64),
    )
    return np.clip(levels, 0.0, None)
