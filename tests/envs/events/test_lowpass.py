"""The bandwidth of the photoreceptors: what a first-order filter does to a ramp, a step and a sine."""

import dataclasses
import math

import numpy as np
import pytest

from envs.config import CameraConfig, EnvConfig, FidelityConfig, sensor_settings
from envs.corridor import CorridorEnv
from envs.event_error import event_error
from envs.events import EventCamera
from envs.events.photoreceptor import Curve, exponential, light_of, respond
from envs.events.ramps import can_look
from tests.support.looks import HEIGHT, WIDTH, Looker

FLOOR = 1e-9


def frame(value, shape=(1, 1)):
    return np.full(shape, value, np.float32)


def shown(values, times_us, **fields):
    """A camera of one pixel that was shown these values, and its events."""
    own = {"luminance_floor": FLOOR, "max_events_per_pixel": 10_000, "cutoff_grows_with_light": False}
    camera = EventCamera(1, 1, **own | fields)
    camera.reset(frame(values[0]), 0)
    parts = [camera.step(frame(value), t) for value, t in zip(values[1:], times_us, strict=True)]
    return camera, np.concatenate(parts)


def filtered(camera):
    return float(camera._low_pass.filtered[0])


def events_of_flights(config):
    """Events of a few corridors, one after the other in time, at most 12 steps of each."""
    env, parts = CorridorEnv(config), []
    for seed in range(3):
        env.reset(seed=seed)
        for step in range(12):
            over = any(env.step(step % 3)[2:4])
            events = env.events.copy()
            events["t"] += seed * 10_000_000
            parts.append(events)
            if over:
                break
    return np.concatenate(parts)


@pytest.mark.parametrize("cutoff_hz", [10.0, 300.0])
def test_a_ramp_arrives_late_by_the_time_constant(cutoff_hz):
    tau_us = 1e6 / (2 * math.pi * cutoff_hz)
    end_us = int(40 * tau_us)
    times = np.linspace(0, end_us, 401).round().astype(int)[1:]
    slope = 8.0 / end_us
    camera, events = shown(np.exp(-8.0 + slope * np.append(0, times)), times, cutoff_hz=cutoff_hz)
    late = events["t"] - 0.2 * np.arange(1, len(events) + 1) / slope
    settled = events["t"] > 12 * tau_us
    assert settled.sum() > 20
    assert np.abs(late[settled] - tau_us).max() < 0.01 * tau_us + 2
    assert filtered(camera) == pytest.approx(slope * (end_us - tau_us) - 8.0, abs=1e-4)


def test_a_step_is_followed_exponentially():
    tau_us = 1e6 / (2 * math.pi * 30.0)
    for share in (0.1, 1.0, 3.0):
        camera, _ = shown([1.0, math.e, math.e], [1, 1 + round(share * tau_us)], cutoff_hz=30.0)
        assert filtered(camera) == pytest.approx(1 - math.exp(-share), abs=2e-4)


@pytest.mark.parametrize("grows", [False, True])
def test_frames_on_a_line_between_two_others_change_nothing(grows):
    results = []
    for parts in (1, 100):
        times = 7000 * np.arange(1, parts + 1) // parts
        values = [0.5, *(0.5 * np.exp(0.02 * times / 7000))]
        camera, _ = shown(values, times, cutoff_hz=30.0, cutoff_grows_with_light=grows, luminance_floor=1e-9)
        results.append(filtered(camera))
    assert np.ptp(results) < (2e-5 if grows else 2e-7)  # the light of an interval is its mean


def test_in_the_dark_a_photoreceptor_is_slower_as_v2e_has_it():
    for light, share in ((0.0, 20 / 275), (0.5, 147.5 / 275), (1.0, 1.0)):
        fields = {"cutoff_hz": 30.0, "cutoff_grows_with_light": True, "luminance_floor": 1.0}
        camera, _ = shown([light, light + 1e-3, light + 1e-3], [1, 2001], **fields)
        before, after = math.log(light + 1.0), math.log(light + 1e-3 + 1.0)
        left = (after - filtered(camera)) / (after - before)
        assert left == pytest.approx(math.exp(-2e-3 * 2 * math.pi * 30.0 * share), abs=2e-3)


def test_without_a_cutoff_nothing_is_filtered_and_a_wide_band_fires_the_same():
    values = np.exp(np.cumsum(np.random.default_rng(0).normal(0, 0.4, 200)))
    times = 1000 * np.arange(1, 200)
    camera, events = shown(values, times)
    assert camera._low_pass is None
    _, wide = shown(values, times, cutoff_hz=1e6)
    assert abs(len(wide) - len(events)) <= 2
    assert np.abs(np.cumsum(events["p"])[-1] - np.cumsum(wide["p"])[-1]) <= 1


