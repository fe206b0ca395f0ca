"""What the camera's options do: memory, response, thresholds, refractory period, excess, encoding."""

import dataclasses
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

TOLERANCE = 2.0**-23
LUMINANCES = st.floats(0, np.finfo(np.float32).max, width=32, allow_subnormal=True)
GREY = 1 / 255


def frame(value, shape=(1, 1)):
    return np.full(shape, value, np.float32)


def play(values, dt_us=1000, **fields):
    """Events of one pixel that shows `values` one after the other."""
    camera = EventCamera(1, 1, **{"luminance_floor": 1e-9, "max_events_per_pixel": 100_000} | fields)
    camera.reset(frame(values[0]), 0)
    steps = [camera.step(frame(v), (i + 1) * dt_us) for i, v in enumerate(values[1:])]
    return np.concatenate([np.empty(0, EVENT), *steps])


def texture(t_s, shape=(12, 16)):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return (0.5 + 0.45 * np.sin((x - 40.0 * t_s) * 0.9 + 0.3 * y)).astype(np.float32)


def flight(rate_hz, seconds=0.2, shape=(12, 16), **fields):
    camera = EventCamera(shape[1], shape[0], **fields)
    camera.reset(texture(0.0, shape), 0)
    times = [round(k * 1e6 / rate_hz) for k in range(1, round(seconds * rate_hz) + 1)]
    return np.concatenate([camera.step(texture(t * 1e-6, shape), t) for t in times])


def response_of(luminance, name, floor):
    if name == "log":
        return math.log(luminance + floor)
    return math.log(luminance) if luminance > floor else luminance / floor - 1.0 + math.log(floor)


RISE = np.exp([0.0, 1.05])
RAMP = np.exp(0.05 * np.concatenate((np.arange(42), np.arange(40, -1, -1))))
GREY_STEP = [0.0, GREY, 0.0]


@pytest.mark.parametrize(
    ("memory", "rise", "ramp", "parts", "grey"),
    [
        ("reference", 5, 20, (10, 10, 10, 10), 68),
        ("frame", 5, 0, (10, 10, 10, 0), 68),
        ("legacy", 4, 0, (9, 5, 0, 0), 20),
    ],
)
def test_each_memory_has_the_events_of_its_design(memory, rise, ramp, parts, grey):
    fields = {"memory": memory, "max_events_per_pixel": 10 if memory == "legacy" else 100}
    assert len(play(RISE, **fields)) == rise
    assert len(play(RAMP, **fields)) == ramp
    split = [np.exp(np.linspace(0.0, 2.1, n + 1)) for n in (1, 5, 10, 200)]
    assert tuple(len(play(values, **fields)) for values in split) == parts
    assert len(play(GREY_STEP, **fields, luminance_floor=0.001 / 255)) == grey


@pytest.mark.parametrize(("memory", "smallest"), [("reference", 0.2), ("frame", 0.2), ("legacy", 0.4)])
def test_the_smallest_step_that_fires_is_one_threshold_and_two_in_the_published_code(memory, smallest):
    for sign in (1, -1):
        assert len(play(np.exp([0.0, sign * smallest * 1.00001]), memory=memory)) == 1
        assert len(play(np.exp([0.0, sign * smallest * 0.99999]), memory=memory)) == 0


def test_memory_legacy_stamps_events_from_the_start_of_the_interval_on():
    events = play(RISE, dt_us=5000, memory="legacy")
    assert events["t"].tolist() == [1, 1250, 2500, 3750]
    capped = play(np.exp([0.0, 3.0]), dt_us=5000, memory="legacy", max_events_per_pixel=10)
    assert capped["t"].tolist() == [1, *range(500, 5000, 500)]


@pytest.mark.parametrize("memory", ["frame", "legacy"])
def test_a_camera_that_forgets_loses_events_with_each_more_frame(memory):
    counts = [len(flight(rate, memory=memory)) for rate in (50, 100, 200)]
    assert counts[0] > counts[1] > counts[2]


