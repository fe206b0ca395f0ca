"""What a real sensor adds to the events of frames, and which events are noise."""

import re
import warnings

import numpy as np
import pytest

from envs.config import CameraConfig, FaultsConfig
from envs.events import EventCamera
from envs.recordings import video_to_events
from envs.recordings.frame_rate import FrameLoss
from tests.support.image_folders import SHAPE, quietly, random_frames, save

CAMERA = {"width": SHAPE[1], "height": SHAPE[0]}


@pytest.fixture
def folder(tmp_path):
    """Twelve frames of a grating that moves."""
    phase = np.arange(SHAPE[1]) / 3.0 - np.arange(12)[:, None, None] * 0.4
    grey = np.rint(120 + 100 * np.sin(phase + np.arange(SHAPE[0])[:, None] / 5.0)).astype(np.uint8)
    return save(tmp_path / "grating", np.repeat(grey[..., None], 3, axis=3), ".png")


@pytest.fixture
def still(tmp_path):
    return save(tmp_path / "still", np.repeat(random_frames(1), 21, axis=0), ".png")


def seen(folder, faults=None, rng=0, **fields):
    """The events of a folder at 100 frames per second."""
    camera = CameraConfig(**CAMERA, **fields)
    return quietly(folder, camera, faults, fps=100.0, rng=np.random.default_rng(rng))


def test_without_noise_the_events_are_those_of_the_camera_alone_and_none_is_noise(folder):
    plain = quietly(folder, CameraConfig(**CAMERA), fps=100.0)
    for file in (seen(folder), seen(folder, FaultsConfig()), seen(folder, FaultsConfig(), rng=7)):
        assert file.events.tobytes() == plain.events.tobytes()
        assert file.is_noise.dtype == bool
        assert file.is_noise.shape == file.events.shape
        assert not file.is_noise.any()


@pytest.mark.parametrize(
    ("noise", "latency_us"),
    [({"background_activity_hz": 200.0}, 700), ({"hot_pixel_share": 0.1, "hot_pixel_hz": 2000.0}, 0)],
)
def test_where_noise_is_added_the_events_labelled_signal_are_those_without_it(noise, latency_us, folder):
    """Also when they wait for the readout, and come in a later interval than their cause."""
    clean = seen(folder, latency_us=latency_us)
    file = seen(folder, FaultsConfig(**noise), latency_us=latency_us)
    assert np.array_equal(file.events[~file.is_noise], clean.events)
    assert file.is_noise.sum() == pytest.approx(0.11 * 192 * 200, rel=0.1)
    again = seen(folder, FaultsConfig(**noise), latency_us=latency_us)
    other = seen(folder, FaultsConfig(**noise), rng=1, latency_us=latency_us)
    assert again.events.tobytes() == file.events.tobytes()
    assert np.array_equal(again.is_noise, file.is_noise)
    assert other.events.tobytes() != file.events.tobytes()


def test_all_events_of_a_still_scene_are_noise_at_the_rates_asked_for(still):
    assert len(seen(still).events) == 0
    shot = seen(still, FaultsConfig(shot_noise_hz=20.0))
    leak = seen(still, FaultsConfig(leak_hz=20.0))
    assert shot.is_noise.all()
    assert leak.is_noise.all()
    assert 0.25 * 20 * 0.2 * 192 < len(shot.events) < 20 * 0.2 * 192 * 1.1  # bright pixels make a quarter
    assert len(leak.events) == pytest.approx(20 * 0.2 * 192, rel=0.05)
    assert (leak.events["p"] == 1).all()


def test_signal_and_noise_of_the_pixels_are_told_apart_in_a_scene_that_moves(folder):
    """Noise lets events of the light come early and adds a few where the light turns: those are signal."""
    clean, noisy = seen(folder), seen(folder, FaultsConfig(shot_noise_hz=20.0))
    assert (~noisy.is_noise).sum() == pytest.approx(len(clean.events), rel=0.1)
    assert 0.25 * 20 * 0.11 * 192 < len(noisy.events) - len(clean.events) < 1.3 * 20 * 0.11 * 192
    assert 0.25 * 20 * 0.11 * 192 < noisy.is_noise.sum() < 1.3 * 20 * 0.11 * 192


def test_the_sensor_of_the_settings_is_simulated(folder):
    clean, late = seen(folder), seen(folder, latency_us=300)
    moved = clean.events.copy()
    moved["t"] += 300
    assert np.array_equal(late.events, moved[moved["t"] <= 110_000])
    limited = seen(folder, readout_hz=5000.0)
    assert len(limited.events) <= 5000 * 0.11
    assert limited.dropped > 100