def test_by_columns_resting_light_is_followed_as_in_whole_images_whenever_one_looks():
    first, last = np.random.default_rng(0).uniform(0.05, 0.9, (2, HEIGHT, WIDTH)).astype(np.float32)
    camera, looker = EventCamera(WIDTH, HEIGHT, cutoff_hz=30.0), Looker(first, cutoff_hz=30.0)
    camera.reset(first, 0)
    camera.step(last, 1)
    camera.step(last, 9000)
    looker.look((last, 0, WIDTH, 1))
    looker.look((last, 3, 9, 200), (last, 8, 9, 300), (last, 0, WIDTH, 9000))
    seen = looker.camera.bandwidth.pixels
    assert np.abs(seen.filtered.reshape(WIDTH, HEIGHT).T.ravel() - camera._low_pass.filtered).max() < 1e-4
    assert looker.camera.last_frame.tobytes() == last.tobytes()


def followed_by_numpy(state, image, seconds, curve, rates):
    """What all pixels have behind the filter, what they respond and see, `seconds` after half-way twice."""
    filtered, before, past = state
    room = np.empty(past.size, np.int64)
    for light in (np.float32(0.5) * past + np.float32(0.5) * image, image):
        after = np.empty(past.size)
        respond(curve, light, after, room)
        periods = rates[0] * seconds + rates[1] * seconds * (
            0.5 * past.astype(float) + 0.5 * light.astype(float)
        )
        decay, lag = -periods, (after - before) / periods
        exponential(decay, room)
        filtered = after - lag + (filtered - before + lag) * decay
        before, past = after, light
    lights = filtered.copy()
    light_of(curve, lights, room)
    return (filtered, before, past), np.maximum(lights, 0.0).astype(np.float32)


@pytest.mark.parametrize("fields", [{}, {"response": "lin_log", "luminance_floor": 0.3}])
def test_by_columns_every_pixel_has_the_bits_that_the_equation_gives_it_also_those_left_alone(fields):
    rng = np.random.default_rng(0)
    image = rng.uniform(0.05, 0.9, (HEIGHT, WIDTH)).astype(np.float32)
    looker = Looker(image, cutoff_hz=300.0, **fields)
    filter_, curve = looker.camera.bandwidth, Curve(*looker.camera.state[0][1])
    state = tuple(part.copy() for part in filter_.pixels)
    settled = []
    for look in range(30):
        changed = rng.random(image.shape) < (0.2 if look < 5 else 0.01)
        image = np.where(changed, rng.uniform(0.05, 0.9, image.shape), image).astype(np.float32)
        looker.look((image, 0, WIDTH, 5000 * (look + 1)))
        state, seen = followed_by_numpy(state, image.T.ravel(), 2.5e-3, curve, filter_.rates)
        assert [part.tobytes() for part in filter_.pixels] == [part.tobytes() for part in state]
        assert filter_.seen.tobytes() == seen.tobytes()
        settled.append((state[0] == state[1]).mean())
    assert max(settled) > 0.5  # some are left alone
    assert min(settled) < 0.9


@pytest.mark.parametrize("grows", [False, True])
def test_by_columns_light_that_is_linear_in_time_is_followed_within_hundredths(grows):
    """The same equation in 2,000 steps; a response that is linear instead is off by three times as much."""
    fields = {"cutoff_hz": 100.0, "cutoff_grows_with_light": grows, "contrast_threshold": 0.05}
    first, last = np.full((HEIGHT, WIDTH), 0.2, np.float32), np.full((HEIGHT, WIDTH), 0.8, np.float32)
    looker, camera, once = Looker(first, **fields), EventCamera(1, 1, **fields), EventCamera(1, 1, **fields)
    looker.look((last, 0, WIDTH, 2000))
    for some in (camera, once):
        some.reset(frame(0.2), 0)
    for t in range(1, 2001):
        camera.step(frame(0.2 + 0.6 * t / 2000), t)
    once.step(frame(0.8), 2000)
    found = looker.camera.bandwidth.pixels.filtered
    assert np.ptp(found) == 0.0
    assert found[0] == pytest.approx(filtered(camera), abs=0.03)
    assert abs(filtered(once) - filtered(camera)) > 3 * abs(found[0] - filtered(camera))


def test_by_columns_events_after_a_step_come_when_the_exponential_crosses_their_levels():
    first, last = np.full((HEIGHT, WIDTH), 0.1, np.float32), np.full((HEIGHT, WIDTH), 0.8, np.float32)
    fields = {"cutoff_hz": 30.0, "cutoff_grows_with_light": False, "luminance_floor": 1e-9}
    tau_us, change = 1e6 / (2 * math.pi * 30.0), math.log(8.0)
    for images in ((first, last), (last, first)):
        events, _ = Looker(images[0], **fields).look((images[1], 0, WIDTH, 1), (images[1], 0, WIDTH, 9_001))
        count = int(change * (1 - math.exp(-9_000 / tau_us)) / 0.2)
        expected = -tau_us * np.log(1 - 0.2 * np.arange(1, count + 1) / change)
        assert len(events) == count * WIDTH * HEIGHT > 5 * WIDTH * HEIGHT
        assert np.abs(events["t"][:: WIDTH * HEIGHT] - expected).max() < 3


