import numpy as np
import pytest

from envs.config import CameraConfig
from envs.events import EVENT
from jobs.studies.calibrate.bandwidth import UNLIMITED, bandwidth
from jobs.studies.calibrate.dead_time import shortest_us
from jobs.studies.calibrate.estimate import (
    CUTOFF,
    DEAD,
    HOT_SHARE,
    MISMATCH,
    NAMES,
    OFF,
    ON,
    SHOT,
    Footage,
    estimate,
    still_footage,
)
from jobs.studies.calibrate.footage import light_behind, looked_up, luminance_of, trains_of
from jobs.studies.calibrate.hot_pixels import hot_pixels
from jobs.studies.calibrate.thresholds import equations, mismatch, thresholds
from tests.support.planted import moving_footage, planted, still_planted

RNG = np.random.default_rng(0)
PLAIN = CameraConfig()
MOVING = [
    (
        {"contrast_threshold_off": 0.3, "threshold_mismatch": 0.1, "cutoff_hz": 50.0},
        {"leak_hz": 0.1, "shot_noise_hz": 2.0, "hot_pixel_share": 0.004, "hot_pixel_hz": 100.0},
    ),
    (
        {"contrast_threshold": 0.3, "contrast_threshold_off": 0.2, "threshold_mismatch": 0.05}
        | {"refractory_us": 2000},
        {"leak_hz": 0.3, "hot_pixel_share": 0.01, "hot_pixel_hz": 50.0},
    ),
    ({"contrast_threshold": 0.25, "threshold_mismatch": 0.2, "cutoff_hz": 20.0}, {"shot_noise_hz": 5.0}),
]
STILL = [
    (0.3, {"leak_hz": 0.1, "shot_noise_hz": 1.0, "hot_pixel_share": 0.004, "hot_pixel_hz": 100.0}),
    (0.05, {"leak_hz": 0.5, "shot_noise_hz": 5.0}),
    (0.8, {"leak_hz": 0.2, "hot_pixel_share": 0.01, "hot_pixel_hz": 30.0}),
]


def named(camera, faults):
    """The planted settings by their names in a calibration."""
    camera = {"contrast_threshold": 0.2, **camera}
    camera.setdefault("contrast_threshold_off", camera["contrast_threshold"])
    return {f"camera.{k}": v for k, v in camera.items()} | {f"faults.{k}": v for k, v in faults.items()}


def agree(found, truth):
    """Every planted value is recovered within a tenth; how many intervals hold theirs."""
    for name, value in truth.items():
        part = found[name]
        assert part.value == pytest.approx(value, rel=0.1), (name, part)
        assert part.low <= part.value <= part.high, (name, part)
    return [found[name].low <= value <= found[name].high for name, value in truth.items()]


@pytest.fixture(scope="module")
def footage():
    return moving_footage()


@pytest.mark.slow
def test_planted_settings_are_recovered_from_events_and_frames(footage):
    """Pixel by pixel the hot ones too, and nine in ten of the intervals hold the truth."""
    held = []
    for camera, faults in MOVING:
        found = estimate(planted(footage, camera, faults), footage, PLAIN).found
        held += agree(found, named(camera, faults))
        if "refractory_us" not in camera:
            assert found[DEAD].value is None
        if "cutoff_hz" not in camera:
            assert found[CUTOFF].value is None
    assert np.mean(held) >= 0.9


@pytest.mark.slow
def test_planted_noise_is_recovered_from_a_still_scene():
    held = []
    for luminance, faults in STILL:
        events, frames = still_planted(48, luminance, faults=faults)
        found = estimate(events, frames, PLAIN).found
        held += agree(found, {f"faults.{name}": value for name, value in faults.items()})
        assert [name for name in NAMES if found[name].value is None and name.startswith("camera")] == [
            ON, OFF, MISMATCH, CUTOFF, DEAD,
        ]  # fmt: skip
        assert all(part.reason for part in found.values() if part.value is None)
        if "hot_pixel_share" not in faults:
            assert found[HOT_SHARE].value == 0.0
    assert np.mean(held) >= 0.9


@pytest.mark.parametrize(("on", "off", "dead_us"), [(0.2, 0.2, 0), (0.15, 0.4, 0), (0.3, 0.2, 3000)])
def test_thresholds_of_a_perfect_sensor_are_found_exactly(footage, on, off, dead_us):
    part = Footage(footage.luminance[:301, :16], footage.times_us[:301])
    camera = {"contrast_threshold": on, "contrast_threshold_off": off, "refractory_us": dead_us}
    trains = trains_of(planted(part, camera), 32)
    table = equations(trains, light_behind(part.flat, part.times_us, PLAIN), dead_us)
    found = thresholds(table, RNG)
    assert [one.value for one in found] == pytest.approx([on, off], rel=1e-3)
    assert mismatch(table, (on, off), RNG).value == pytest.approx(0.0, abs=5e-3)


