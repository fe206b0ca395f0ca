"""The bandwidth of the photoreceptors: what a first-order filter does to a ramp, a step and a sine."""

import math

import numpy as np
import pytest

from envs.config import CameraConfig, EnvConfig, sensor_settings
from envs.events import EventCamera
from envs.events.ramps import can_look

FLOOR = 1e-9


def frame(value, shape=(1, 1)):
    return np.full(shape, value, np.float32)


def shown(values, times_us, **fields):
    """A camera of one pixel that was shown these values, and its events."""
    own = {"luminance_floor": FLOOR, "max_events_per_pixel": 10_000, "cutoff_grows_with_light": False}
    camera = EventCamera(1, 1, **own | fields)
    camera.reset(frame(values[0]), 0)
    parts = [camera.step(frame(value), t) for value, t in zip(values[1:], times_us, strict=True)]
    return camera, np.concatenate(parts)


def filtered(camera):
    return float(camera._low_pass.filtered[0])


@pytest.mark.parametrize("cutoff_hz", [10.0, 30.0, 300.0])
def test_a_ramp_arrives_late_by_the_time_constant(cutoff_hz):
    tau_us = 1e6 / (2 * math.pi * cutoff_hz)
    end_us = int(40 * tau_us)
    times = np.linspace(0, end_us, 4001).round().astype(int)[1:]
    slope = 8.0 / end_us
    camera, events = shown(np.exp(-8.0 + slope * np.append(0, times)), times, cutoff_hz=cutoff_hz)
    late = events["t"] - 0.2 * np.arange(1, len(events) + 1) / slope
    settled = events["t"] > 12 * tau_us
    assert settled.sum() > 20
    assert np.abs(late[settled] - tau_us).max() < 0.01 * tau_us + 2
    assert filtered(camera) == pytest.approx(slope * (end_us - tau_us) - 8.0, abs=1e-4)


def test_a_step_is_followed_exponentially_and_a_sine_at_the_cutoff_keeps_its_half_power():
    tau_us = 1e6 / (2 * math.pi * 30.0)
    for share in (0.1, 1.0, 3.0):
        camera, _ = shown([1.0, math.e, math.e], [1, 1 + round(share * tau_us)], cutoff_hz=30.0)
        assert filtered(camera) == pytest.approx(1 - math.exp(-share), abs=2e-4)
    times = np.arange(1, 4001) * 100
    wave = np.exp(0.3 * np.sin(2 * math.pi * 30.0 * np.append(0, times) * 1e-6))
    camera = EventCamera(1, 1, cutoff_hz=30.0, cutoff_grows_with_light=False, luminance_floor=FLOOR)
    camera.reset(frame(wave[0]), 0)
    seen = []
    for value, t in zip(wave[1:], times, strict=True):
        camera.step(frame(value), t)
        seen.append(filtered(camera))
    assert np.ptp(seen[2000:]) / 0.6 == pytest.approx(1 / math.sqrt(2), abs=1e-3)


@pytest.mark.parametrize("grows", [False, True])
def test_frames_on_a_line_between_two_others_change_nothing(grows):
    results = []
    for parts in (1, 7, 100):
        times = 7000 * np.arange(1, parts + 1) // parts
        values = [0.5, *(0.5 * np.exp(0.02 * times / 7000))]
        camera, _ = shown(values, times, cutoff_hz=30.0, cutoff_grows_with_light=grows, luminance_floor=1e-9)
        results.append(filtered(camera))
    assert np.ptp(results) < (2e-5 if grows else 2e-7)  # the light of an interval is its mean


def test_in_the_dark_a_photoreceptor_is_slower_as_v2e_has_it():
    for light, share in ((0.0, 20 / 275), (0.5, 147.5 / 275), (1.0, 1.0)):
        fields = {"cutoff_hz": 30.0, "cutoff_grows_with_light": True, "luminance_floor": 1.0}
        camera, _ = shown([light, light + 1e-3, light + 1e-3], [1, 2001], **fields)
        before, after = math.log(light + 1.0), math.log(light + 1e-3 + 1.0)
        left = (after - filtered(camera)) / (after - before)
        assert left == pytest.approx(math.exp(-2e-3 * 2 * math.pi * 30.0 * share), abs=2e-3)


def test_without_a_cutoff_nothing_is_filtered_and_a_wide_band_fires_the_same():
    values = np.exp(np.cumsum(np.random.default_rng(0).normal(0, 0.4, 200)))
    times = 1000 * np.arange(1, 200)
    camera, events = shown(values, times)
    assert camera._low_pass is None
    _, wide = shown(values, times, cutoff_hz=1e6)
    assert abs(len(wide) - len(events)) <= 2
    assert np.abs(np.cumsum(events["p"])[-1] - np.cumsum(wide["p"])[-1]) <= 1


def test_a_refused_frame_leaves_the_filter_as_it_was():
    cameras = [EventCamera(2, 1, cutoff_hz=50.0) for _ in range(2)]
    for camera in cameras:
        camera.reset(np.float32([[0.1, 0.2]]), 0)
        camera.step(np.float32([[0.5, 0.1]]), 1000)
    with pytest.raises(ValueError, match="x=1, y=0"):
        cameras[0].step(np.float32([[3.0, np.inf]]), 2000)
    after = [camera.step(np.float32([[0.1, 0.9]]), 3000).tobytes() for camera in cameras]
    assert after[0] == after[1] != b""


def test_a_camera_with_a_cutoff_sees_whole_images_and_settings_that_are_off_leave_no_trace():
    assert can_look(CameraConfig())
    assert not can_look(CameraConfig(cutoff_hz=30.0))
    plain = sensor_settings(EnvConfig())
    assert "cutoff_hz" not in plain
    slow = sensor_settings(EnvConfig(camera=CameraConfig(cutoff_hz=30.0)))
    assert slow == plain | {"cutoff_hz": 30.0}