@pytest.mark.parametrize("memory", ["frame", "legacy"])
@pytest.mark.parametrize(("key", "value"), [("refractory_us", 10), ("excess", "carry")])
def test_what_needs_memory_is_refused_without_it(memory, key, value):
    with pytest.raises(ValueError, match=f"(?s){key}.*memory 'reference'"):
        EventCamera(1, 1, memory=memory, **{key: value})
    with pytest.raises(ValueError, match="refractory_us 0"):
        EventCamera(1, 1, refractory_us=5, excess="carry")


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


@pytest.mark.parametrize("threshold", [1e-6, 0.2])
def test_no_threshold_is_zero_whatever_the_mismatch(threshold):
    on, off = pixel_thresholds(CameraConfig(64, 64, threshold_mismatch=1.0, contrast_threshold=threshold))
    assert min(on.min(), off.min()) == max(0.1 * threshold, 1e-6)


@pytest.mark.parametrize("response", ["log", "lin_log"])
def test_every_pixel_counts_in_its_own_thresholds(response):
    fields = {"threshold_mismatch": 0.2, "response": response, "contrast_threshold_off": 0.1}
    camera = EventCamera(16, 16, **fields, max_events_per_pixel=1000)
    on, off = (np.reshape(row, (16, 16)) for row in pixel_thresholds(camera.config))
    camera.reset(frame(0.01, (16, 16)), 0)
    up, down = camera.step(frame(0.9, (16, 16)), 1000), camera.step(frame(1e-4, (16, 16)), 2000)
    low, high, lowest = (response_of(float(np.float32(v)), response, 1e-3) for v in (0.01, 0.9, 1e-4))
    counts = np.zeros((2, 16, 16), int)
    for row, events in zip(counts, (up, down), strict=True):
        np.add.at(row, (events["y"], events["x"]), 1)
    assert np.array_equal(counts[0], np.floor((high - low + TOLERANCE) / on))
    assert np.array_equal(counts[1], np.floor((low + counts[0] * on - lowest + TOLERANCE) / off))
    assert len(np.unique(counts[0])) > 5


@pytest.mark.parametrize("response", ["log", "lin_log"])
def test_with_mismatch_small_steps_stay_within_the_thresholds_of_each_pixel(response):
    camera = EventCamera(16, 12, threshold_mismatch=0.3, contrast_threshold_off=0.1, response=response)
    on, off = (np.reshape(row, (12, 16)) for row in pixel_thresholds(camera.config))
    respond_all = np.vectorize(lambda v: response_of(float(v), response, 1e-3))
    camera.reset(texture(0.0), 0)
    level = respond_all(texture(0.0))
    for k in range(1, 100):
        events = camera.step(texture(k / 2000), 500 * k)
        place = (events["y"], events["x"])
        np.add.at(level, place, np.where(events["p"] > 0, on[place], -off[place]))
        residual = respond_all(texture(k / 2000)) - level
        assert (residual < on).all()
        assert (residual > -off).all()


def test_a_mismatch_too_small_to_matter_gives_the_bytes_of_none():
    assert flight(100).tobytes() == flight(100, threshold_mismatch=1e-300).tobytes()


def walk(seed, size=60, scale=0.6):
    return np.exp(np.cumsum(np.random.default_rng(seed).normal(0, scale, size))).astype(np.float32)


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


@pytest.mark.parametrize("refractory_us", [1, 30, 700, 1000, 2500, 20_000])
@pytest.mark.parametrize(("on", "off"), [(0.2, 0.2), (0.02, 0.3)])
def test_a_refractory_period_runs_as_an_event_by_event_simulation_has_it(refractory_us, on, off):
    for seed in range(4):
        values = walk(seed)
        fields = {"contrast_threshold": on, "contrast_threshold_off": off, "refractory_us": refractory_us}
        events = play(values, **fields)
        truth = simulate_refractory_period(values, 1000, refractory_us, on, off)
        assert list(zip(events["t"].tolist(), events["p"].tolist(), strict=True)) == truth
        assert len(truth) > (2 if refractory_us > 10_000 else 15)


