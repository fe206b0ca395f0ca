"""What the camera's options do: memory, response, thresholds, refractory period, excess, encoding."""

import hashlib
import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from envs.config import CameraConfig, EnvConfig, sensor_settings
from envs.events import EVENT, EventCamera
from envs.events.camera import pixel_thresholds

TOLERANCE = 2.0**-23  # of a crossing
LUMINANCES = st.floats(0, np.finfo(np.float32).max, width=32, allow_subnormal=True)


def frame(value, shape=(1, 1)):
    return np.full(shape, value, np.float32)


def play(values, dt_us=1000, **fields):
    """Events of one pixel that shows `values` one after the other."""
    camera = EventCamera(1, 1, **{"luminance_floor": 1e-9, "max_events_per_pixel": 100_000} | fields)
    camera.reset(frame(values[0]), 0)
    steps = [camera.step(frame(v), (i + 1) * dt_us) for i, v in enumerate(values[1:])]
    return np.concatenate([np.empty(0, EVENT), *steps])


def texture(t_s):
    y, x = np.mgrid[:12, :16]
    return (0.5 + 0.45 * np.sin((x - 40.0 * t_s) * 0.9 + 0.3 * y)).astype(np.float32)


def test_memory_legacy_stamps_events_from_the_start_of_the_interval_on():
    events = play(np.exp([0.0, 1.05]), dt_us=5000, memory="legacy")
    assert events["t"].tolist() == [1, 1250, 2500, 3750]
    capped = play(np.exp([0.0, 3.0]), dt_us=5000, memory="legacy", max_events_per_pixel=10)
    assert capped["t"].tolist() == [1, *range(500, 5000, 500)]


@pytest.mark.parametrize(
    ("fields", "rule"),
    [
        ({"contrast_threshold": np.nan}, "contrast_threshold"),
        ({"contrast_threshold_off": 9e-7}, "contrast_threshold_off"),
        ({"memory": "none"}, "memory"),
        ({"typo": 1}, "typo"),
        ({"memory": "frame", "refractory_us": 10}, "(?s)refractory_us.*memory 'reference'"),
        ({"memory": "legacy", "excess": "carry"}, "(?s)excess.*memory 'reference'"),
        ({"refractory_us": 5, "excess": "carry"}, "refractory_us 0"),
    ],
)
def test_settings_that_cannot_be_are_refused(fields, rule):
    with pytest.raises(ValueError, match=rule):
        EventCamera(1, 1, **fields)


def test_thresholds_scatter_as_asked_on_and_off_apart_and_belong_to_the_sensor():
    config = CameraConfig(128, 128, threshold_mismatch=0.03, contrast_threshold_off=0.4)
    on, off = pixel_thresholds(config)
    assert abs(on.std() / (0.03 * 0.2) - 1) < 4 / math.sqrt(2 * on.size)
    assert abs(off.std() / (0.03 * 0.4) - 1) < 4 / math.sqrt(2 * on.size)
    assert abs(on.mean() - 0.2) < 4 * 0.006 / 128
    assert abs(np.corrcoef(on, off)[0, 1]) < 4 / 128
    assert np.array_equal(pixel_thresholds(config), (on, off))
    other = CameraConfig(128, 128, threshold_mismatch=0.03, threshold_seed=1)
    assert not np.array_equal(pixel_thresholds(other)[0], on)
    for threshold, least in ((1e-6, 1e-6), (0.2, 0.02)):
        wild = CameraConfig(64, 64, threshold_mismatch=1.0, contrast_threshold=threshold)
        assert np.min(pixel_thresholds(wild)) == pytest.approx(least)


def test_a_mismatch_too_small_to_matter_gives_the_bytes_of_none():
    cameras = [EventCamera(16, 12, threshold_mismatch=mismatch) for mismatch in (0.0, 1e-300)]
    for camera in cameras:
        camera.reset(texture(0.0), 0)
    for k in range(1, 20):
        plain, other = (camera.step(texture(0.01 * k), 10_000 * k) for camera in cameras)
        assert plain.tobytes() == other.tobytes() != b""


def simulate_refractory_period(values, dt_us, refractory_us, on, off):
    """One pixel, event by event: fire, wait, take the level of that moment as reference."""
    logs = [math.log(float(v) + 1e-9) for v in values]
    remembered, held, events = logs[0], None, []
    for k, (before, after) in enumerate(itertools.pairwise(logs)):
        t0, t1 = k * dt_us, (k + 1) * dt_us
        while True:
            if held is not None:
                if held >= t1:
                    break
                remembered, held = before + (after - before) * (held - t0) / dt_us, None
            sign = 1 if after > remembered else -1
            size = on if sign > 0 else off
            if after == before or abs(after - remembered) + TOLERANCE < size:
                break
            t = t0 + (remembered + sign * size - before) / (after - before) * dt_us
            t = min(max(round(t), t0 + 1), t1)
            events.append((t, sign))
            held = t + refractory_us
    return events


