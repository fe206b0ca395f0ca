import itertools

import numpy as np
import pytest
from hypothesis import given, settings, strategies

from envs.config import CameraConfig, EnvConfig
from envs.corridor import CorridorEnv
from envs.events import EVENT, event_image, pack_window, unpack_window
from models.kinds import KINDS, ColumnsModel, FixedModel, PolicySpec, read_model
from models.policy import Policy
from models.policy.features import Step, feature_of, grey_picture, push_features
from models.policy.mirror import mirror
from models.policy.networks import build_networks

WIDTH, HEIGHT, WINDOW_US = 6, 4, 5000
SIZES = (WIDTH, HEIGHT, 3)
COLUMNS = PolicySpec(ColumnsModel("event_columns", 3, [8]), *SIZES)
PICTURE = PolicySpec(FixedModel("event_image", 3), *SIZES)


def make_events(seed, count):
    rng = np.random.default_rng(seed)
    events = np.empty(count, EVENT)
    events["t"] = np.sort(rng.integers(1, WINDOW_US + 1, count))
    events["x"], events["y"] = rng.integers(0, WIDTH, count), rng.integers(0, HEIGHT, count)
    events["p"] = rng.choice([-1, 1], count)
    return events


def features(spec, events):
    """The feature of a packed window."""
    window = pack_window(events, 0, WINDOW_US, 200)
    return feature_of(spec).from_observations(window[None], spec, None)[0]


streams = strategies.builds(make_events, strategies.integers(0, 2**32 - 1), strategies.integers(0, 150))
edges = strategies.lists(strategies.integers(0, HEIGHT + 1), min_size=2, unique=True).map(sorted)


@settings(max_examples=30)
@given(streams, edges)
def test_columns_count_every_event_once_in_its_column_and_polarity_and_bands_those_of_their_rows(
    events, bands
):
    for rows, given_bands in (([0, HEIGHT], []), (bands, bands)):
        expected = np.zeros((2, len(rows) - 1, WIDTH))
        for event in events:
            for band, (begin, end) in enumerate(itertools.pairwise(rows)):
                expected[0 if event["p"] > 0 else 1, band, event["x"]] += begin <= event["y"] < end
        spec = PolicySpec(ColumnsModel("event_columns", 3, [8], bands=given_bands), *SIZES)
        made = features(spec, events)
        assert made.shape == feature_of(spec).shape(spec)
        np.testing.assert_allclose(np.expm1(made.astype(float)), expected.ravel(), atol=1e-4)


@pytest.mark.parametrize("bands", [[3], [3, 3], [4, 2], [-1, 3]])
def test_bands_that_do_not_rise_are_refused(bands):
    with pytest.raises(ValueError, match="bands"):
        read_model(name="event_columns", stack=3, hidden=[8], bands=bands)


@settings(max_examples=30)
@given(streams)
def test_the_events_of_a_step_give_what_their_window_and_their_image_give(events):
    later = events.copy()
    later["t"] += 70_000
    for spec, expected in (
        (COLUMNS, features(COLUMNS, events)),
        (PICTURE, event_image(events, WIDTH, HEIGHT)),
    ):
        made = feature_of(spec).from_events(Step(later, 70_000, WINDOW_US), spec, None)
        np.testing.assert_array_equal(made, expected)
        assert made.dtype == expected.dtype


def test_grey_is_what_a_display_decodes_to_the_luminance_again():
    luminance = np.linspace(0.0, 1.0, 1001, dtype=np.float32)
    grey = grey_picture(luminance)
    assert grey.dtype == np.uint8
    assert (grey[0], grey[-1]) == (0, 255)
    assert (np.diff(grey.astype(int)) >= 0).all()
    np.testing.assert_allclose((grey / 255) ** 2.2, luminance, atol=2.2 * 0.5 / 255 + 1e-6)
    np.testing.assert_array_equal(grey_picture(np.float32([1.5, 40.0])), [255, 255])
    with pytest.raises(ValueError, match="luminance must be finite"):
        grey_picture(np.float32([0.5, np.nan]))


