import numpy as np
import pytest

from envs.config import CameraConfig
from envs.events import EVENT, EventCamera
from envs.events.ramps import can_look, look_at
from tests.support.looks import HEIGHT, WIDTH, Looker


def images(rng, count):
    return np.exp(rng.normal(-1.0, 0.5, (count, HEIGHT, WIDTH)).cumsum(axis=0) * 0.5).astype(np.float32)


def counts(events):
    table = np.zeros((2, HEIGHT, WIDTH), int)
    np.add.at(table, ((events["p"] > 0).astype(int), events["y"], events["x"]), 1)
    return table


@pytest.mark.parametrize("response", ["log", "lin_log"])
@pytest.mark.parametrize("excess", ["drop", "carry"])
@pytest.mark.parametrize("mismatch", [0.0, 0.1])
def test_looks_at_whole_images_fire_the_pixels_that_frames_fire(response, excess, mismatch):
    fields = {
        "response": response,
        "excess": excess,
        "threshold_mismatch": mismatch,
        "contrast_threshold": 0.07,
        "max_events_per_pixel": 5,
    }
    frames = images(np.random.default_rng(0), 12)
    looker = Looker(frames[0], **fields)
    camera = EventCamera(looker.config)
    camera.reset(frames[0], 0)
    for k, frame in enumerate(frames[1:], 1):
        events, lost = looker.look((frame, 0, WIDTH, 1000 * k))
        expected = camera.step(frame, 1000 * k)
        assert expected.size > 100
        assert np.array_equal(counts(events), counts(expected))
        assert lost == camera.dropped
    for mine, theirs in zip(looker.camera.state[1][:2], camera.state[1][:2], strict=True):
        by_columns = theirs.reshape(-1, HEIGHT, WIDTH).swapaxes(1, 2)
        assert mine.tobytes() == by_columns.tobytes()
    assert looker.camera.last_frame.tobytes() == frames[-1].tobytes()


def test_a_crossing_comes_when_the_light_reaches_its_level():
    """Light that rises evenly from 0.1 to 0.9: crossing k is at floor + L(t) = (floor + 0.1) exp(k C)."""
    floor, step = 1e-3, 0.2
    first, last = np.full((HEIGHT, WIDTH), 0.1, np.float32), np.full((HEIGHT, WIDTH), 0.9, np.float32)
    events, _ = Looker(first, contrast_threshold=step, luminance_floor=floor).look((last, 0, WIDTH, 100_000))
    k = np.arange(1, 11)
    times = ((0.1 + floor) * np.exp(k * step) - floor - 0.1) / 0.8 * 100_000
    assert times[-1] < 100_000 < ((0.1 + floor) * np.exp(11 * step) - floor - 0.1) / 0.8 * 100_000
    assert np.abs(events["t"][:: WIDTH * HEIGHT] - times).max() <= 0.51
    assert events.size == 10 * WIDTH * HEIGHT
    assert (events["p"] == 1).all()


def test_light_that_falls_takes_the_same_way_back():
    first, last = np.full((HEIGHT, WIDTH), 0.1, np.float32), np.full((HEIGHT, WIDTH), 0.9, np.float32)
    up, _ = Looker(first, contrast_threshold=0.2).look((last, 0, WIDTH, 100_000))
    looker = Looker(last, contrast_threshold=0.2)
    down, _ = looker.look((first, 0, WIDTH, 100_000))
    assert (down["p"] == -1).all()
    assert down.size == up.size
    levels = np.log(0.901) - 0.2 * np.arange(1, 11)
    times = (0.901 - np.exp(levels)) / 0.8 * 100_000
    assert np.abs(down["t"][:: WIDTH * HEIGHT] - times).max() <= 0.51


def test_a_look_half_way_on_a_straight_line_changes_no_event():
    rng = np.random.default_rng(1)
    first, last = images(rng, 2)
    middle = (0.5 * (first.astype(float) + last)).astype(np.float32)
    once, _ = Looker(first).look((last, 0, WIDTH, 10_000))
    twice, _ = Looker(first).look((middle, 3, 9, 5000), (last, 0, WIDTH, 10_000))
    assert once.size == twice.size > 100
    key = ("y", "x", "t")
    for name in ("x", "y", "p"):
        assert np.array_equal(np.sort(once, order=key)[name], np.sort(twice, order=key)[name])
    assert np.abs(np.sort(once, order=key)["t"] - np.sort(twice, order=key)["t"]).max() <= 1


def test_events_are_in_the_order_of_time_and_place_whatever_the_looks():
    frames = images(np.random.default_rng(2), 6)
    looker = Looker(frames[0], contrast_threshold=0.05)
    looks = [(frames[k], 3 * (5 - k), 3 * (5 - k) + 3, k) for k in range(1, 5)]
    events, _ = looker.look(*looks, (frames[5], 0, WIDTH, 6))
    assert np.unique(events["t"]).size < 7 < events.size
    assert np.array_equal(np.argsort(events, order=("t", "y", "x"), kind="stable"), np.arange(events.size))


def test_a_value_that_is_no_luminance_is_named_and_changes_nothing():
    first, last = images(np.random.default_rng(3), 2)
    last[5, 7] = np.nan
    looker = Looker(first)
    before = [part.copy() for part in looker.camera.state[1]]
    bad, kept, _ = look_at(np.ascontiguousarray(last.T), 6, 9, 10, looker.watch, 0)
    assert (bad, kept) == (7 * HEIGHT + 5, 0)
    assert all(np.array_equal(part, kept) for part, kept in zip(looker.camera.state[1], before, strict=True))


@pytest.mark.parametrize(
    "fields",
    [{"memory": "frame"}, {"refractory_us": 1}, {"encoding": "gamma8"}, {"width": 4096, "height": 4096}],
)
def test_cameras_that_need_whole_images(fields):
    assert can_look(CameraConfig())
    assert not can_look(CameraConfig(**fields))


def test_an_empty_look_has_no_events():
    first = images(np.random.default_rng(4), 1)[0]
    events, lost = Looker(first).look((first, 0, WIDTH, 10))
    assert events.dtype == EVENT
    assert (events.size, lost) == (0, 0)
