"""Estimate all settings of a sensor from one recording, each by its own estimator, in order of dependence.

Noise makes pixels fire early, and its effect on thresholds and bandwidth depends on all other settings. So
the frames are simulated with the estimated settings, the same estimators are applied to the simulated events,
and their error there corrects the estimates.
"""

import dataclasses
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

import numpy as np

from envs.config import CameraConfig, FaultsConfig
from jobs.tools.calibrate.bandwidth import bandwidth
from jobs.tools.calibrate.dead_time import refractory_period
from jobs.tools.calibrate.footage import (
    Footage,
    Light,
    Trains,
    light_behind,
    luminance_of,
    of_pixels,
    simulate,
    trains_of,
)
from jobs.tools.calibrate.found import Found, at_most, missing
from jobs.tools.calibrate.hot_pixels import hot_pixels, hot_settings, unexplained
from jobs.tools.calibrate.likeness import net_images
from jobs.tools.calibrate.noise import FEWEST_PIXELS, noise_rates, still_rates
from jobs.tools.calibrate.thresholds import NEGLIGIBLE, equations, mismatch, thresholds

STILL = 1 / 3  # a pixel rests if its response changes by less than this share of a threshold
FEWEST_EVENTS = 1000
PARTS, TOGETHER = (1, 24), 0.1  # parts of a still recording; largest correlation of neighbours in a part
PASSES, SETTLED = 3, 0.02  # iterations of bandwidth and refractory period, which depend on each other
ON, OFF, MISMATCH = "camera.contrast_threshold", "camera.contrast_threshold_off", "camera.threshold_mismatch"
CUTOFF, DEAD = "camera.cutoff_hz", "camera.refractory_us"
LEAK, SHOT = "faults.leak_hz", "faults.shot_noise_hz"
HOT_SHARE, HOT_HZ = "faults.hot_pixel_share", "faults.hot_pixel_hz"
NAMES = (ON, OFF, MISMATCH, CUTOFF, DEAD, LEAK, SHOT, HOT_SHARE, HOT_HZ)
BY_LIGHT = (ON, OFF, MISMATCH, CUTOFF, DEAD)
NEEDS_LIGHT = "a still scene does not tell it; give frames of a moving one with `calibrate.frames`"


class Calibration(NamedTuple):
    """Settings of a sensor estimated from a recording.

    Attributes:
        found: Name in `NAMES` -> estimate.
        hot: Mask of the hot pixels, bool (H, W).
    """

    found: dict[str, Found]
    hot: np.ndarray


def estimate(events: np.ndarray, footage: Footage, camera: CameraConfig, seed: int = 0) -> Calibration:
    """Estimate the settings of the sensor that reported the events while it saw the frames.

    Args:
        events: EVENT, sorted by t; events before the first or after the last frame are ignored.
        footage: Frames of the sensor's size, or `still_footage`.
        camera: Supplies the response, and the settings that the recording does not determine.
        seed: Seed of the resamples and of the simulated recording.

    Raises:
        ValueError: There are too few events between the first and the last frame, or the scene of a recording
            without frames was not still.
    """
    begin, end = int(footage.times_us[0]), int(footage.times_us[-1])
    events = events[(events["t"] > begin) & (events["t"] <= end)]
    if len(events) < FEWEST_EVENTS:
        raise ValueError(
            f"must have at least {FEWEST_EVENTS} events between the first and the last frame, "
            f"got {len(events)}; record longer, or more light that changes"
        )
    shape = footage.luminance.shape[1:]
    if footage.is_still:
        refuse_motion(events, (begin, end), shape)
    camera = dataclasses.replace(camera, height=shape[0], width=shape[1])
    trains, rng = trains_of(events, shape[1]), np.random.default_rng(seed)
    light = light_behind(footage.flat, footage.times_us, dataclasses.replace(camera, cutoff_hz=0.0))
    beyond = unexplained(trains, light, _rough(trains, footage, light, camera, rng))
    hot = hot_pixels(beyond)
    found = dict(zip((HOT_SHARE, HOT_HZ), hot_settings(beyond, hot, 1e-6 * (end - begin), rng), strict=True))
    sound = of_pixels(trains, ~hot)
    found |= by_light(sound, footage, camera, rng)
    found |= by_noise(sound, footage, with_found(camera, found), ~hot)
    if not footage.is_still:
        again = simulate(footage, *settings(camera, found, {HOT_SHARE, HOT_HZ}), seed)
        found |= corrected(found, by_light(trains_of(again, shape[1]), footage, camera, rng))
    return Calibration({name: found[name] for name in NAMES}, hot.reshape(shape))


def refuse_motion(events: np.ndarray, span_us: tuple[int, int], shape: tuple[int, int]) -> None:
    """Raise ValueError if neighbouring pixels fire together, which noise alone does not cause."""
    for parts in PARTS:
        images = net_images(events, np.linspace(*span_us, parts + 1), shape)
        sides = images[..., :-1].ravel(), images[..., 1:].ravel()
        together = float(np.corrcoef(*sides)[0, 1]) if min(map(np.ptp, sides)) > 0.0 else 0.0
        if together > TOGETHER:
            raise ValueError(
                "must be of a still scene, or come with `calibrate.frames`: neighbouring pixels fire "
                f"together, r = {together:.2f}, and by noise they would not"
            )


