import itertools
from typing import get_args

import numpy as np
import pytest
from hypothesis import given, strategies

from core.places import resolve
from envs.config import CameraConfig, EnvConfig, Observation
from envs.corridor import CorridorEnv
from envs.events import EVENT, event_image, pack_window
from models.kinds import KINDS, ColumnsModel, FixedModel, PolicySpec, RecurrentModel, read_model
from models.policy import Policy
from models.policy.features import Feature, Step, feature_of, grey_picture, push_features
from models.policy.networks import Network, build_networks

WIDTH, HEIGHT, WINDOW_US = 6, 4, 5000
SIZES = (WIDTH, HEIGHT, 3)
OWN = {ColumnsModel: {"hidden": [8]}, RecurrentModel: {"units": 8}}  # settings beside name and stack
COLUMNS = PolicySpec(ColumnsModel("event_columns", 3, [8]), *SIZES)
PICTURE = PolicySpec(FixedModel("event_image", 3), *SIZES)


def make_events(rng, count):
    events = np.empty(count, EVENT)
    events["t"] = np.sort(rng.integers(1, WINDOW_US + 1, count))
    events["x"], events["y"] = rng.integers(0, WIDTH, count), rng.integers(0, HEIGHT, count)
    events["p"] = rng.choice([-1, 1], count)
    return events


def columns(events):
    """Columns of a packed window."""
    window = pack_window(events, 0, WINDOW_US, 200)
    return feature_of(COLUMNS).from_observations(window[None], COLUMNS, None)[0]


seeds = strategies.integers(0, 2**32 - 1)
counts = strategies.integers(0, 150)


@given(seeds, counts)
def test_columns_count_every_event_once_in_its_column_and_polarity(seed, count):
    events = make_events(np.random.default_rng(seed), count)
    expected = np.zeros((2, WIDTH))
    for event in events:
        expected[0 if event["p"] > 0 else 1, event["x"]] += 1
    counted = np.expm1(columns(events).astype(float))
    np.testing.assert_allclose(counted.reshape(2, WIDTH), expected, atol=1e-4)
    assert counted.sum() == pytest.approx(count, abs=1e-3)


edges = strategies.lists(strategies.integers(0, HEIGHT + 1), min_size=2, unique=True).map(sorted)


@given(seeds, counts, edges)
def test_bands_count_the_columns_of_their_rows(seed, count, bands):
    events = make_events(np.random.default_rng(seed), count)
    spec = PolicySpec(ColumnsModel("event_columns", 3, [8], bands=bands), *SIZES)
    made = feature_of(spec).from_observations(pack_window(events, 0, WINDOW_US, 200)[None], spec, None)
    assert made.shape == (1, *feature_of(spec).shape(spec))
    for band, (begin, end) in enumerate(itertools.pairwise(bands)):
        inside = events[(events["y"] >= begin) & (events["y"] < end)]
        own = made[0].reshape(2, len(bands) - 1, WIDTH)[:, band]
        np.testing.assert_array_equal(own.ravel(), columns(inside))


@pytest.mark.parametrize("bands", [[3], [3, 3], [4, 2], [-1, 3]])
def test_bands_that_do_not_rise_are_refused(bands):
    with pytest.raises(ValueError, match="bands"):
        read_model(name="event_columns", stack=3, hidden=[8], bands=bands)


@given(seeds, counts)
def test_columns_do_not_know_the_order_nor_the_row_of_events(seed, count):
    rng = np.random.default_rng(seed)
    events = make_events(rng, count)
    mixed = events.copy()
    for column in range(WIDTH):
        rows = np.flatnonzero(events["x"] == column)
        for name in "yp":
            mixed[name][rows] = rng.permutation(events[name][rows])
    mixed["y"] = rng.integers(0, HEIGHT, count)
    np.testing.assert_array_equal(columns(mixed), columns(events))


def test_an_event_moved_to_another_column_or_polarity_changes_the_columns():
    events = make_events(np.random.default_rng(0), 30)
    for name, value in (("x", (events["x"][3] + 1) % WIDTH), ("p", -events["p"][3])):
        moved = events.copy()
        moved[name][3] = value
        assert np.count_nonzero(columns(moved) != columns(events)) == 2


