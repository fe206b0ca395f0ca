from typing import get_args

import numpy as np
import pytest
import torch

from models.encoder.evae import SECTORS, event_targets, pictures, reconstruct, target_shape
from models.encoder.event_batch import EventBatch, batch_windows
from models.kinds import Target
from tests.support.encoders import bars, events, small


def test_the_signed_target_is_the_polarity_of_the_pixels_last_event():
    evae = small()
    window = events((1, 2, 0, 1), (2, 2, 0, -1), (3, 4, 1, 1), (3, 5, 1, -1), (4, 5, 1, 1))
    picture = event_targets(batch_windows([(window, 0, 5)], evae.grid), "signed").reshape(10, 12)
    assert (picture[0, 2], picture[1, 4], picture[1, 5]) == (-1, 1, 1)
    assert picture.abs().sum() == 3


def test_the_occupancy_target_is_one_where_anything_happened():
    evae = small()
    batch = batch_windows([(events((1, 2, 0, 1), (2, 2, 0, -1)), 0, 5), (events(), 0, 5)], evae.grid)
    picture = event_targets(batch, "occupancy")
    assert picture.sum(1).tolist() == [1, 0]
    assert picture[0, 2] == 1


def test_the_aged_target_is_the_time_of_the_pixels_newest_event():
    evae = small()
    window = events((100, 3, 1, 1), (1, 2, 0, 1), (5000, 2, 0, -1), (2500, 2, 0, 1))  # in any order
    picture = event_targets(batch_windows([(window, 0, 5000), (events(), 0, 5000)], evae.grid), "aged")
    first = picture[0].reshape(10, 12)
    assert first[0, 2] == pytest.approx(31.5 / 32)
    assert first[1, 3] == pytest.approx(0.5 / 32)
    assert (picture > 0).sum(1).tolist() == [2, 0]
    assert picture.max() < 1


def test_the_counts_target_counts_every_event_of_a_cell_once():
    evae, rng = small(), np.random.default_rng(0)
    batch = bars(evae, 5, rng)
    counts = 2.0 ** (12 * event_targets(batch, "counts").double().reshape(5, 2, 8, 8)) - 1
    assert torch.allclose(counts.sum((1, 2, 3)), torch.from_numpy(np.diff(batch.offsets)).double(), atol=1e-3)
    window = events((1, 11, 0, 1), (2, 11, 0, 1), (3, 10, 1, 1), (4, 0, 9, -1))
    picture = event_targets(batch_windows([(window, 0, 5)], evae.grid), "counts").reshape(2, 8, 8)
    expected = torch.zeros(2, 8, 8)
    expected[1, 0, 7], expected[1, 0, 6], expected[0, 7, 0] = np.log2(3) / 12, 1 / 12, 1 / 12
    assert torch.allclose(picture, expected)


@pytest.mark.parametrize("target", get_args(Target))
def test_every_target_has_its_shape_its_decoder_and_a_picture_of_the_sensors_size(target):
    evae = small(target=target)
    batch = bars(evae, 3, np.random.default_rng(0))
    logits = evae(batch)[0]
    given = target == "proximity"  # of the scene, not of events
    targets = torch.rand(3, SECTORS) if given else event_targets(batch, target)
    assert targets.dtype == torch.float32
    assert targets.shape == logits.shape == (3, np.prod(target_shape(target, evae.grid)))
    for values in (targets, reconstruct(logits, target)):
        shown = pictures(values, target, evae.grid)
        assert shown.shape == (3, 10, 12)
        assert shown.abs().max() <= 1


def test_a_picture_of_counts_shows_the_polarity_that_prevails_in_each_cell():
    grid = small().grid
    window = events((1, 11, 0, 1), (2, 11, 0, 1), (3, 11, 0, -1), (4, 0, 9, -1))
    values = event_targets(batch_windows([(window, 0, 5)], grid), "counts")
    shown = pictures(values, "counts", grid)[0]
    expected = torch.zeros(10, 12)
    expected[:2, 11], expected[9, :2] = np.log2(3) / 12, -1 / 12  # of 12 x 10 pixels some share a cell
    assert torch.allclose(shown, expected)


def test_a_repeated_event_changes_no_target():
    evae = small()
    once, rng = bars(evae, 1, np.random.default_rng(0)), np.random.default_rng(1)
    extra = np.sort(rng.integers(0, len(once.code), 40))
    order = np.sort(np.concatenate([np.arange(len(once.code)), extra]))
    more = EventBatch(once.grid, once.code[order], once.bin[order], np.array([0, len(order)]))
    for target in ("signed", "occupancy", "aged"):
        assert torch.equal(event_targets(once, target), event_targets(more, target))
    assert (event_targets(once, "counts") <= event_targets(more, "counts")).all()
