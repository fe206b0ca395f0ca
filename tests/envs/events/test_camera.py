import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from envs.config import CameraConfig
from envs.events import EVENT, EventCamera
from envs.events.camera import pixel_thresholds
from envs.events.crossings import MOST_CROSSINGS, NEVER_QUIET

FLOOR = 1e-9  # small enough to leave log(luminance) alone where luminance is about 1
LUMINANCES = st.floats(0, np.finfo(np.float32).max, width=32, allow_subnormal=True)
THRESHOLDS = st.sampled_from([0.03, 0.2, 1.7])


def frame(value, shape=(1, 1)):
    return np.full(shape, value, np.float32)


def one_pixel(**fields):
    return EventCamera(1, 1, **{"luminance_floor": FLOOR, "max_events_per_pixel": 100_000} | fields)


def play(values, dt_us=1000, **fields):
    """Events of one pixel that shows `values` one after the other."""
    camera = one_pixel(**fields)
    camera.reset(frame(values[0]), 0)
    steps = [camera.step(frame(v), (i + 1) * dt_us) for i, v in enumerate(values[1:])]
    return np.concatenate([np.empty(0, EVENT), *steps])


def moving_edges(t_s, shape=(16, 24)):
    """A smooth texture that moves 20 pixels a second, float32 luminance."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    phase = (x - 20.0 * t_s) * 0.9 + 0.2 * y
    return (0.5 + 0.45 * np.sin(phase)).astype(np.float32)


def respond(luminance, response, floor=1e-3):
    """The response to float32 luminance, by numpy."""
    light = luminance.astype(np.float64)
    if response == "log":
        return np.log(light + floor)
    return np.where(light > floor, np.log(np.maximum(light, floor)), light / floor - 1.0 + np.log(floor))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_log_linear_ramp_fires_exactly_when_it_crosses_each_level(sign):
    end = np.float32(np.exp(sign * 1.05))
    events = play([1.0, end], dt_us=5000)
    slope = abs(np.log(float(end))) / 5000
    assert events["t"].tolist() == [round(k * 0.2 / slope) for k in range(1, 6)]
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


def follow(camera, frames):
    """Show frames of a millisecond each, and ask that no pixel is a whole threshold of its own behind."""
    response, shape = camera.config.response, frames[0].shape
    on, off = (np.broadcast_to(row, frames[0].size).reshape(shape) for row in pixel_thresholds(camera.config))
    camera.reset(frames[0], 0)
    level = respond(frames[0], response)
    for k, image in enumerate(frames[1:], 1):
        events = camera.step(image, 1000 * k)
        place = events["y"], events["x"]
        np.add.at(level, place, np.where(events["p"] > 0, on[place], -off[place]))
        residual = respond(image, response) - level
        assert (residual < on).all()
        assert (residual > -off).all()


@settings(max_examples=80)
@given(
    arrays(np.float32, (6, 2, 3), elements=LUMINANCES),
    THRESHOLDS,
    THRESHOLDS,
    st.sampled_from(["log", "lin_log"]),
    st.sampled_from([0.0, 0.3]),
)
def test_the_sum_of_events_stays_within_one_threshold_of_the_brightness(frames, on, off, response, mismatch):
    fields = {"response": response, "threshold_mismatch": mismatch, "max_events_per_pixel": 100_000}
    follow(EventCamera(3, 2, contrast_threshold=on, contrast_threshold_off=off, **fields), frames)


@pytest.mark.parametrize("fields", [{}, {"threshold_mismatch": 0.3, "response": "lin_log"}])
def test_so_it_does_where_light_moves_in_small_steps(fields):
    follow(EventCamera(24, 16, **fields), [moving_edges(k / 1000) for k in range(60)])


@settings(max_examples=60)
@given(arrays(np.float32, (5, 2, 3), elements=LUMINANCES), THRESHOLDS, st.sampled_from(["frame", "legacy"]))
def test_a_camera_that_forgets_fires_the_whole_thresholds_of_each_difference(frames, threshold, memory):
    """The published code loses the first of them."""
    camera = EventCamera(3, 2, contrast_threshold=threshold, memory=memory, max_events_per_pixel=100_000)
    camera.reset(frames[0], 0)
    logs = respond(frames, "log")
    for k in range(1, len(frames)):
        events = camera.step(frames[k], 1000 * k)
        count = np.zeros((2, 3), int)
        np.add.at(count, (events["y"], events["x"]), events["p"])
        change = logs[k] - logs[k - 1]
        whole = np.floor((np.abs(change) + 2.0**-23) / threshold) - (memory == "legacy")
        assert np.array_equal(count, np.sign(change) * np.maximum(whole, 0))


def test_a_still_pixel_never_fires_whatever_rounding_did_to_its_memory():
    camera = one_pixel()
    camera.reset(frame(2.0), 0)
    lights, levels, *_ = camera._memory
    lights[1] = NEVER_QUIET
    levels["first_level"] -= 0.2
    assert camera.step(frame(2.0), 1000).size == 0


@pytest.mark.parametrize("threshold", [1e-6, 0.2, 3.0])
@pytest.mark.parametrize("off", [None, 0.07])
@pytest.mark.parametrize("response", ["log", "lin_log"])
@pytest.mark.parametrize("floor", [1e-9, 0.01, 1.0])
def test_no_pixel_within_its_quiet_band_would_fire(threshold, off, response, floor):
    fields = {"luminance_floor": floor, "response": response, "max_events_per_pixel": 3}
    cameras = [
        EventCamera(48, 48, contrast_threshold=threshold, contrast_threshold_off=off, **fields)
        for _ in range(2)
    ]
    rng = np.random.default_rng(0)
    first = np.exp(rng.normal(np.log(floor), 4.0, (48, 48)))
    for camera in cameras:
        camera.reset(first.astype(np.float32), 0)
    for k in range(1, 9):
        levels = rng.choice([0.0, threshold, -(off or threshold)], (48, 48))  # as near as float32 comes
        light = (first + floor) * np.exp(levels) * (1.0 + rng.integers(-8, 9, (48, 48)) * 2.0**-25) - floor
        if response == "lin_log":
            light = np.where(first > floor, light + floor * (1.0 - np.exp(levels)), first + floor * levels)
        light = np.maximum(light, 0.0).astype(np.float32)
        cameras[1].state[1][0][1] = NEVER_QUIET  # each pixel is decided exactly
        events = [camera.step(light, 1000 * k) for camera in cameras]
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


@pytest.mark.parametrize("parts", [2, 50, 5000])
def test_a_log_linear_motion_gives_the_same_events_in_one_step_or_in_many_up_to_a_megahertz(parts):
    whole = play(np.exp([0.0, 2.1]), dt_us=5000)
    split = play(np.exp(np.linspace(0.0, 2.1, parts + 1)), dt_us=5000 // parts)
    assert len(whole) == len(split) == 10
    assert np.abs(whole["t"] - split["t"]).max() <= 1


@pytest.mark.parametrize("threshold", [0.05, 0.7])
def test_steps_of_exactly_k_thresholds_give_k_events_and_return_to_their_level(threshold):
    camera = one_pixel(contrast_threshold=threshold)
    camera.reset(frame(1.0), 0)
    for k in range(1, min(100, int(85 / threshold)) + 1):
        for t, (light, count) in enumerate(((np.exp(k * threshold), k), (1.0, -k)), 2 * k):
            events = camera.step(frame(light), t)
            assert events["p"].sum() == count
            assert len(events) == k


@pytest.mark.parametrize(("sign", "gain"), [(-1, 1.0), (1, 0.25), (1, 1e30)])
def test_inverted_light_turns_polarities_and_a_gain_changes_nothing(sign, gain):
    logs = np.cumsum(np.random.default_rng(1).normal(0, 0.5, 40))
    events = play(np.exp(logs).astype(np.float32))
    other = play(np.exp(sign * logs).astype(np.float32) * np.float32(gain))
    assert len(events) > 40
    assert np.abs(events["t"] - other["t"]).max() <= 1
    assert (events["p"] == sign * other["p"]).all()


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"memory": "frame"},
        {"memory": "legacy"},
        {"refractory_us": 3000},
        {"encoding": "gamma8"},
        {"cutoff_hz": 50.0},
    ],
)
def test_a_frame_with_a_bad_pixel_is_refused_by_name_and_changes_nothing(fields):
    camera, untouched = (EventCamera(24, 16, **fields) for _ in range(2))
    for one in (camera, untouched):
        one.reset(moving_edges(0.0), 0)
        one.step(moving_edges(0.03), 1000)
    good = moving_edges(0.1)
    for bad in (np.nan, np.inf, -np.inf, -1.0, -1e-45):
        poisoned = good.copy()
        poisoned[3, 5] = bad
        for refused in (
            lambda poisoned=poisoned: camera.step(poisoned, 8000),
            lambda poisoned=poisoned: camera.steps(np.stack([good, poisoned]), [2000, 8000]),
            lambda poisoned=poisoned: EventCamera(24, 16, **fields).reset(poisoned, 0),
        ):
            with pytest.raises(ValueError, match="pixel x=5, y=3 is"):
                refused()
    assert camera.step(good, 9000).tobytes() == untouched.step(good, 9000).tobytes() != b""
    bright = one_pixel(contrast_threshold=1.0)  # whose quiet band ends at the largest float
    bright.reset(frame(3e38), 0)
    with pytest.raises(ValueError, match="inf"):
        bright.step(frame(np.inf), 1)


@pytest.mark.parametrize("t_us", [0, -1, 1.0, None, "1", 2**52, 2**63])
def test_a_time_that_does_not_increase_or_is_no_integer_is_refused(t_us):
    camera = one_pixel()
    camera.reset(frame(1.0), 0)
    with pytest.raises(ValueError, match="t_us"):
        camera.step(frame(2.0), t_us)
    assert len(camera.step(frame(np.exp(0.5)), 1)) == 2


def test_a_frame_of_another_shape_or_dtype_and_a_step_before_reset_are_refused():
    for wrong in (np.ones((1, 1)), np.ones((2, 1), np.float32), [[1.0]], np.ones(1, np.float32)):
        with pytest.raises(ValueError, match="luminance must be float32"):
            one_pixel().reset(wrong, 0)
    with pytest.raises(ValueError, match="reset"):
        one_pixel().step(frame(1.0), 1)


def test_the_cap_drops_the_latest_events_of_each_pixel_and_counts_them():
    full = EventCamera(CameraConfig(width=4, height=4, luminance_floor=FLOOR))
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
