import numpy as np
import pytest

from envs.config import CameraConfig
from envs.events import EventCamera
from envs.events.ramps import can_look, look_at
from tests.support.looks import HEIGHT, WIDTH, Looker


def images(rng, count):
    return np.exp(rng.normal(-1.0, 0.5, (count, HEIGHT, WIDTH)).cumsum(axis=0) * 0.5).astype(np.float32)


def counts(events):
    table = np.zeros((2, HEIGHT, WIDTH), int)
    np.add.at(table, ((events["p"] > 0).astype(int), events["y"], events["x"]), 1)
    return table


@pytest.mark.parametrize(
    ("response", "excess", "mismatch"),
    [("log", "drop", 0.0), ("log", "carry", 0.1), ("lin_log", "carry", 0.0)],
)
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
    """Light that rises evenly from 0.1 to 0.9, and back: k is at floor + L(t) = (floor + L(0)) exp(+-k C)."""
    floor, step = 1e-3, 0.2
    k = np.arange(1, 11)
    for start, end, sign in ((0.1, 0.9, 1), (0.9, 0.1, -1)):
        first, last = (np.full((HEIGHT, WIDTH), light, np.float32) for light in (start, end))
        looker = Looker(first, contrast_threshold=step, luminance_floor=floor)
        events, _ = looker.look((last, 0, WIDTH, 100_000))
        times = ((start + floor) * np.exp(sign * k * step) - floor - start) / (end - start) * 100_000
        assert np.abs(events["t"][:: WIDTH * HEIGHT] - times).max() <= 0.51
        assert events.size == 10 * WIDTH * HEIGHT
        assert (events["p"] == sign).all()


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


@pytest.mark.parametrize("cutoff_hz", [0.0, 50.0])
def test_a_value_that_is_no_luminance_is_named_and_changes_nothing(cutoff_hz):
    first, last = images(np.random.default_rng(3), 2)
    looker, other = (Looker(first, cutoff_hz=cutoff_hz) for _ in range(2))
    for value in (np.nan, -1.0, np.inf):
        bad = last.copy()
        bad[5, 7] = value
        found = look_at(np.ascontiguousarray(bad.T), 6, 9, 10, looker.watch, 0)
        assert found == (7 * HEIGHT + 5, 0, 0)
    after = [some.look((last, 0, WIDTH, 4000))[0].tobytes() for some in (looker, other)]
    assert after[0] == after[1] != b""


@pytest.mark.parametrize(
    "fields",
    [{"memory": "frame"}, {"refractory_us": 1}, {"encoding": "gamma8"}, {"width": 4096, "height": 4096}],
)
def test_cameras_that_need_whole_images(fields):
    assert can_look(CameraConfig())
    assert not can_look(CameraConfig(**fields))