@pytest.mark.parametrize(
    "fields",
    [{}, {"response": "lin_log", "excess": "carry"}, {"threshold_mismatch": 0.05}, {"cutoff_hz": 900.0}],
)
def test_by_columns_light_that_comes_and_goes_fires_in_order_in_its_span_and_as_in_fine_steps(fields):
    """In the end a pixel is as many levels away as in steps of 20 us, or one more or less."""
    fields = {"cutoff_hz": 60.0, "contrast_threshold": 0.1} | fields
    rng = np.random.default_rng(3)
    frames = rng.uniform(0.3, 0.9, (20, HEIGHT, WIDTH)).astype(np.float32)
    looker, camera = Looker(frames[0], **fields), EventCamera(WIDTH, HEIGHT, **fields)
    camera.reset(frames[0], 0)
    ours, fine, now = [], [], 0
    for before, after, wait in zip(frames, frames[1:], [1, 2, 3, 1001] + 15 * [2000], strict=False):
        found, _ = looker.look((after, 0, WIDTH, now + wait))
        assert np.array_equal(np.argsort(found, order=("t", "y", "x"), kind="stable"), np.arange(found.size))
        assert found.size == 0 or now < found["t"][0] <= found["t"][-1] <= now + wait
        ours.append(found)
        for t in range(min(20, wait), wait + 1, 20):
            share = np.float32(t / wait)
            fine.append(camera.step((1 - share) * before + share * after, now + t))
        fine.append(camera.step(after, now + wait) if camera.t_us < now + wait else fine[-1][:0])
        now += wait
    sums = [np.zeros((HEIGHT, WIDTH)) for _ in range(2)]
    for total, parts in zip(sums, (ours, fine), strict=True):
        events = np.concatenate(parts)
        np.add.at(total, (events["y"], events["x"]), events["p"])
    assert np.abs(sums[0] - sums[1]).max() <= 1
    assert np.abs(sums[0] - sums[1]).mean() < 0.2
    assert sum(map(len, ours)) > 1000


def test_by_columns_what_falls_and_then_rises_fires_while_it_rises_and_the_other_way_round():
    fields = {"cutoff_hz": 100.0, "cutoff_grows_with_light": False, "contrast_threshold": 0.1}
    for lights, half in (((0.45, 0.1, 0.9), slice(2001, 4001)), ((0.2, 0.9, 0.1), slice(1, 2000))):
        first, second, third = (np.full((HEIGHT, WIDTH), light, np.float32) for light in lights)
        looker = Looker(first, **fields)
        assert looker.look((second, 0, WIDTH, 1))[0].size == 0
        events, _ = looker.look((third, 0, WIDTH, 4001))
        assert events.size > 0
        assert half.start < events["t"][0] <= events["t"][-1] <= half.stop
        assert (events["p"] == 1).all()


@pytest.mark.parametrize("cutoff_hz", [1e-300, 1e-3, 1e6])
def test_by_columns_the_slowest_photoreceptor_sees_nothing_and_the_fastest_all(cutoff_hz):
    first, last = np.random.default_rng(5).uniform(0.05, 0.9, (2, HEIGHT, WIDTH)).astype(np.float32)
    looker = Looker(first, cutoff_hz=cutoff_hz)
    start = looker.camera.bandwidth.pixels.filtered.copy()
    events, _ = looker.look((last, 0, WIDTH, 1), (first, 0, WIDTH, 2), (last, 0, WIDTH, 5000))
    moved = np.abs(looker.camera.bandwidth.pixels.filtered - start)
    if cutoff_hz < 1.0:
        assert moved.max() < 1e-4
        assert events.size == 0
    else:
        assert np.abs(moved - np.abs(np.log((last + 1e-3) / (first + 1e-3))).T.ravel()).max() < 1e-2
        assert events.size > 500


@pytest.mark.system
@pytest.mark.parametrize(
    ("scene", "hz", "cutoff_hz"),
    [
        ("poles", 400.0, 300.0),
        ("texture_change", 400.0, 30.0),
        ("poles_dense", 45.0, 30.0),
        ("poles", 200.0, 3000.0),
    ],
)
def test_events_behind_a_filter_are_within_the_tolerance_of_whole_images(monkeypatch, scene, hz, cutoff_hz):
    """32 whole images a step are another way to the same events, and as good as converged."""
    config = EnvConfig(scene=scene, control_hz=hz, camera=CameraConfig(cutoff_hz=cutoff_hz))
    ours = events_of_flights(config)
    fidelity = FidelityConfig(max_step_m=config.speed_mps / hz / 32, samples=8, cull_m=1e6)
    monkeypatch.setattr("envs.fidelity.can_look", lambda camera: False)
    whole = events_of_flights(dataclasses.replace(config, fidelity=fidelity))
    assert event_error(ours, whole, 0.05e6 / hz) <= config.fidelity.tolerance
    assert ours.size > 100


def test_a_camera_with_a_cutoff_is_looked_through_by_columns_and_settings_that_are_off_leave_no_trace():
    assert can_look(CameraConfig(cutoff_hz=30.0))
    plain = sensor_settings(EnvConfig())
    assert "cutoff_hz" not in plain
    slow = sensor_settings(EnvConfig(camera=CameraConfig(cutoff_hz=30.0)))
    assert slow == plain | {"cutoff_hz": 30.0}
