"""The camera at the ends of its ranges: each case has one defined result."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from envs.events import EventCamera
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
@pytest.mark.parametrize("threshold", [1e-6, 0.2])
def test_identical_frames_make_nothing_and_change_nothing(memory, threshold):
    rng = np.random.default_rng(0)
    first, second = (rng.random((9, 7)).astype(np.float32) for _ in range(2))
    waited, direct = (EventCamera(7, 9, memory=memory, contrast_threshold=threshold) for _ in range(2))
    for camera in (waited, direct):
        camera.reset(first, 0)
    assert sum(waited.step(first, k).size for k in range(1, 100)) == 0
    events, truth = waited.step(second, 199), direct.step(second, 100)
    assert len(events) > 30
    assert np.array_equal(np.sort(events[["x", "y", "p"]]), np.sort(truth[["x", "y", "p"]]))


@pytest.mark.parametrize("threshold", [1e-6, 0.2, 10.0])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_step_of_exactly_one_threshold_is_one_event(threshold, sign):
    after = np.float32(np.exp(sign * threshold))
    if threshold < 1e-5:  # float32 has nothing so near to 1 + 1e-6 but 1 + 8 ulp
        after = np.float32(1.0) + np.float32(sign * threshold)
    fields = {"response": "lin_log", "luminance_floor": 1e-9}  # a logarithm without anything added
    _, events = two_frames(1.0, after, contrast_threshold=threshold, **fields)
    assert events["p"].tolist() == [sign]


def test_the_smallest_threshold_stays_within_the_cap_and_its_memory():
    tracemalloc.start()
    camera, events = two_frames(1e-4, 2.2, shape=(32, 32), contrast_threshold=1e-6, max_events_per_pixel=100)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(events) == 32 * 32 * 100
    assert camera.dropped > 32 * 32 * 7_000_000
    assert peak < 50 * len(events)
    assert camera.step(frame(2.2, (32, 32)), 2000).size == 0


@pytest.mark.parametrize("t0", [10 * 3600 * 10**6, 2**52 - 10_000, -(2**52) + 1])
@pytest.mark.parametrize("fields", [{}, {"refractory_us": 100}, {"memory": "legacy"}])
def test_a_late_clock_loses_no_microsecond(t0, fields):
    _, early = two_frames(1.0, np.exp(1.05), 5000, **fields)
    _, late = two_frames(1.0, np.exp(1.05), 5000, t0=t0, **fields)
    assert np.array_equal(early["t"], late["t"] - t0)
    assert len(early) >= 4


@settings(max_examples=60)
@given(arrays(np.float32, (4, 2, 2), elements=ANY_LIGHT), st.sampled_from(MEMORIES), st.data())
def test_any_finite_light_and_any_settings_give_valid_events_in_total_order(frames, memory, data):
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
    dt_us = data.draw(st.sampled_from([1, 7, 5000, 2**50]))
    for k in range(1, 4):
        events = camera.step(frames[k], k * dt_us - 5)
        assert ((events["t"] > (k - 1) * dt_us - 5) & (events["t"] <= k * dt_us - 5)).all()
        assert np.array_equal(np.lexsort((events["x"], events["y"], events["t"])), np.arange(len(events)))
        assert np.isin(events["p"], (-1, 1)).all()
        assert max(events["x"].max(initial=0), events["y"].max(initial=0)) <= 1
        assert len(events) <= 4 * 50
        assert camera.dropped >= 0
