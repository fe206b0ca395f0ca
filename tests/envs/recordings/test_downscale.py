import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.events import EVENT, EventCamera
from envs.recordings import downscale_events
from tests.support.event_files import some_events as random_events

SHAPES = st.tuples(st.integers(1, 12), st.integers(1, 12))


def some_events(seed: int, count: int, shape: tuple[int, int]) -> np.ndarray:
    return random_events(seed, count, shape[1], shape[0], 10**6)


def sums(events: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    total = np.zeros(shape, np.int64)
    np.add.at(total, (events["y"], events["x"]), events["p"])
    return total


@given(seed=st.integers(0, 2**32 - 1), old=SHAPES, new=SHAPES, bias=st.sampled_from([0.0, 0.5, 0.8]))
@settings(max_examples=40)
def test_each_larger_pixel_keeps_the_change_of_its_block_but_for_less_than_one_event(seed, old, new, bias):
    new = (min(new[0], old[0]), min(new[1], old[1]))
    events = some_events(seed, 1000, old)
    events["p"] = np.where(np.random.default_rng(seed).random(1000) < bias, 1, -1)
    before = events.tobytes()
    found = downscale_events(events, old, new)
    assert events.tobytes() == before
    rows, columns = (np.arange(n) * m // n for n, m in zip(old, new, strict=True))
    pixels, change = np.zeros(new, np.int64), np.zeros(new, np.int64)
    np.add.at(pixels, (rows[:, None], columns[None, :]), 1)
    np.add.at(change, (rows[:, None], columns[None, :]), sums(events, old))
    assert pixels.sum() == old[0] * old[1]
    assert pixels.min() > 0
    assert np.all(np.abs(change - pixels * sums(found, new)) < pixels)
    assert np.all(np.diff(found["t"]) >= 0)
    assert len(found) <= len(events)


def test_a_change_that_the_whole_block_shares_gives_the_events_of_one_pixel():
    t_us = np.arange(0, 7000, 1000)
    events = np.empty(7 * 12, EVENT)
    events["t"] = np.repeat(t_us, 12)
    events["y"], events["x"] = np.tile(np.repeat(np.arange(3), 4), 7), np.tile(np.arange(4), 21)
    events["p"] = np.repeat([1, 1, 1, -1, -1, -1, -1], 12)
    found = downscale_events(events, (3, 4), (1, 1))
    assert found.tolist() == [
        (t, 0, 0, p) for t, p in zip(t_us.tolist(), [1, 1, 1, -1, -1, -1, -1], strict=True)
    ]


@pytest.mark.parametrize("rule", ["integrate", "funnel"])
def test_pixels_of_the_same_size_change_nothing(rule):
    events = some_events(3, 500, (5, 7))
    assert downscale_events(events, (5, 7), (5, 7), rule).tobytes() == events.tobytes()


def test_the_result_is_that_of_a_camera_that_sees_the_mean_log_luminance():
    """An independent way: the larger pixel simulated on the mean of the logs of its block."""
    rng = np.random.default_rng(0)
    logs = np.cumsum(rng.normal(0, 0.05, (200, 8, 8)), axis=0)
    settings = {"contrast_threshold": 0.05, "luminance_floor": 1e-9}
    fine, coarse = EventCamera(8, 8, **settings), EventCamera(2, 2, **settings)
    mean = logs.reshape(200, 2, 4, 2, 4).mean(axis=(2, 4))
    events, expected = [], np.zeros((2, 2))
    for step, (log, mean_log) in enumerate(zip(logs, mean, strict=True)):
        frames = (np.exp(log).astype(np.float32), np.exp(mean_log).astype(np.float32))
        if step == 0:
            fine.reset(frames[0], 0)
            coarse.reset(frames[1], 0)
        else:
            events.append(fine.step(frames[0], 1000 * step))
            expected += sums(coarse.step(frames[1], 1000 * step), (2, 2))
    found = sums(downscale_events(np.concatenate(events), (8, 8), (2, 2)), (2, 2))
    assert np.abs(expected).max() > 2
    assert np.abs(found - expected).max() <= 2  # each of the two levels is known to within one event


def test_funnelling_keeps_every_event_at_the_divided_place():
    events = some_events(1, 1000, (9, 12))
    before = events.copy()
    found = downscale_events(events, (9, 12), (3, 4), "funnel")
    assert np.array_equal(events, before)
    assert np.array_equal(found["t"], events["t"])
    assert np.array_equal(found["p"], events["p"])
    assert np.array_equal(found["x"], events["x"] // 3)
    assert np.array_equal(found["y"], events["y"] // 3)


@pytest.mark.parametrize(
    ("old", "new", "rule", "text"),
    [
        ((8, 8), (9, 8), "integrate", "to_shape must lie between"),
        ((8, 8), (0, 8), "integrate", "to_shape must lie between"),
        ((8, 8), (4, 4), "mean", "rule must be"),
        ((4, 8), (4, 4), "integrate", "outside a sensor of 8x4"),
    ],
)
def test_what_cannot_be_downscaled_is_refused(old, new, rule, text):
    with pytest.raises(ValueError, match=text):
        downscale_events(some_events(0, 100, (8, 8)), old, new, rule)