@settings(max_examples=60, deadline=None)
@given(arrays(np.float32, 8, elements=LUMINANCES), st.integers(1, 3000), st.sampled_from([1e-3, 0.2]))
def test_a_pixel_fires_at_most_once_per_refractory_period_at_any_frame_rate(values, refractory_us, threshold):
    for dt_us in (1, 100, 5000):
        events = play(values, dt_us, refractory_us=refractory_us, contrast_threshold=threshold)
        assert (np.diff(events["t"]) >= refractory_us).all()
        assert ((events["t"] >= 1) & (events["t"] <= 7 * dt_us)).all()


def test_after_a_refractory_period_a_pixel_starts_anew_from_the_light_of_that_moment():
    rise = np.exp(np.linspace(0.0, 1.0, 11))  # 1e-4 in log per microsecond
    assert play(rise, refractory_us=500)["t"].tolist() == [2000, 4500, 7000, 9500]
    assert play(np.exp([0.0, 1.0]), 10_000, refractory_us=500)["t"].tolist() == [2000, 4500, 7000, 9500]
    assert play(rise, refractory_us=9000)["t"].tolist() == [2000]
    still = np.concatenate((rise, np.full(30, rise[-1])))
    assert len(play(still, refractory_us=9000)) == 1, (
        "what passed in the refractory period is not made up for"
    )


def test_a_refractory_period_outlasts_frames_and_ends_with_a_reset():
    camera = EventCamera(1, 1, refractory_us=10_000)
    camera.reset(frame(0.1), 0)
    assert len(camera.step(frame(0.5), 1000)) == 1
    assert sum(len(camera.step(frame(v), 1000 + t)) for t, v in ((1, 0.1), (2, 0.9), (3, 0.1))) == 0
    camera.reset(frame(0.1), 5000)
    assert len(camera.step(frame(0.5), 6000)) == 1


def test_a_frame_refused_in_a_refractory_period_changes_nothing():
    cameras = [EventCamera(2, 1, refractory_us=3000) for _ in range(2)]
    good = [np.float32([[0.1, 0.2]]), np.float32([[0.5, 0.1]]), np.float32([[0.1, 0.9]])]
    for camera in cameras:
        camera.reset(good[0], 0)
        camera.step(good[1], 1000)
    with pytest.raises(ValueError, match="x=1, y=0"):
        cameras[0].step(np.float32([[3.0, np.nan]]), 8000)
    assert cameras[0].step(good[2], 9000).tobytes() == cameras[1].step(good[2], 9000).tobytes() != b""


def test_carried_events_come_at_the_start_of_later_frames_until_none_is_left():
    values = np.exp([0.0, 2.0, 2.0, 2.0, 2.0, 2.0])
    events = play(values, max_events_per_pixel=3, excess="carry")
    assert len(events) == 10
    assert events["t"].tolist() == [100, 200, 300, *[1001] * 3, *[2001] * 3, 3001]
    dropped = play(values, max_events_per_pixel=3)
    assert dropped["t"].tolist() == [100, 200, 300]


