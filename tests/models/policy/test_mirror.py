import numpy as np
import pytest
from hypothesis import given, strategies

from envs.events import event_image, pack_window, unpack_window
from models.kinds import KINDS, ColumnsModel, FixedModel, PolicySpec
from models.policy.features import feature_of
from models.policy.mirror import mirror
from tests.support.encoders import WINDOW_US, make_events

WIDTH, HEIGHT = 6, 4
SIZES = (WIDTH, HEIGHT, 3)
COLUMNS = PolicySpec(ColumnsModel("event_columns", 3, [8]), *SIZES)
BANDS = PolicySpec(ColumnsModel("event_columns", 3, [8], bands=[0, 1, 3]), *SIZES)

batches = strategies.tuples(strategies.integers(0, 2**32 - 1), strategies.lists(strategies.integers(0, 60)))


@given(batches, strategies.booleans())
def test_mirrored_windows_hold_the_events_of_the_mirrored_picture(batch, padded):
    seed, counts = batch
    told = [make_events(n, seed + k, width=WIDTH, height=HEIGHT) for k, n in enumerate(counts)]
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
        np.testing.assert_array_equal(
            event_image(found, WIDTH, HEIGHT), event_image(events, WIDTH, HEIGHT)[:, ::-1]
        )
        for name in "typ":
            np.testing.assert_array_equal(found[name], events[name])
    for window, twice in zip(windows, mirror(mirrored, COLUMNS), strict=True):
        np.testing.assert_array_equal(window, twice)


@pytest.mark.parametrize("spec", [COLUMNS, BANDS], ids=["columns", "bands"])
def test_the_features_of_a_mirrored_window_are_mirrored(spec):
    window = pack_window(make_events(40, width=WIDTH, height=HEIGHT), 0, WINDOW_US, 40)[None]
    feature = feature_of(spec).from_observations
    one, other = (feature(shown, spec, None).reshape(-1, WIDTH) for shown in (window, mirror(window, spec)))
    assert not np.array_equal(one, other)
    np.testing.assert_array_equal(one[:, ::-1], other)


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