@given(seeds, counts)
def test_the_events_of_a_step_give_what_their_window_and_their_image_give(seed, count):
    events = make_events(np.random.default_rng(seed), count)
    later = events.copy()
    later["t"] += 70_000
    for spec, expected in ((COLUMNS, columns(events)), (PICTURE, event_image(events, WIDTH, HEIGHT))):
        made = feature_of(spec).from_events(Step(later, 70_000, WINDOW_US), spec, None)
        np.testing.assert_array_equal(made, expected)
        assert made.dtype == expected.dtype


@pytest.mark.parametrize("name", ["event_columns", "event_set"])
def test_windows_of_any_lengths_give_the_features_of_each(name):
    spec = PolicySpec(KINDS[name].settings(name=name, stack=3, **OWN.get(KINDS[name].settings, {})), *SIZES)
    rng = np.random.default_rng(0)
    steps = [make_events(rng, count) for count in (5, 0, 400, 1)]
    feature = feature_of(spec)
    packed = tuple(pack_window(step, 0, WINDOW_US, max(len(step), 1))[: len(step) + 1] for step in steps)
    made = feature.from_observations(packed, spec, None)
    assert (made.dtype, made.shape) == (feature.dtype, (4, *feature.shape(spec)))
    for row, step in zip(made, steps, strict=True):
        np.testing.assert_array_equal(row, feature.from_events(Step(step, 0, WINDOW_US), spec, None))
    assert Policy(build_networks(spec), spec)(packed[:1]).shape == (1,)


def test_the_last_event_of_a_pixel_colours_it():
    events = np.zeros(3, EVENT)
    events["t"], events["x"], events["p"] = [1, 2, 3], [2, 2, 5], [1, -1, 1]
    made = feature_of(PICTURE).from_events(Step(events, 0, WINDOW_US), PICTURE, None)
    np.testing.assert_array_equal(made[0], [0, 0, 125, 0, 0, 255])
    assert not made[1:].any()


@pytest.mark.parametrize(("name", "value"), [("x", WIDTH), ("y", HEIGHT), ("p", 0)])
@pytest.mark.parametrize("spec", [COLUMNS, PICTURE], ids=["columns", "picture"])
def test_an_event_that_the_sensor_cannot_make_is_refused(spec, name, value):
    events = make_events(np.random.default_rng(1), 5)
    events[name][2] = value
    with pytest.raises(ValueError, match="event 2 has"):
        feature_of(spec).from_events(Step(events, 0, WINDOW_US), spec, None)


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


@pytest.mark.parametrize("dtype", [np.float32, np.uint8, np.int16])
@pytest.mark.parametrize("shape", [(2,), (4, 5)])
def test_the_first_feature_fills_the_stack_and_later_ones_push_out_the_oldest(dtype, shape):
    values = np.random.default_rng(0).integers(0, 100, (6, 2, *shape)).astype(dtype)
    stacks = np.zeros((2, 3, *shape), dtype)
    firsts = np.array([[True, True], *[[False, False]] * 3, [False, True], [False, False]])
    for step, (features, first) in enumerate(zip(values, firsts, strict=True)):
        before = stacks.copy()
        pushed = push_features(stacks, features, first)
        np.testing.assert_array_equal(stacks, before)
        stacks = pushed
        for flight, start in ((0, 0), (1, 0 if step < 4 else 4)):
            expected = [values[max(start, step - back), flight] for back in (2, 1, 0)]
            np.testing.assert_array_equal(stacks[flight], expected)
    assert stacks.dtype == dtype


@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if not kind.encoder])
def test_each_kind_takes_what_the_environment_shows_it(name):
    env = CorridorEnv(EnvConfig(observation=KINDS[name].observation, camera=CameraConfig(40, 48)))
    spec = PolicySpec(
        KINDS[name].settings(name=name, stack=3, **OWN.get(KINDS[name].settings, {})), 40, 48, 3
    )
    policy = Policy(build_networks(spec), spec)
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        action = policy(observation[None])
        observation, *_ = env.step(int(action[0]))
    made = feature_of(spec).from_observations(observation[None], spec, None)
    assert (made.dtype, made.shape[1:]) == (feature_of(spec).dtype, feature_of(spec).shape(spec))
    assert made.any()


def test_the_table_of_kinds_names_what_there_is():
    for kind in KINDS.values():
        assert isinstance(resolve(kind.feature), Feature)
        assert isinstance(resolve(kind.network), Network)
        assert kind.onnx is None or callable(resolve(kind.onnx))
        assert kind.observation in get_args(Observation)
        EnvConfig(observation=kind.observation)