def test_mismatch_is_found_without_the_help_of_a_simulation(footage):
    part = Footage(footage.luminance[:501, :12], footage.times_us[:501])
    trains = trains_of(planted(part, {"threshold_mismatch": 0.1}), 32)
    table = equations(trains, light_behind(part.flat, part.times_us, PLAIN), 0)
    assert mismatch(table, (0.2, 0.2), RNG).value == pytest.approx(0.1, rel=0.1)


def test_the_bandwidth_of_a_perfect_sensor_is_found_exactly(footage):
    part = Footage(footage.luminance[:201, :6], footage.times_us[:201])
    trains = trains_of(planted(part, {"cutoff_hz": 40.0}), 32)
    found = bandwidth(trains, part.flat, part.times_us, PLAIN, 0.0, RNG)
    assert found.value == pytest.approx(40.0, rel=0.01)
    unlimited = bandwidth(trains_of(planted(part), 32), part.flat, part.times_us, PLAIN, 0.0, RNG)
    assert unlimited.value is None
    assert unlimited.reason == UNLIMITED


def test_a_frame_rate_that_cannot_tell_a_bandwidth_is_said(footage):
    part = Footage(footage.luminance[:401, :6], footage.times_us[:401])
    trains = trains_of(planted(part, {"cutoff_hz": 100.0}), 32)
    rare = Footage(part.luminance[::20], part.times_us[::20])
    assert bandwidth(trains, rare.flat, rare.times_us, PLAIN, 0.0, RNG).value is None


def test_hot_pixels_are_found_by_their_place():
    rng = np.random.default_rng(1)
    counts = rng.poisson(rng.gamma(0.5, 20.0, 2304)).astype(np.float64)
    usual = counts.copy()
    hot = rng.choice(2304, 20, replace=False)
    counts[hot] += rng.poisson(1000, 20)
    assert np.flatnonzero(hot_pixels(counts)).tolist() == sorted(hot.tolist())
    assert not hot_pixels(usual).any()


def test_the_shortest_interval_does_not_heed_a_slip():
    t = np.concatenate(([0, 3], 10_000 + 1000 * np.arange(50)))
    events = np.zeros(t.size, EVENT)
    events["t"], events["p"] = t, 1
    assert shortest_us(trains_of(events, 1)) == 1000
    assert shortest_us(trains_of(events[:3], 1)) == np.inf


def test_a_recording_without_enough_events_is_refused_once():
    events, frames = still_planted(8, 0.3, faults={"leak_hz": 0.5})
    with pytest.raises(ValueError, match="must have at least 1000 events"):
        estimate(events, frames, PLAIN)


def test_nothing_of_the_light_is_claimed_of_noise_alone():
    """Frames that show another scene than the events: no thresholds rather than wrong ones."""
    events, _ = still_planted(24, 0.3, faults={"leak_hz": 0.5, "shot_noise_hz": 3.0})
    still = estimate(events, still_footage((24, 24), 0.3, (0, 10_000_000)), PLAIN).found
    assert {still[name].value for name in (ON, OFF, MISMATCH, CUTOFF, DEAD)} == {None}
    assert still[SHOT].value is not None


def test_a_moving_scene_is_not_taken_for_a_still_one():
    """A wave that passes over the pixels, without its frames."""
    t, x = np.arange(101)[:, None, None], np.arange(24)[None, None, :]
    light = np.exp(-1.5 + np.sin(0.3 * t + 0.3 * x)) * np.ones((1, 24, 1))
    events = planted(Footage(light.astype(np.float32), np.arange(101) * 100_000))
    with pytest.raises(ValueError, match="must be of a still scene"):
        estimate(events, still_footage((24, 24), 0.3, (0, 10_000_000)), PLAIN)


def test_light_is_looked_up_linearly_and_inverted():
    light = light_behind(np.array([[0.1], [0.4]], np.float32), np.array([0, 1000]), PLAIN)
    pixel, t_us = np.zeros(3, np.int64), np.array([0, 500, 1000])
    at = looked_up(light.response, light.times_us, pixel, t_us)
    expected = np.log(np.array([0.1, 0.4]) + 1e-3)
    assert at == pytest.approx([expected[0], expected.mean(), expected[1]], rel=1e-6)
    assert luminance_of(at[[0, 2]], PLAIN) == pytest.approx([0.1, 0.4], rel=1e-5)
    assert light.travel[:, 0] == pytest.approx([0.0, expected[1] - expected[0]], rel=1e-6)
