import re

import numpy as np
import pytest

from envs.config import CameraConfig
from envs.events import EVENT
from jobs.tools.calibrate.bandwidth import UNLIMITED, bandwidth
from jobs.tools.calibrate.dead_time import shortest_us
from jobs.tools.calibrate.estimate import (
    BY_LIGHT,
    CUTOFF,
    DEAD,
    HOT_SHARE,
    MISMATCH,
    NAMES,
    OFF,
    ON,
    SHOT,
    corrected,
    estimate,
)
from jobs.tools.calibrate.footage import (
    Footage,
    light_behind,
    looked_up,
    luminance_of,
    still_footage,
    trains_of,
)
from jobs.tools.calibrate.found import Found, missing
from jobs.tools.calibrate.hot_pixels import hot_pixels
from jobs.tools.calibrate.thresholds import Equations, equations, mismatch, thresholds
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


def most(found):
    """The number of "at most ..."."""
    return float(re.fullmatch("at most (.*)", found.reason)[1])


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
        untold = [name for name in NAMES if found[name].value is None and name.startswith("camera")]
        assert untold == [ON, OFF, MISMATCH, CUTOFF, DEAD]
        assert all(part.reason for part in found.values() if part.value is None)
        if "hot_pixel_share" not in faults:
            assert found[HOT_SHARE].value == 0.0
    assert np.mean(held) >= 0.9


@pytest.mark.parametrize(("on", "off", "dead_us"), [(0.15, 0.4, 0), (0.3, 0.2, 3000)])
def test_thresholds_of_a_perfect_sensor_are_found_exactly(footage, on, off, dead_us):
    part = Footage(footage.luminance[:301, :16], footage.times_us[:301])
    camera = {"contrast_threshold": on, "contrast_threshold_off": off, "refractory_us": dead_us}
    trains = trains_of(planted(part, camera), 32)
    table = equations(trains, light_behind(part.flat, part.times_us, PLAIN), dead_us)
    found = thresholds(table, RNG)
    assert [one.value for one in found] == pytest.approx([on, off], rel=1e-3)
    none = mismatch(table, (on, off), RNG)
    assert none.value is None
    assert most(none) < 0.02


@pytest.mark.parametrize("scene", range(4))
def test_frames_of_another_scene_tell_no_threshold(scene):
    """No thresholds rather than wrong ones: not below 0, above what a camera has, or anything between."""
    part = {"width": 24, "waving": 8, "flickering": 0, "still": 0}
    shown, seen = (moving_footage(seed=seed, **part) for seed in (1000, scene))
    shown, seen = (Footage(one.luminance[:101], one.times_us[:101]) for one in (shown, seen))
    found = estimate(planted(seen), shown, PLAIN).found
    assert {found[name].value for name in BY_LIGHT} == {None}
    assert "fit each other" in found[ON].reason


@pytest.mark.parametrize(
    ("pixels", "number", "is_told"), [(2, 0.0, False), (8, 0.0, True), (8, np.nan, False)]
)
def test_pixels_whose_light_changes_must_be_enough_to_be_drawn_again(pixels, number, is_told):
    """Draws without any of them have no solution, nor have equations without a number."""
    matrix, right = np.full((2, 40, 2, 2), number), np.full((2, 40, 2), number)
    matrix[:, :pixels], right[:, :pixels] = np.eye(2) + number, 0.2 + number
    found = thresholds(Equations(matrix, right, np.full((2, 40), 100.0)), RNG)
    assert [part.value is not None for part in found] == [is_told, is_told]
    assert is_told or np.isnan(number) or "too few pixels" in found[0].reason


@pytest.mark.parametrize(
    ("name", "first", "second"),
    [(ON, (8.0, 7.0, 9.0), (4.0, 3.5, 4.5)), (MISMATCH, (0.9, 0.8, 0.98), (0.6, 0.5, 0.7))],
)
def test_a_correction_to_what_no_camera_has_is_not_taken(name, first, second):
    found, again = ({**dict.fromkeys(BY_LIGHT, missing("")), name: Found(*part)} for part in (first, second))
    better = corrected(found, again)[name]
    assert better.value is None
    assert "fit each other" in better.reason


def test_a_mismatch_that_may_be_none_is_given_as_the_most_that_it_is():
    """Also where the simulation found none, so that nothing tells how to correct it."""
    found = {**dict.fromkeys(BY_LIGHT, missing("")), MISMATCH: Found(0.02, 0.01, 0.03)}
    for second in (missing("at most 0.03"), Found(0.02, 0.004, 0.03), Found(0.03, 0.02, 0.04)):
        low = corrected(found, {**found, MISMATCH: second})[MISMATCH]
        assert low.value is None or low.low > 0.0
        assert low.value is not None or most(low) == pytest.approx(0.034, abs=0.001)


@pytest.mark.slow
@pytest.mark.parametrize("faults", [{}, {"shot_noise_hz": 3.0, "leak_hz": 0.2}])
@pytest.mark.parametrize("truth", [0.0, 0.02])
def test_a_small_mismatch_is_held_by_its_interval_or_its_most(truth, faults):
    part = moving_footage(width=24, waving=10, flickering=2, still=4)
    part, held = Footage(part.luminance[:401], part.times_us[:401]), []
    for seed in range(8):
        camera = {"threshold_mismatch": truth, "threshold_seed": seed}
        found = estimate(planted(part, camera, faults, seed), part, PLAIN, seed).found[MISMATCH]
        held.append(truth <= most(found) if found.value is None else found.low <= truth <= found.high)
    assert sum(held) >= 7


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
    found = bandwidth(trains, rare.flat, rare.times_us, PLAIN, 0.0, RNG)
    assert found.value is None
    assert re.match("frames 200 ms apart cannot tell", found.reason)


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
