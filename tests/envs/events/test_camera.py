import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from envs.config import CameraConfig, with_floor
from envs.events import EVENT, EventCamera
from envs.events.crossings import MOST_CROSSINGS, NEVER_QUIET

FLOOR = 1e-9  # small enough to leave log(luminance) alone where luminance is about 1
LUMINANCES = st.floats(0, np.finfo(np.float32).max, width=32, allow_subnormal=True)
THRESHOLDS = st.sampled_from([0.03, 0.2, 1.7])


def frame(value, shape=(1, 1)):
    return np.full(shape, value, np.float32)


def one_pixel(**fields):
    return EventCamera(1, 1, **{"luminance_floor": FLOOR, "max_events_per_pixel": 100_000} | fields)


def play(camera, values, dt_us=1000):
    """Events of one pixel that shows `values` one after the other."""
    camera.reset(frame(values[0]), 0)
    steps = [camera.step(frame(v), (i + 1) * dt_us) for i, v in enumerate(values[1:])]
    return np.concatenate([np.empty(0, EVENT), *steps])


def moving_edges(t_s, shape=(16, 24)):
    """A smooth texture that moves 20 pixels a second, float32 luminance."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    phase = (x - 20.0 * t_s) * 0.9 + 0.2 * y
    return (0.5 + 0.45 * np.sin(phase)).astype(np.float32)


def flight(camera, rate_hz, seconds=0.2):
    camera.reset(moving_edges(0.0), 0)
    times = [round(k * 1e6 / rate_hz) for k in range(1, round(seconds * rate_hz) + 1)]
    return np.concatenate([camera.step(moving_edges(t * 1e-6), t) for t in times])


def total_order(events):
    return np.lexsort((events["x"], events["y"], events["t"]))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_log_linear_ramp_fires_exactly_when_it_crosses_each_level(sign):
    start = 1.0
    end = np.float32(np.exp(sign * 1.05))
    events = play(one_pixel(), [start, end], dt_us=5000)
    slope = abs(np.log(float(end))) / 5000
    assert events["t"].tolist() == [round(k * 0.2 / slope) for k in range(1, 6)]
    assert events["t"].tolist() == [952, 1905, 2857, 3810, 4762]
    assert (events["p"] == sign).all()


def test_times_of_a_sinusoid_converge_with_the_square_of_the_frame_interval():
    def worst(frames):
        t = np.linspace(0.0, 1e6, frames + 1)
        camera = one_pixel(contrast_threshold=0.07)
        luminance = np.exp(1.3 * np.sin(2 * np.pi * t / 1e6)).astype(np.float32)
        camera.reset(frame(luminance[0]), 0)
        steps = [camera.step(frame(v), round(u)) for u, v in zip(t[1:], luminance[1:], strict=True)]
        events = np.concatenate(steps)
        levels = np.cumsum(events["p"]) * 0.07
        truth = 1.3 * np.sin(2 * np.pi * events["t"] / 1e6)
        assert len(events) > 60
        return np.abs(truth - levels)[np.abs(levels) < 1.1].max()  # away from the turning points

    coarse, middle, fine = worst(50), worst(100), worst(200)
    assert coarse / middle > 3.0
    assert middle / fine > 3.0


@settings(max_examples=60, deadline=None)
@given(arrays(np.float32, (6, 2, 3), elements=LUMINANCES), THRESHOLDS, THRESHOLDS)
def test_the_sum_of_events_stays_within_one_threshold_of_the_brightness(frames, on, off):
    config = CameraConfig(width=3, height=2, contrast_threshold=on, contrast_threshold_off=off)
    camera = EventCamera(config, max_events_per_pixel=100_000)
    camera.reset(frames[0], 0)
    first = np.log(frames[0].astype(np.float64) + 1e-3)
    level = first.copy()
    for k, image in enumerate(frames[1:], 1):
        events = camera.step(image, 1000 * k)
        assert (np.diff(events["t"]) >= 0).all()
        assert ((events["t"] > 1000 * (k - 1)) & (events["t"] <= 1000 * k)).all()
        assert np.array_equal(total_order(events), np.arange(len(events)))
        np.add.at(level, (events["y"], events["x"]), np.where(events["p"] > 0, on, -off))
        residual = np.log(image.astype(np.float64) + 1e-3) - level
        assert (residual < on).all()
        assert (residual > -off).all()


@settings(max_examples=60, deadline=None)
@given(arrays(np.float32, (5, 2, 3), elements=LUMINANCES), THRESHOLDS)
def test_frame_memory_fires_the_whole_thresholds_of_each_difference(frames, threshold):
    camera = EventCamera(3, 2, contrast_threshold=threshold, memory="frame", max_events_per_pixel=100_000)
    camera.reset(frames[0], 0)
    logs = np.log(frames.astype(np.float64) + 1e-3)
    for k in range(1, len(frames)):
        events = camera.step(frames[k], 1000 * k)
        count = np.zeros((2, 3), int)
        np.add.at(count, (events["y"], events["x"]), events["p"])
        change = logs[k] - logs[k - 1]
        assert np.array_equal(count, np.sign(change) * np.floor((np.abs(change) + 2.0**-23) / threshold))


def test_identical_frames_make_no_events_even_at_the_smallest_threshold():
    luminance = np.random.default_rng(0).random((8, 8)).astype(np.float32)
    for memory in ("reference", "frame"):
        camera = EventCamera(8, 8, contrast_threshold=1e-6, memory=memory)
        camera.reset(luminance, 0)
        assert sum(camera.step(luminance, k).size for k in range(1, 20)) == 0


def test_a_still_pixel_never_fires_whatever_rounding_did_to_its_memory():
    camera = one_pixel()
    camera.reset(frame(2.0), 0)
    lights, levels, *_ = camera._memory
    lights[1] = NEVER_QUIET
    levels["first_level"] -= 0.2
    assert camera.step(frame(2.0), 1000).size == 0


@pytest.mark.parametrize("threshold", [1e-6, 1e-3, 0.2, 3.0])
@pytest.mark.parametrize("off", [None, 0.07])
@pytest.mark.parametrize("response", ["log", "lin_log"])
@pytest.mark.parametrize("floor", [1e-9, 0.01, 1.0])
def test_no_pixel_within_its_quiet_band_would_fire(threshold, off, response, floor):
    fields = {"luminance_floor": floor, "response": response, "max_events_per_pixel": 3}
    cameras = [
        EventCamera(64, 64, contrast_threshold=threshold, contrast_threshold_off=off, **fields)
        for _ in range(2)
    ]
    rng = np.random.default_rng(0)
    first = np.exp(rng.normal(np.log(floor), 4.0, (64, 64)))
    for camera in cameras:
        camera.reset(first.astype(np.float32), 0)
    for k in range(1, 12):
        levels = rng.choice([0.0, threshold, -(off or threshold)], (64, 64))  # as near as float32 comes
        frame = (first + floor) * np.exp(levels) * (1.0 + rng.integers(-8, 9, (64, 64)) * 2.0**-25) - floor
        if response == "lin_log":
            frame = np.where(first > floor, frame + floor * (1.0 - np.exp(levels)), first + floor * levels)
        frame = np.maximum(frame, 0.0).astype(np.float32)
        cameras[1].state[1][0][1] = NEVER_QUIET  # each pixel is decided exactly
        events = [camera.step(frame, 1000 * k) for camera in cameras]
        assert events[0].tobytes() == events[1].tobytes()


@pytest.mark.parametrize("off", [None, 2.0**-18])
def test_a_count_that_is_full_begins_again_without_moving_the_level(off):
    threshold = 2.0**-19
    cameras = [one_pixel(contrast_threshold=threshold, contrast_threshold_off=off) for _ in range(2)]
    for camera in cameras:
        camera.reset(frame(1.0), 0)
    level = cameras[1].state[1][1]
    level["on_count"] = MOST_CROSSINGS
    level["first_level"] -= MOST_CROSSINGS * threshold
    for k, light in enumerate((1.0005, 1.002, 0.999, 1.0), 1):
        expected, events = (camera.step(frame(light), 1000 * k) for camera in cameras)
        assert np.array_equal(events["p"], expected["p"])
        assert np.abs(events["t"] - expected["t"]).max() <= 1  # the first level was rounded
        assert max(level["on_count"], level["off_count"]) < 10_000


@pytest.mark.parametrize("parts", [2, 5, 10, 200])
def test_a_log_linear_motion_gives_the_same_events_in_one_step_or_in_many(parts):
    whole = play(one_pixel(), np.exp([0.0, 2.1]), dt_us=100_000)
    split = play(one_pixel(), np.exp(np.linspace(0.0, 2.1, parts + 1)), dt_us=100_000 // parts)
    assert len(whole) == len(split) == 10
    assert np.abs(whole["t"] - split["t"]).max() <= 1


@pytest.mark.parametrize("threshold", [0.05, 0.2, 0.3, 0.7])
def test_a_step_of_exactly_k_thresholds_gives_k_events_and_returns_to_its_level(threshold):
    for k in range(1, min(100, int(85 / threshold)) + 1):
        values = np.float32([1.0, np.exp(k * threshold), 1.0, np.exp(-min(k * threshold, 8.0)), 1.0])
        camera = one_pixel(contrast_threshold=threshold)
        events = play(camera, values)
        steps = [events["p"][(events["t"] - 1) // 1000 == i].sum() for i in range(4)]
        assert steps[:2] == [k, -k]
        assert steps[2] == -steps[3]


def test_inverted_luminance_gives_the_same_times_with_opposite_polarity():
    logs = np.cumsum(np.random.default_rng(1).normal(0, 0.5, 40))
    events = play(one_pixel(), np.exp(logs))
    inverse = play(one_pixel(), np.exp(-logs))
    assert len(events) > 40
    assert np.abs(events["t"] - inverse["t"]).max() <= 1
    assert (events["p"] == -inverse["p"]).all()


@pytest.mark.parametrize("gain", [0.25, 2.0**20, 1e30])
def test_gain_changes_nothing_without_a_floor(gain):
    values = np.exp(np.cumsum(np.random.default_rng(2).normal(0, 0.4, 40))).astype(np.float32)
    events = play(one_pixel(), values)
    louder = play(one_pixel(), values * np.float32(gain))
    assert len(events) > 30
    assert np.array_equal(events["p"], louder["p"])
    assert np.abs(events["t"] - louder["t"]).max() <= 1


def test_event_counts_do_not_depend_on_the_frame_rate_with_reference_memory():
    counts = [len(flight(EventCamera(24, 16), rate)) for rate in (45, 100, 200, 400, 800)]
    assert counts[0] > 2000
    assert max(counts) / min(counts) < 1.03


def test_frame_memory_starves_at_high_rates():
    counts = [len(flight(EventCamera(24, 16, memory="frame"), rate)) for rate in (45, 100, 200)]
    truth = len(flight(EventCamera(24, 16), 200))
    assert truth > counts[0] > counts[1] > 0.1 * truth
    assert counts[2] == 0


@pytest.mark.parametrize("memory", ["reference", "frame"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -1.0, -1e-45])
def test_a_frame_with_a_bad_pixel_is_refused_by_name_and_changes_nothing(bad, memory):
    camera, untouched = EventCamera(24, 16, memory=memory), EventCamera(24, 16, memory=memory)
    for c in (camera, untouched):
        c.reset(moving_edges(0.0), 0)
    poisoned = moving_edges(0.05)
    poisoned[3, 5] = bad
    with pytest.raises(ValueError, match="x=5, y=3"):
        camera.step(poisoned, 50_000)
    good = moving_edges(0.1)
    assert camera.step(good, 100_000).tobytes() == untouched.step(good, 100_000).tobytes()
    with pytest.raises(ValueError, match="x=5, y=3"):
        EventCamera(24, 16).reset(poisoned, 0)


def test_infinity_is_refused_also_where_the_quiet_band_ends_at_the_largest_float():
    camera = one_pixel(contrast_threshold=1.0)
    camera.reset(frame(3e38), 0)
    with pytest.raises(ValueError, match="inf"):
        camera.step(frame(np.inf), 1)


@pytest.mark.parametrize("t_us", [0, -1, 1.5, None, 2**63])
def test_a_time_that_does_not_increase_or_is_no_integer_is_refused(t_us):
    camera = one_pixel()
    camera.reset(frame(1.0), 0)
    with pytest.raises(ValueError, match="t_us"):
        camera.step(frame(2.0), t_us)
    assert len(camera.step(frame(np.exp(0.5)), 1)) == 2


@pytest.mark.parametrize(
    "wrong", [np.ones((1, 1)), np.ones((2, 1), np.float32), [[1.0]], np.ones(1, np.float32)]
)
def test_a_frame_of_another_shape_or_dtype_is_refused(wrong):
    with pytest.raises(ValueError, match="luminance must be float32"):
        one_pixel().reset(wrong, 0)


def test_step_before_reset_is_refused():
    with pytest.raises(ValueError, match="reset"):
        one_pixel().step(frame(1.0), 1)


@pytest.mark.parametrize(
    ("name", "value"),
    [("contrast_threshold", 0.0), ("contrast_threshold", np.nan), ("memory", "none"), ("typo", 1)],
)
def test_settings_out_of_range_are_refused(name, value):
    with pytest.raises(ValueError, match=name):
        EventCamera(1, 1, **{name: value})


def test_a_camera_can_be_made_from_its_config():
    config = CameraConfig(width=3, height=2)
    assert EventCamera(config).config == with_floor(config)
    assert EventCamera(config, memory="frame").config == with_floor(
        dataclasses.replace(config, memory="frame")
    )


def test_the_cap_drops_the_latest_events_of_each_pixel_and_counts_them():
    full = EventCamera(4, 4, luminance_floor=FLOOR)
    capped = EventCamera(full.config, max_events_per_pixel=3)
    for camera in (full, capped):
        camera.reset(frame(1.0, (4, 4)), 0)
    burst = frame(np.exp(2.0), (4, 4))
    everything, kept = full.step(burst, 1000), capped.step(burst, 1000)
    assert (len(everything), len(kept), capped.dropped, full.dropped) == (160, 48, 112, 0)
    assert len(np.unique(kept[["x", "y"]])) == 16
    assert np.array_equal(kept, everything[:48])
    assert capped.step(burst, 2000).size == 0, "the memory moves on past what was dropped"
    assert capped.dropped == 0


def test_the_smallest_threshold_stays_within_the_cap():
    camera = EventCamera(64, 64, contrast_threshold=1e-6)
    camera.reset(frame(0.0, (64, 64)), 0)
    assert camera.step(frame(1.0, (64, 64)), 5000).size == 64 * 64 * 100
    assert camera.dropped > 4096 * 6_000_000


@pytest.mark.parametrize(
    ("before", "after", "count"),
    [
        (0.0, 0.0, 0),
        (0.0, 100.0, 57),
        (100.0, 0.0, 57),
        (1e-45, 1e-38, 0),
        (1e38, 3e38, 5),
        (1e-3, 3.4e38, 474),
    ],
)
def test_extreme_luminances_have_defined_results(before, after, count):
    camera = EventCamera(1, 1, max_events_per_pixel=100_000)
    assert len(play(camera, [before, after])) == count


def test_a_late_clock_loses_no_microsecond():
    for t0 in (10 * 3600 * 10**6, 10**13, 2**51):
        camera = one_pixel()
        camera.reset(frame(1.0), t0)
        events = camera.step(frame(np.exp(1.05)), t0 + 5000)
        assert (events["t"] - t0).tolist() == [952, 1905, 2857, 3810, 4762]


@pytest.mark.parametrize("dt_us", [1, 300, 70_000, 10**9, 2**50])
def test_events_are_in_total_order_for_any_interval(dt_us):
    rng = np.random.default_rng(3)
    camera = EventCamera(7, 5)
    camera.reset(rng.random((5, 7)).astype(np.float32), 0)
    events = camera.step(rng.random((5, 7)).astype(np.float32), dt_us)
    assert len(events) > 50
    assert np.array_equal(total_order(events), np.arange(len(events)))
    assert events["t"].min() >= 1
    assert events["t"].max() <= dt_us


def test_on_and_off_thresholds_count_apart():
    camera = one_pixel(contrast_threshold=0.1, contrast_threshold_off=0.3)
    events = play(camera, np.exp([0.0, 1.25, 0.0]))
    assert (events["p"] == 1).sum() == 12
    assert (events["p"] == -1).sum() == 4


def test_a_million_events_do_not_move_the_memory():
    camera = one_pixel(contrast_threshold=0.1)
    low, high = frame(1.0), frame(np.exp(5.05))
    camera.reset(low, 0)
    for k in range(1, 10_001):
        assert len(camera.step(high, 2 * k)) == 50
        assert len(camera.step(low, 2 * k + 1)) == 50
