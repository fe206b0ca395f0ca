"""The camera at the ends of its ranges: each case has one defined result."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from envs.config import FaultsConfig
from envs.events import EventCamera, apply_faults, draw_pixel_faults
from envs.events.camera import MAX_EVENTS_PER_FRAME
from envs.events.photoreceptor import MAX_LUMINANCE

ANY_LIGHT = st.floats(0, MAX_LUMINANCE, width=32, allow_subnormal=True)
MEMORIES = ("reference", "frame", "legacy")


def frame(value, shape=(1, 1)):
    return np.full(shape, value, np.float32)


def two_frames(before, after, dt_us=1000, shape=(1, 1), t0=0, **fields):
    """The camera and its events of one step between two uniform frames."""
    camera = EventCamera(shape[1], shape[0], **{"max_events_per_pixel": 100_000} | fields)
    camera.reset(frame(before, shape), t0)
    return camera, camera.step(frame(after, shape), t0 + dt_us)


@pytest.mark.parametrize("memory", MEMORIES)
def test_1_identical_frames_make_nothing_and_change_nothing(memory):
    rng = np.random.default_rng(0)
    first, second = (rng.random((9, 7)).astype(np.float32) for _ in range(2))
    waited, direct = (EventCamera(7, 9, memory=memory) for _ in range(2))
    for camera in (waited, direct):
        camera.reset(first, 0)
    assert sum(waited.step(first, k).size for k in range(1, 100)) == 0
    events, truth = waited.step(second, 199), direct.step(second, 100)
    assert len(events) > 30
    assert np.array_equal(np.sort(events[["x", "y", "p"]]), np.sort(truth[["x", "y", "p"]]))


@pytest.mark.parametrize("threshold", [1e-6, 1e-4, 0.05, 0.2, 1.0, 10.0])
@pytest.mark.parametrize("sign", [1, -1])
def test_2_a_step_of_exactly_one_threshold_is_one_event(threshold, sign):
    before = np.float32(1.0)
    after = np.float32(np.exp(sign * threshold))
    if threshold < 1e-5:  # float32 has nothing so near to 1 + 1e-6 but 1 + 8 ulp
        after = np.float32(1.0) + np.float32(sign * threshold)
    fields = {"response": "lin_log", "luminance_floor": 1e-9}  # a logarithm without anything added
    _, events = two_frames(before, after, contrast_threshold=threshold, **fields)
    assert events["p"].tolist() == [sign]


@pytest.mark.parametrize("threshold", [0.05, 0.2, 0.7])
def test_3_a_step_of_exactly_k_thresholds_is_k_events_without_drift(threshold):
    camera = EventCamera(1, 1, contrast_threshold=threshold, luminance_floor=1e-9)
    camera.reset(frame(1.0), 0)
    for k in range(1, 101):
        if k * threshold < 88:
            assert len(camera.step(frame(np.exp(k * threshold)), 2 * k)) == k
            assert len(camera.step(frame(1.0), 2 * k + 1)) == k


@pytest.mark.parametrize(
    ("before", "after", "threshold", "count"),
    [
        pytest.param(0, 100, 0.2, 57, id="4: black to very bright, floor(log(1e5 + 1) / 0.2)"),
        pytest.param(100, 0, 0.2, 57, id="4: and back"),
        pytest.param(0, 0, 0.2, 0, id="5: black stays black"),
        pytest.param(1e-45, 1e-38, 0.2, 0, id="8: subnormal"),
        pytest.param(0, 1e-45, 1e-6, 0, id="8: the smallest light"),
        pytest.param(1e38, 3e38, 0.2, 5, id="9: near the largest float32"),
        pytest.param(0, MAX_LUMINANCE, 0.2, 478, id="9: all of float32"),
        pytest.param(0.5, 0.9, 10, 0, id="11: the largest threshold"),
        pytest.param(0, 1e38, 10, 9, id="11: which still fires"),
    ],
)
@pytest.mark.parametrize("memory", ["reference", "frame"])
def test_luminance_at_the_ends_of_float32(before, after, threshold, count, memory):
    _, events = two_frames(before, after, contrast_threshold=threshold, memory=memory)
    assert len(events) == count


def test_6_a_jump_of_all_greys_is_capped_and_the_loss_is_reported():
    camera, events = two_frames(1 / 255, 1, contrast_threshold=0.05, max_events_per_pixel=100)
    assert (len(events), camera.dropped) == (100, 6)  # log(1.001 / (1 / 255 + 0.001)) is 106.3 thresholds
    assert len(camera.step(frame(1 / 255), 2000)) == 100


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -1.0, -1e-45])
@pytest.mark.parametrize("memory", MEMORIES)
def test_7_what_is_no_luminance_is_refused_by_pixel_and_the_next_frame_works(bad, memory):
    camera, _ = two_frames(0.1, 0.2, shape=(4, 6), memory=memory)
    other, _ = two_frames(0.1, 0.2, shape=(4, 6), memory=memory)
    poisoned = frame(0.9, (4, 6))
    poisoned[2, 3] = bad
    with pytest.raises(ValueError, match="x=3, y=2"):
        camera.step(poisoned, 2000)
    good = frame(0.7, (4, 6))
    assert camera.step(good, 3000).tobytes() == other.step(good, 3000).tobytes() != b""


@pytest.mark.parametrize("key", ["contrast_threshold", "contrast_threshold_off"])
@pytest.mark.parametrize("value", [0.0, -0.2, 9e-7, 10.001, float("nan"), float("inf"), "0.2", True])
def test_10_a_threshold_out_of_range_is_refused(key, value):
    with pytest.raises(ValueError, match=key):
        EventCamera(1, 1, **{key: value})


def test_10_the_smallest_threshold_stays_within_the_cap_and_its_memory():
    tracemalloc.start()
    camera, events = two_frames(1e-4, 2.2, shape=(32, 32), contrast_threshold=1e-6, max_events_per_pixel=100)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(events) == 32 * 32 * 100
    assert camera.dropped > 32 * 32 * 7_000_000
    assert peak < 50 * len(events)
    assert camera.step(frame(2.2, (32, 32)), 2000).size == 0


@pytest.mark.parametrize("t_us", [0, -1, 1.0, None, 2**52, "1"])
def test_12_a_time_that_does_not_advance_is_refused(t_us):
    camera = EventCamera(1, 1)
    camera.reset(frame(1.0), 0)
    with pytest.raises(ValueError, match="t_us"):
        camera.step(frame(2.0), t_us)


@pytest.mark.parametrize("dt_us", [1, 2, 1000, 22_222, 10**9, 2**51])
def test_12_events_of_any_interval_are_in_total_order(dt_us):
    rng = np.random.default_rng(1)
    camera = EventCamera(9, 11)
    camera.reset(rng.random((11, 9)).astype(np.float32), 0)
    events = camera.step(rng.random((11, 9)).astype(np.float32), dt_us)
    order = np.lexsort((events["x"], events["y"], events["t"]))
    assert np.array_equal(order, np.arange(len(events)))
    assert len(events) > 200
    assert 1 <= events["t"].min() <= events["t"].max() <= dt_us


@pytest.mark.parametrize("t0", [10 * 3600 * 10**6, 10**13, 2**52 - 10_000, -(2**52) + 1])
@pytest.mark.parametrize("fields", [{}, {"refractory_us": 100}, {"memory": "legacy"}])
def test_13_a_late_clock_loses_no_microsecond(t0, fields):
    _, early = two_frames(1.0, np.exp(1.05), 5000, **fields)
    _, late = two_frames(1.0, np.exp(1.05), 5000, t0=t0, **fields)
    assert np.array_equal(early["t"], late["t"] - t0)
    assert len(early) >= 4


@pytest.mark.parametrize("rate_hz", [45, 1000, 100_000])
def test_14_a_refractory_period_longer_than_the_interval_allows_one_event(rate_hz):
    camera = EventCamera(4, 4, refractory_us=50_000)
    camera.reset(frame(0.1, (4, 4)), 0)
    times = [round(k * 1e6 / rate_hz) for k in range(1, max(6, min(rate_hz // 10, 300)))]
    steps = [camera.step(frame((0.9, 0.1)[k % 2], (4, 4)), t) for k, t in enumerate(times)]
    events = np.concatenate(steps)
    for x, y in np.ndindex(4, 4):
        assert (np.diff(events["t"][(events["x"] == x) & (events["y"] == y)]) >= 50_000).all()
    assert 16 <= len(events) <= 16 * (1 + times[-1] // 50_000)


def test_15_a_burst_of_all_pixels_keeps_every_row():
    shape = (48, 64)
    light = np.geomspace(0.5, 2.0, shape[0] * shape[1]).reshape(shape).astype(np.float32)
    camera = EventCamera(64, 48, max_events_per_pixel=7)
    camera.reset(frame(1e-3, shape), 0)
    events = camera.step(light, 5000)
    assert np.unique(events[["x", "y"]], return_counts=True)[1].tolist() == [7] * light.size
    assert camera.dropped > 0


def moving_edges(t_s, shape=(16, 24)):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return (0.5 + 0.45 * np.sin((x - 20.0 * t_s) * 0.9 + 0.2 * y)).astype(np.float32)


@pytest.mark.parametrize("every", [2, 4, 8, 16, 32])
def test_16_leaving_out_frames_keeps_the_brightness_within_a_threshold(every):
    camera = EventCamera(24, 16)
    camera.reset(moving_edges(0.0), 0)
    level = np.log(moving_edges(0.0).astype(np.float64) + 1e-3)
    count = 0
    for k in range(every, 129, every):
        events = camera.step(moving_edges(k / 640), 1000 * k)
        np.add.at(level, (events["y"], events["x"]), 0.2 * events["p"])
        count += len(events)
        assert (np.abs(np.log(moving_edges(k / 640).astype(np.float64) + 1e-3) - level) < 0.2).all()
    assert count > 1500


@pytest.mark.parametrize(("sparsity", "left"), [(0.0, 96), (0.5, 48), (1.0, 0)])
def test_17_dead_pixels_from_none_to_all(sparsity, left):
    faults = FaultsConfig(sparsity=sparsity)
    pixels = [draw_pixel_faults((8, 12), faults, np.random.default_rng(3)) for _ in range(2)]
    assert np.array_equal(pixels[0].dead, pixels[1].dead)
    _, events = two_frames(0.5, 0.9, shape=(8, 12), contrast_threshold=0.5)
    kept = apply_faults(events, 0, 1000, faults, pixels[0], np.random.default_rng(0))
    assert len(events) == 96
    assert len(kept) == left
    with pytest.raises(ValueError, match="sparsity"):
        FaultsConfig(sparsity=1.2)


@pytest.mark.parametrize("share", [0.0, 1.0, 10.0])
def test_18_noise_from_none_to_ten_times_the_signal_lies_on_the_sensor(share):
    faults = FaultsConfig(background_activity=share)
    pixels = draw_pixel_faults((30, 40), faults, np.random.default_rng(0))
    _, events = two_frames(0.5, 0.9, shape=(30, 40), contrast_threshold=0.5)
    rng = np.random.default_rng(1)
    noisy = apply_faults(events, 0, 1000, faults, pixels, rng)
    assert abs(len(noisy) - 1200 * (1 + share)) <= 4 * np.sqrt(1200 * share)
    assert noisy["x"].max() < 40
    assert noisy["y"].max() < 30
    assert apply_faults(events[:0], 0, 1000, faults, pixels, rng).size == 0


@pytest.mark.parametrize("rate_hz", [45, 200, 1000, 100_000, 1_000_000])
def test_event_counts_do_not_depend_on_frame_rates_from_45_hz_to_1_mhz(rate_hz):
    camera = EventCamera(3, 2, luminance_floor=1e-9)
    end_us = 40_000 if rate_hz < 100_000 else 2000
    times = np.unique(np.append(np.arange(1, end_us * rate_hz // 10**6 + 1) * 10**6 // rate_hz, end_us))
    light = np.exp(np.multiply.outer(times * (2.1 / end_us), np.linspace(-1.0, 1.0, 6)).reshape(-1, 2, 3))
    camera.reset(frame(1.0, (2, 3)), 0)
    steps = [camera.step(v, int(t)) for v, t in zip(light.astype(np.float32), times, strict=True)]
    assert sum(len(s) for s in steps) == 10 + 6 + 2 + 2 + 6 + 10


@settings(max_examples=80, deadline=None)
@given(arrays(np.float32, (4, 2, 2), elements=ANY_LIGHT), st.sampled_from(MEMORIES), st.data())
def test_any_finite_light_and_any_settings_give_valid_events(frames, memory, data):
    real = memory == "reference"
    refractory_us = data.draw(st.sampled_from([0, 1, 900])) if real else 0
    camera = EventCamera(
        2,
        2,
        memory=memory,
        contrast_threshold=data.draw(st.sampled_from([1e-6, 1e-3, 0.2, 10.0])),
        contrast_threshold_off=data.draw(st.sampled_from([None, 1e-6, 0.3])),
        luminance_floor=data.draw(st.sampled_from([1e-9, 1e-3, 1.0])),
        response=data.draw(st.sampled_from(["log", "lin_log"])),
        threshold_mismatch=data.draw(st.sampled_from([0.0, 0.03, 1.0])),
        refractory_us=refractory_us,
        excess=data.draw(st.sampled_from(["drop", "carry"])) if real and not refractory_us else "drop",
        encoding=data.draw(st.sampled_from(["linear32", "linear8", "gamma8"])),
        max_events_per_pixel=50,
    )
    camera.reset(frames[0], -5)
    dt_us = data.draw(st.sampled_from([1, 7, 5000]))
    for k in range(1, 4):
        events = camera.step(frames[k], k * dt_us - 5)
        assert ((events["t"] > (k - 1) * dt_us - 5) & (events["t"] <= k * dt_us - 5)).all()
        assert np.array_equal(np.lexsort((events["x"], events["y"], events["t"])), np.arange(len(events)))
        assert np.isin(events["p"], (-1, 1)).all()
        assert max(events["x"].max(initial=0), events["y"].max(initial=0)) <= 1
        assert len(events) <= 4 * 50
        assert camera.dropped >= 0


def test_one_pixel_and_the_largest_pictures_work_alike():
    _, one = two_frames(0.1, 0.9)
    _, many = two_frames(0.1, 0.9, shape=(720, 1280), contrast_threshold=1.0)
    assert len(one) == 10
    assert len(many) == 2 * 1280 * 720
    assert (many["x"][1279], many["y"][1279], many["x"][1280], many["y"][1280]) == (1279, 0, 0, 1)
    assert MAX_EVENTS_PER_FRAME >= 4096 * 4096


@pytest.mark.slow
def test_a_burst_of_a_million_pixels_is_cut_by_time_within_the_limit():
    light = np.geomspace(0.5, 2.0, 1280 * 720).reshape(720, 1280).astype(np.float32)
    camera = EventCamera(1280, 720, contrast_threshold=0.05)
    camera.reset(frame(1e-3, light.shape), 0)
    events = camera.step(light, 5000)
    assert 0.99 * MAX_EVENTS_PER_FRAME < len(events) <= MAX_EVENTS_PER_FRAME
    assert camera.dropped > 7e7
    assert np.unique(events["y"]).size == 720