@settings(max_examples=60, deadline=None)
@given(arrays(np.float32, (5, 2, 3), elements=LUMINANCES), st.integers(1, 50), st.sampled_from([0.2, 1.7]))
def test_carrying_keeps_the_brightness_integral_whatever_the_cap(frames, cap, threshold):
    camera = EventCamera(3, 2, contrast_threshold=threshold, max_events_per_pixel=cap, excess="carry")
    camera.reset(frames[0], 0)
    level = np.log(frames[0].astype(np.float64) + 1e-3)
    for k, image in enumerate([*frames[1:], *[frames[-1]] * math.ceil(500 / cap)], 1):
        events = camera.step(image, 1000 * k)
        np.add.at(level, (events["y"], events["x"]), threshold * events["p"])
        assert camera.dropped == 0
        assert np.unique(events[["x", "y"]], return_counts=True)[1].max(initial=0) <= cap
        assert ((events["t"] > 1000 * (k - 1)) & (events["t"] <= 1000 * k)).all()
    assert (np.abs(np.log(frames[-1].astype(np.float64) + 1e-3) - level) < threshold).all()


@settings(max_examples=60, deadline=None)
@given(arrays(np.float32, (6, 2, 3), elements=LUMINANCES), st.sampled_from([0.03, 0.2, 1.7]))
def test_a_linear_response_in_the_dark_keeps_events_within_one_threshold(frames, threshold):
    camera = EventCamera(3, 2, contrast_threshold=threshold, response="lin_log", max_events_per_pixel=100_000)
    camera.reset(frames[0], 0)
    respond_all = np.vectorize(lambda v: response_of(float(v), "lin_log", 1e-3))
    level = respond_all(frames[0])
    for k, image in enumerate(frames[1:], 1):
        events = camera.step(image, 1000 * k)
        np.add.at(level, (events["y"], events["x"]), threshold * events["p"])
        assert (np.abs(respond_all(image) - level) < threshold).all()


def test_the_dark_is_quieter_with_a_linear_response():
    values = 1e-3 * (0.5 + 0.45 * np.sin(np.linspace(0, 20, 100)))
    counts = [
        len(play(values, response=name, luminance_floor=1e-3, contrast_threshold=0.1))
        for name in ("lin_log", "log")
    ]
    plain = len(play(values, contrast_threshold=0.1))
    assert plain > counts[0] > counts[1] > 0


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
    together = many.steps(frames[1:], [5 + 777 * k for k in range(1, 9)])
    assert together.tobytes() == np.concatenate(events).tobytes()
    assert many.dropped == dropped > 0
    assert many.step(frames[3], 9000).tobytes() == one.step(frames[3], 9000).tobytes()


@pytest.mark.parametrize("encoding", ["linear32", "gamma8"])
def test_of_several_frames_none_is_taken_if_one_is_refused(encoding):
    camera, other = (EventCamera(16, 12, encoding=encoding) for _ in range(2))
    frames = np.stack([texture(0.004 * k) for k in range(4)])
    camera.reset(frames[0], 0)
    other.reset(frames[0], 0)
    bad = frames[1:].copy()
    bad[1, 7, 3] = np.nan
    with pytest.raises(ValueError, match="pixel x=3, y=7 is nan"):
        camera.steps(bad, [10, 20, 30])
    with pytest.raises(ValueError, match="got 20 after 20"):
        camera.steps(frames[1:], [10, 20, 20])
    for wrong in (frames[1:, :5], frames[:0]):
        with pytest.raises(ValueError, match="float32"):
            camera.steps(wrong, [10, 20, 30][: len(wrong)])
    assert camera.steps(frames[1:], [10, 20, 30]).tobytes() == other.steps(frames[1:], [10, 20, 30]).tobytes()


def test_an_environment_has_the_floor_of_rendered_luminance_where_none_is_given():
    envs = (
        EnvConfig(),
        EnvConfig(camera=CameraConfig(width=9)),
        EnvConfig(camera={"width": 9}),
        dataclasses.replace(EnvConfig(), camera=CameraConfig()),
    )
    assert [env.camera.luminance_floor for env in envs] == [1e-3] * 4
    assert {sensor_settings(env)["luminance_floor"] for env in envs} == {1e-3}
    assert EventCamera(CameraConfig()).config.luminance_floor == 1e-3
    assert EnvConfig(camera=CameraConfig(luminance_floor=0.5)).camera.luminance_floor == 0.5