def grating(hz: float, seconds: float, rate: float) -> tuple[np.ndarray, list[int]]:
    """Frames of a grating that passes so many waves of 8 pixels a second, and their times [us]."""
    times_s = np.arange(round(seconds * rate) + 1) / rate
    phase = 2 * np.pi * (np.arange(SHAPE[1]) / 8 - hz * times_s[:, None, None])
    light = np.exp(1.2 * np.sin(phase + np.zeros((SHAPE[0], 1)))) * 0.2
    return light.astype(np.float32), [round(t * 1e6) for t in times_s]


def edges(speed: float, rate: float) -> tuple[np.ndarray, list[int]]:
    """Two seconds of edges at random places, 6 pixels apart, that move so many pixels a second."""
    rng, times_s = np.random.default_rng(0), np.arange(round(2 * rate) + 1) / rate
    places = np.concatenate(([0.0], np.cumsum(rng.exponential(6.0, 400))))
    area = np.concatenate(([0.0], np.cumsum(np.diff(places) * rng.uniform(0.05, 1.0, 400))))
    borders = np.arange(65) + 200 + speed * times_s[:, None]
    light = np.diff(np.interp(borders, places, area), axis=1)[:, None, :]
    return light.astype(np.float32), [round(t * 1e6) for t in times_s]


def missed(light: np.ndarray, times_us: list[int], whole: int) -> tuple[float, float]:
    """The share that frames miss of the events of a whole, and the estimate."""
    height, width = light.shape[1:]
    camera = EventCamera(width, height, max_events_per_pixel=1000)
    loss, count = FrameLoss(CameraConfig(width=width, height=height)), 0
    for number, (frame, t_us) in enumerate(zip(light, times_us, strict=True)):
        loss.see(frame, t_us)
        if number == 0:
            camera.reset(frame, t_us)
        else:
            count += len(camera.step(frame, t_us))
    return 1 - count / whole if whole else count, loss.share


@pytest.mark.parametrize("speed", [60.0, 200.0])
def test_the_share_that_frames_of_edges_miss_is_about_the_estimate(speed):
    """Against a rate at which an edge moves 1/20 of a pixel from frame to frame."""
    whole = missed(*edges(speed, 20 * speed), 0)[0]
    for rate in (16.0, 32.0, 128.0):
        truth, estimate = missed(*edges(speed, rate), whole)
        assert estimate == pytest.approx(truth, rel=0.4, abs=0.03)


@pytest.mark.parametrize("hz", [0.5, 3.0])
def test_of_a_scene_without_edges_frames_miss_no_more_than_the_estimate(hz):
    whole = missed(*grating(hz, 4.0, 1024.0), 0)[0]
    for rate in (8.0, 16.0, 64.0):
        truth, estimate = missed(*grating(hz, 4.0, rate), whole)
        assert truth - 0.02 < estimate < 0.5


def test_what_a_low_frame_rate_loses_is_said_once_with_its_number(tmp_path):
    light, _ = grating(3.0, 4.0, 10.0)
    slow = save(tmp_path / "slow", np.repeat(light[..., None], 3, axis=3), ".exr")
    light, _ = grating(0.2, 4.0, 30.0)
    fast = save(tmp_path / "fast", np.repeat(light[..., None], 3, axis=3), ".exr")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        file = video_to_events(slow, fps=10.0)
    (warning,) = caught
    share = int(re.search(r"about (\d+)\s?%", str(warning.message))[1])
    assert share == round(100 * file.missed)
    assert share > 10
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert video_to_events(fast, fps=30.0).missed < 0.05
        assert video_to_events(slow, CameraConfig(**CAMERA, contrast_threshold=9.0), fps=10.0).missed is None


@pytest.mark.parametrize("size", [(1, 1), (13, 7), (400, 300)])
def test_the_estimate_looks_at_few_pixels_of_a_camera_of_any_size(size):
    rng, loss = np.random.default_rng(0), FrameLoss(CameraConfig(width=size[0], height=size[1]))
    for n in range(9):
        loss.see(rng.random(size[::-1], np.float32), 1000 * n)
    assert loss.share is None or 0.2 < loss.share < 0.5  # independent frames: half of all is lost


@pytest.mark.parametrize("coding", [0.0, 1e-4])
def test_repeated_frames_do_not_hide_what_a_low_frame_rate_misses(coding):
    """A video of 16 Hz that was encoded at 32 or 48 Hz: each frame twice or thrice, not quite the same."""
    light, times_us = edges(200.0, 16.0)
    expected = missed(light, times_us, 1)[1]
    for repeats in (2, 3):
        frames = np.repeat(light, repeats, axis=0)
        frames = frames * (1 + coding * np.random.default_rng(0).random(frames.shape, np.float32))
        loss = FrameLoss(CameraConfig(width=light.shape[2], height=light.shape[1]))
        for number, frame in enumerate(frames):
            loss.see(frame, 20_000 * number)
        assert loss.share == pytest.approx(expected, abs=0.01)
    assert expected > 0.2