def by_light(
    trains: Trains, footage: Footage, camera: CameraConfig, rng: np.random.Generator
) -> dict[str, Found]:
    """Estimate the settings that changing light reveals: thresholds, mismatch, bandwidth, dead time."""
    if footage.is_still:
        return dict.fromkeys(BY_LIGHT, missing(NEEDS_LIGHT))
    flat, times_us = footage.flat, footage.times_us
    dead_us = 0.0
    for _ in range(PASSES):
        cutoff = bandwidth(trains, flat, times_us, camera, dead_us, rng)
        light = light_behind(flat, times_us, dataclasses.replace(camera, cutoff_hz=cutoff.value or 0.0))
        table = equations(trains, light, dead_us)
        on, off = thresholds(table, rng)
        if on.value is None or off.value is None:
            return {ON: on, OFF: off} | dict.fromkeys((MISMATCH, CUTOFF, DEAD), missing(on.reason))
        values = on.value, off.value
        dead = refractory_period(trains, light, values, rng)
        before, dead_us = dead_us, dead.value or 0.0
        if abs(dead_us - before) <= SETTLED * dead_us:
            break
    return {ON: on, OFF: off, MISMATCH: mismatch(table, values, rng), CUTOFF: cutoff, DEAD: dead}


def by_noise(trains: Trains, footage: Footage, camera: CameraConfig, sound: np.ndarray) -> dict[str, Found]:
    """Estimate leakage and shot noise from pixels under constant light among the `sound` ones, bool (P,)."""
    light = light_behind(footage.flat, footage.times_us, camera)
    least = min(camera.contrast_threshold, camera.contrast_threshold_off or camera.contrast_threshold)
    still = sound & (np.ptp(light.response, axis=0) < STILL * least)
    if still.sum() < FEWEST_PIXELS:
        reason = f"fewer than {FEWEST_PIXELS} pixels whose light rests"
        return dict.fromkeys((LEAK, SHOT), missing(reason))
    span_us = int(footage.times_us[0]), int(footage.times_us[-1])
    seen = still_rates(of_pixels(trains, still), still, span_us)
    luminance = float(luminance_of(light.response[0, still], camera).mean())
    return dict(zip((LEAK, SHOT), noise_rates(seen, camera, luminance, span_us), strict=True))


def _rough(
    trains: Trains, footage: Footage, light: Light, camera: CameraConfig, rng: np.random.Generator
) -> tuple[float, float]:
    """Return the ON and OFF threshold, estimated without any other setting."""
    usual = camera.contrast_threshold, camera.contrast_threshold_off or camera.contrast_threshold
    if footage.is_still:
        return usual
    on, off = thresholds(equations(trains, light, 0.0), rng)
    return (on.value, off.value) if on.value is not None and off.value is not None else usual


def with_found(camera: CameraConfig, found: Mapping[str, Found]) -> CameraConfig:
    """Return a camera with its settings replaced by the estimated ones."""
    values: dict[str, Any] = _values(found, "camera.")
    if "refractory_us" in values:
        values["refractory_us"] = round(values["refractory_us"])
    return dataclasses.replace(camera, **values)


def settings(
    camera: CameraConfig, found: Mapping[str, Found], without: Collection[str] = ()
) -> tuple[CameraConfig, FaultsConfig]:
    """Return camera and faults with the estimated settings, without the faults named in `without`."""
    faults: dict[str, Any] = _values({name: found[name] for name in found if name not in without}, "faults.")
    return with_found(camera, found), FaultsConfig(**faults)


def _values(found: Mapping[str, Found], group: str) -> dict[str, float]:
    """Return field -> value of a group's settings that have an estimate."""
    chosen = {name: part.value for name, part in found.items() if name.startswith(group)}
    return {name.removeprefix(group): value for name, value in chosen.items() if value is not None}


def corrected(found: dict[str, Found], again: dict[str, Found]) -> dict[str, Found]:
    """Correct the estimates by the ratio of true to estimated value in the simulated recording.

    The simulated recording is as uncertain as the real one, so the intervals grow by the root of two. Each
    side extends at least half as far as the correction. Values that no camera can have are dropped.
    """
    better = {}
    for name in BY_LIGHT:
        first, second = found[name], again[name]
        if first.value and second.value:
            share, least = first.value / second.value, 0.5 * abs(first.value - second.value)
            below, above = (max(2**0.5 * abs(end - first.value), least) for end in (first.low, first.high))
            value = share * first.value
            better[name] = possible(
                name, Found(value, max(value - share * below, 0.0), value + share * above)
            )
        elif first.value and name == MISMATCH:
            better[name] = at_most(first.value + 2**0.5 * (first.high - first.value))
    return better


def possible(name: str, part: Found) -> Found:
    """Return an estimate if a camera can have its value; a mismatch that may be 0 only as an upper limit."""
    if name == MISMATCH and part.low < NEGLIGIBLE:
        return at_most(part.high)
    try:
        with_found(CameraConfig(), {name: part})
    except ValueError:
        return missing(f"frames and events do not fit each other: corrected it is {part.value:.3g}")
    return part