@pytest.mark.parametrize("name", ["event_image", "rgb"])
def test_pictures_of_another_sensor_or_type_are_refused(name):
    spec = PolicySpec(FixedModel(name, 3), *SIZES)
    for bad in (np.zeros((1, HEIGHT, WIDTH + 1), np.uint8), np.zeros((1, HEIGHT, WIDTH), np.int64)):
        with pytest.raises(ValueError, match=r"must be (uint8|float32) \(B, 4, 6, 1\), or .* got"):
            feature_of(spec).from_observations(bad, spec, None)


@pytest.mark.parametrize(("dtype", "shape"), [(np.float32, (2,)), (np.uint8, (4, 5))])
def test_the_first_feature_fills_the_stack_and_later_ones_push_out_the_oldest(dtype, shape):
    values = np.random.default_rng(0).integers(0, 100, (6, 2, *shape)).astype(dtype)
    stacks = np.zeros((2, 3, *shape), dtype)
    firsts = np.array([[True, True], *[[False, False]] * 3, [False, True], [False, False]])
    for step, (newest, first) in enumerate(zip(values, firsts, strict=True)):
        before = stacks.copy()
        pushed = push_features(stacks, newest, first)
        np.testing.assert_array_equal(stacks, before)
        stacks = pushed
        for flight, start in ((0, 0), (1, 0 if step < 4 else 4)):
            expected = [values[max(start, step - back), flight] for back in (2, 1, 0)]
            np.testing.assert_array_equal(stacks[flight], expected)
    assert stacks.dtype == dtype


@pytest.mark.parametrize("name", ["event_image", "rgb"])
def test_each_kind_takes_what_the_environment_shows_it(name):
    env = CorridorEnv(EnvConfig(observation=KINDS[name].observation, camera=CameraConfig(40, 48)))
    spec = PolicySpec(FixedModel(name, 3), 40, 48, 3)
    policy = Policy(build_networks(spec), spec)
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        action = policy(observation[None])
        observation, *_ = env.step(int(action[0]))
    made = feature_of(spec).from_observations(observation[None], spec, None)
    assert (made.dtype, made.shape[1:]) == (feature_of(spec).dtype, feature_of(spec).shape(spec))
    assert made.any()


batches = strategies.tuples(strategies.integers(0, 2**32 - 1), strategies.lists(strategies.integers(0, 60)))


@settings(max_examples=30)
@given(batches, strategies.booleans())
def test_mirrored_windows_hold_the_same_events_in_the_mirrored_columns(batch, padded):
    seed, counts = batch
    told = [make_events(seed + k, n) for k, n in enumerate(counts)]
    windows = [pack_window(events, 0, WINDOW_US, 60 if padded else max(1, len(events))) for events in told]
    if padded and windows:
        windows = np.stack(windows)
    before = [window.copy() for window in windows]
    mirrored = mirror(windows, COLUMNS)
    assert isinstance(mirrored, np.ndarray) == isinstance(windows, np.ndarray)
    for window, kept, other, events in zip(windows, before, mirrored, told, strict=True):
        np.testing.assert_array_equal(window, kept)
        found, window_us = unpack_window(other)
        assert window_us == WINDOW_US
        np.testing.assert_array_equal(found["x"], WIDTH - 1 - events["x"])
        for name in "typ":
            np.testing.assert_array_equal(found[name], events[name])


@pytest.mark.parametrize(("name", "dtype"), [("event_image", np.uint8), ("rgb", np.float32)])
def test_pictures_are_turned_about_their_middle_column(name, dtype):
    pictures = np.arange(48).reshape(2, HEIGHT, WIDTH).astype(dtype)
    mirrored = mirror(pictures, PolicySpec(FixedModel(name, 3), *SIZES))
    assert mirrored.dtype == dtype
    for x in range(WIDTH):
        np.testing.assert_array_equal(mirrored[:, :, x], pictures[:, :, WIDTH - 1 - x])


def test_an_observation_without_a_known_mirror_image_is_refused(monkeypatch):
    monkeypatch.setitem(KINDS, "rgb", KINDS["rgb"]._replace(observation="none"))
    with pytest.raises(ValueError, match="'none'"):
        mirror(np.zeros((1, 2)), PolicySpec(FixedModel("rgb", 3), *SIZES))
