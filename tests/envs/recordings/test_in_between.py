"""Frames between two frames, by optical flow."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from envs.config import CameraConfig
from envs.events import EventCamera
from envs.recordings.in_between import frames_between
from tests.support.image_folders import quietly, save

SIDE, RATE, FAST = 64, 20.0, 640.0


def moving(rate: float, pixels_per_s: float = 100.0, seconds: float = 0.5) -> np.ndarray:
    """A random texture that moves, float32 (N, 64, 64); between whole pixels by its Fourier phase."""
    texture = gaussian_filter(np.random.default_rng(0).standard_normal((SIDE, 256)), 2.0, mode="wrap")
    spectrum, waves = np.fft.rfft(0.3 * np.exp(6 * texture), axis=1), np.fft.rfftfreq(256)
    shifts = np.arange(round(seconds * rate) + 1) / rate * pixels_per_s
    frames = [np.fft.irfft(spectrum * np.exp(-2j * np.pi * waves * s), 256, axis=1)[:, :SIDE] for s in shifts]
    return np.maximum(frames, 1e-3).astype(np.float32)


def blurred(events: np.ndarray, start_us: int, end_us: int) -> np.ndarray:
    """The net image of a window, blurred by a pixel."""
    part, image = events[(events["t"] > start_us) & (events["t"] <= end_us)], np.zeros((SIDE, SIDE))
    np.add.at(image, (part["y"], part["x"]), part["p"])
    return gaussian_filter(image, 1.0).ravel()


def likeness(events: np.ndarray, truth: np.ndarray) -> float:
    """Mean correlation of the images of 10 ms."""
    windows = [(t, t + 10_000) for t in range(0, 500_000, 10_000)]
    return float(np.mean([np.corrcoef(blurred(events, *w), blurred(truth, *w))[0, 1] for w in windows]))


def test_what_moves_is_led_from_one_frame_to_the_next(tmp_path):
    """At five pixels a frame the events of flow are far nearer to the truth than those of a line."""
    pytest.importorskip("cv2")
    fast = moving(FAST)
    camera = EventCamera(SIDE, SIDE)
    camera.reset(fast[0], 0)
    times_us = [round(n * 1e6 / FAST) for n in range(1, len(fast))]
    truth = camera.steps(fast[1:], times_us)
    folder = save(tmp_path, np.repeat(moving(RATE)[..., None], 3, axis=3), ".exr")
    config = CameraConfig(width=SIDE, height=SIDE)
    line = quietly(folder, config, fps=RATE)
    flow = quietly(folder, config, fps=RATE, interpolate="flow")
    assert likeness(flow.events, truth) > likeness(line.events, truth) + 0.15
    assert abs(len(flow.events) - len(truth)) < 0.7 * abs(len(line.events) - len(truth))
    assert (np.diff(flow.events["t"]) >= 0).all()
    assert flow.events["t"].max() <= 500_000
    again = quietly(folder, config, fps=RATE, interpolate="flow")
    assert again.events.tobytes() == flow.events.tobytes()


def test_moments_between_lie_evenly_and_a_still_scene_has_none():
    pytest.importorskip("cv2")
    first, second = moving(RATE)[:2]
    between = list(frames_between(first, second, 1e-3))
    shares = [share for share, _ in between]
    assert 3 <= len(between) <= 7
    assert shares == [(n + 1) / (len(between) + 1) for n in range(len(between))]
    assert len(list(frames_between(first, second, 1e-3, most_parts=2))) == 1
    assert list(frames_between(first, first, 1e-3)) == []
    dark = np.zeros((SIDE, SIDE), np.float32)
    assert list(frames_between(dark, dark, 1e-3)) == []
    truth = moving(RATE * len(between) + RATE)[1 : len(between) + 1]
    inner = np.s_[12:-12, 12:-12]
    for (_, picture), other in zip(between, truth, strict=True):
        assert picture.dtype == np.float32
        assert np.corrcoef(picture[inner].ravel(), other[inner].ravel())[0, 1] > 0.97


def test_pictures_that_are_too_small_and_another_word_are_refused(tmp_path):
    folder = save(tmp_path, np.zeros((2, 12, 16, 3), np.uint8), ".png")
    with pytest.raises(ValueError, match="interpolate must be 'linear' or 'flow'"):
        quietly(folder, fps=10.0, interpolate="cubic")
    pytest.importorskip("cv2")
    with pytest.raises(ValueError, match="needs 32 x 32 pixels, got"):
        quietly(folder, fps=10.0, interpolate="flow")