@pytest.mark.parametrize("refractory_us", [1, 700, 1000, 2500, 20_000])
@pytest.mark.parametrize(("on", "off"), [(0.2, 0.2), (0.02, 0.3)])
def test_a_refractory_period_runs_as_an_event_by_event_simulation_has_it(refractory_us, on, off):
    for seed in range(2):
        values = np.exp(np.cumsum(np.random.default_rng(seed).normal(0, 0.6, 60))).astype(np.float32)
        fields = {"contrast_threshold": on, "contrast_threshold_off": off, "refractory_us": refractory_us}
        events = play(values, **fields)
        truth = simulate_refractory_period(values, 1000, refractory_us, on, off)
        assert list(zip(events["t"].tolist(), events["p"].tolist(), strict=True)) == truth
        assert len(truth) > (2 if refractory_us > 10_000 else 15)


@settings(max_examples=30)
@given(arrays(np.float32, 8, elements=LUMINANCES), st.integers(1, 3000), st.sampled_from([1e-3, 0.2]))
def test_a_pixel_fires_at_most_once_per_refractory_period_at_any_frame_rate(values, refractory_us, threshold):
    for dt_us in (1, 100, 5000):
        events = play(values, dt_us, refractory_us=refractory_us, contrast_threshold=threshold)
        assert (np.diff(events["t"]) >= refractory_us).all()
        assert ((events["t"] >= 1) & (events["t"] <= 7 * dt_us)).all()


def test_a_refractory_period_ends_with_a_reset():
    camera = EventCamera(1, 1, refractory_us=10_000)
    for start_us in (0, 2000):
        camera.reset(frame(0.1), start_us)
        assert len(camera.step(frame(0.5), start_us + 1000)) == 1
        assert len(camera.step(frame(0.1), start_us + 1001)) == 0


def test_carried_events_come_at_the_start_of_later_frames_until_none_is_left():
    values = np.exp([0.0, 2.0, 2.0, 2.0, 2.0, 2.0])
    events = play(values, max_events_per_pixel=3, excess="carry")
    assert len(events) == 10
    assert events["t"].tolist() == [100, 200, 300, *[1001] * 3, *[2001] * 3, 3001]


@settings(max_examples=30)
@given(
    arrays(np.float32, (5, 2, 3), elements=LUMINANCES),
    st.sampled_from([1, 7, 50]),
    st.sampled_from([0.2, 1.7]),
)
def test_carrying_keeps_the_brightness_integral_whatever_the_cap(frames, cap, threshold):
    camera = EventCamera(3, 2, contrast_threshold=threshold, max_events_per_pixel=cap, excess="carry")
    camera.reset(frames[0], 0)
    level = np.log(frames[0].astype(np.float64) + 1e-3)
    for k, image in enumerate([*frames[1:], *[frames[-1]] * math.ceil(100 / threshold / cap)], 1):
        events = camera.step(image, 1000 * k)
        np.add.at(level, (events["y"], events["x"]), threshold * events["p"])
        assert camera.dropped == 0
        assert np.unique(events[["x", "y"]], return_counts=True)[1].max(initial=0) <= cap
    assert (np.abs(np.log(frames[-1].astype(np.float64) + 1e-3) - level) < threshold).all()


def test_the_same_bytes_come_out_on_every_machine():
    state, digest = 1, hashlib.sha256()
    camera = EventCamera(9, 7, contrast_threshold=0.11, threshold_mismatch=0.0, contrast_threshold_off=0.13)
    for k in range(20):
        pixels = []
        for _ in range(63):
            state = (state * 1103515245 + 12345) % 2**31
            pixels.append(state >> 12)
        image = (np.array(pixels, np.float32) / np.float32(2**19)).reshape(7, 9)
        if k == 0:
            camera.reset(image, 0)
        else:
            digest.update(camera.step(image, 777 * k).tobytes())
    assert digest.hexdigest()[:16] == "825e8d91398eeda9"


@pytest.mark.parametrize("fields", [{}, {"memory": "frame"}, {"refractory_us": 100}, {"encoding": "gamma8"}])
def test_several_frames_in_one_call_give_the_bytes_of_one_call_each(fields):
    one, many = (
        EventCamera(16, 12, max_events_per_pixel=2, contrast_threshold=0.05, **fields) for _ in range(2)
    )
    frames = np.stack([texture(0.004 * k) for k in range(9)])
    one.reset(frames[0], 5)
    many.reset(frames[0], 5)
    events, dropped = [], 0
    for k in range(1, 9):
        events.append(one.step(frames[k], 5 + 777 * k))
        dropped += one.dropped
    times = [5 + 777 * k for k in range(1, 9)]
    with pytest.raises(ValueError, match="got 782 after 782"):  # then none is taken
        many.steps(frames[1:], [782, *times[:-1]])
    for wrong in (frames[1:, :5], frames[:0]):
        with pytest.raises(ValueError, match="float32"):
            many.steps(wrong, times[: len(wrong)])
    assert many.steps(frames[1:], times).tobytes() == np.concatenate(events).tobytes()
    assert many.dropped == dropped > 0
    assert many.step(frames[3], 9000).tobytes() == one.step(frames[3], 9000).tobytes()


def test_an_environment_has_the_floor_of_rendered_luminance_where_none_is_given():
    for env in (EnvConfig(), EnvConfig(camera=CameraConfig(width=9)), EnvConfig(camera={"width": 9})):
        assert env.camera.luminance_floor == sensor_settings(env)["luminance_floor"] == 1e-3
    assert EventCamera(CameraConfig()).config.luminance_floor == 1e-3
    assert EnvConfig(camera=CameraConfig(luminance_floor=0.5)).camera.luminance_floor == 0.5
