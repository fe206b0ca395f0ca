"""Which events of a noisy pixel are noise: laws of the labels, whatever the step."""

import numpy as np
import pytest

from envs.config import CameraConfig, FaultsConfig
from envs.events import EventCamera, RealSensor

SHAPE = (16, 48)
SIZE = SHAPE[0] * SHAPE[1]


def grating(t_s: float, pixels_per_s: float) -> np.ndarray:
    """Luminance of a sine that moves."""
    columns = np.mgrid[: SHAPE[0], : SHAPE[1]][1]
    return (0.3 + 0.25 * np.sin((columns - pixels_per_s * t_s) / 4.0)).astype(np.float32)


def sensed(faults, frames_hz, pixels_per_s=48.0, seconds=1.0, labels=True, **fields):
    """Events of a grating and their labels."""
    config = CameraConfig(width=SHAPE[1], height=SHAPE[0], **fields)
    camera, last_us = EventCamera(config), 0
    camera.reset(grating(0.0, pixels_per_s), 0)
    state = camera.state, camera.pixels
    sensor = RealSensor(camera.config, faults, state, np.random.default_rng(0), 0, labels=labels)
    events, is_noise = [], []
    for k in range(1, round(seconds * frames_hz) + 1):
        t_us = round(1e6 * k / frames_hz)
        events.append(sensor.events(camera.step(grating(k / frames_hz, pixels_per_s), t_us), last_us, t_us))
        is_noise.append(sensor.is_noise)
        last_us = t_us
    return np.concatenate(events), np.concatenate(is_noise)


FIELDS = [
    {},
    {"threshold_mismatch": 0.2},
    {"contrast_threshold_off": 0.3},
    {"cutoff_hz": 100.0},
    {"refractory_us": 1000},
]


each_kind_of_pixel = pytest.mark.parametrize(
    ("frames_hz", "fields"), [(240, {}), *((60, row) for row in FIELDS)]
)


@each_kind_of_pixel
def test_hardly_any_event_of_a_moving_scene_is_due_to_hardly_any_noise(fields, frames_hz):
    """Though nearly a third of them come a little early, as noise lets pixels cross their next level."""
    events, is_noise = sensed(FaultsConfig(shot_noise_hz=0.001), frames_hz, **fields)
    assert events.size > 20 * SIZE
    assert is_noise.mean() < 0.01


@each_kind_of_pixel
def test_where_the_light_rests_all_events_are_noise(fields, frames_hz):
    faults = FaultsConfig(shot_noise_hz=5.0, leak_hz=2.0, leak_jitter=0.1, noise_spread=0.1)
    events, is_noise = sensed(faults, frames_hz, 0.0, **fields)
    assert events.size > 2 * SIZE
    assert is_noise.all()


@pytest.mark.parametrize("frames_hz", [60, 240])
def test_of_a_level_that_leaks_as_many_events_are_noise_as_the_noiseless_pixel_does_not_fire(frames_hz):
    """More ON events while the light rises; while it falls, leakage takes OFF events away."""
    events, is_noise = sensed(FaultsConfig(leak_hz=5.0, leak_jitter=0.0), frames_hz)
    clean, _ = sensed(FaultsConfig(leak_hz=1e-9), frames_hz)
    added = np.count_nonzero(events["p"] > 0) - np.count_nonzero(clean["p"] > 0)
    assert is_noise.sum() == pytest.approx(added, rel=0.2)
    assert added > 1.5 * SIZE
    assert (events["p"][is_noise] > 0).mean() > 0.95


@pytest.mark.parametrize("pixels_per_s", [6.0, 48.0])
def test_the_share_of_noise_does_not_depend_on_the_frame_rate(pixels_per_s):
    faults = FaultsConfig(shot_noise_hz=5.0, leak_hz=0.5)
    shares = [sensed(faults, frames_hz, pixels_per_s)[1].mean() for frames_hz in (240, 720)]
    assert min(shares) > 0.02
    assert max(shares) < 1.2 * min(shares)


def test_light_that_moves_less_than_a_quarter_of_a_threshold_fires_no_more_than_a_first_event():
    """A pixel may begin right below its next level, which even such a light crosses by itself."""
    config = CameraConfig(width=SHAPE[1], height=SHAPE[0])
    camera = EventCamera(config)
    camera.reset(np.full(SHAPE, 0.3, np.float32), 0)
    state = camera.state, camera.pixels
    faults = FaultsConfig(shot_noise_hz=20.0)
    sensor = RealSensor(camera.config, faults, state, np.random.default_rng(0), 0, labels=True)
    light, total = 0, 0
    for k in range(1, 101):
        frame = np.full(SHAPE, 0.3 * np.exp(0.024 * np.sin(k)), np.float32)
        total += sensor.events(camera.step(frame, 10_000 * k), 10_000 * (k - 1), 10_000 * k).size
        light += np.count_nonzero(~sensor.is_noise)
    assert total > 5 * SIZE
    assert light < SIZE


def test_labels_change_no_event():
    faults = FaultsConfig(
        shot_noise_hz=5.0, leak_hz=0.5, sparsity=0.1, hot_pixel_share=0.01, hot_pixel_hz=100.0
    )
    for fields in FIELDS:
        plain, labelled = (
            sensed(faults, 60, seconds=0.2, labels=labels, **fields) for labels in (False, True)
        )
        assert plain[0].tobytes() == labelled[0].tobytes()
        assert labelled[0].shape == labelled[1].shape


def test_a_pixel_that_remembers_the_last_frame_fires_noise_by_noise_alone():
    """Its level is the light's at the start of each interval."""
    clean, none = sensed(FaultsConfig(), 60, memory="frame")
    events, is_noise = sensed(FaultsConfig(shot_noise_hz=200.0), 60, memory="frame")
    assert not none.any()
    assert is_noise.sum() == pytest.approx(events.size - clean.size, rel=0.05)
    assert is_noise.any()
