import numpy as np
import pytest
import torch

from models.encoder.evae import EventVAE, event_targets, train_step, validate
from models.encoder.event_batch import Grid, batch_windows
from models.encoder.event_images import event_pictures
from models.encoder.frozen import encoder_of
from models.policy.features import event_picture
from tests.support.encoders import WINDOW_US, make_events

SIDE = 40


def make_evae():
    torch.manual_seed(0)
    return EventVAE("event_image_vae", width=SIDE, height=SIDE, context=64, target="occupancy")


def batch_of(*counts):
    parts = [make_events(count, seed, width=SIDE, height=SIDE) for seed, count in enumerate(counts)]
    return batch_windows([(events, 0, WINDOW_US) for events in parts], Grid(SIDE, SIDE, 1024))


def test_the_picture_is_the_event_image_on_a_scale_where_on_is_one():
    batch = batch_of(0, 1, 2000)
    for row, (start, stop) in enumerate(zip(batch.offsets, batch.offsets[1:], strict=False)):
        expected = event_picture(batch.code[start:stop], SIDE, SIDE)
        np.testing.assert_allclose(255.0 * event_pictures(batch)[row, 0], expected, rtol=1e-6)


def test_it_learns_where_events_were():
    evae, rng = make_evae(), np.random.default_rng(0)
    optimizer = torch.optim.Adam(evae.parameters(), lr=3e-3)
    batch = batch_of(*[40] * 4)
    targets = event_targets(batch, evae.target)
    losses = [train_step(evae, optimizer, batch, targets, 1e-6, rng)["loss"] for _ in range(50)]
    assert losses[-1] < 0.5 * losses[0]
    figures = validate(evae.eval(), batch, targets)
    assert figures["reconstruction"] < figures["mean_picture"]


def test_the_frozen_encoder_gives_the_mean_of_the_latent_for_events_and_for_packed_windows():
    evae = make_evae().freeze()
    encoder, events = encoder_of(evae), make_events(300, width=SIDE, height=SIDE)
    expected = evae(batch_windows([(events, 7, WINDOW_US)], evae.grid))[1][0].numpy()
    packed = np.zeros((2, 301, 4), np.int32)
    packed[0, 0] = [300, 0, WINDOW_US, 0]
    packed[0, 1:] = np.stack([events["t"] - 7, events["x"], events["y"], events["p"]], axis=1)
    np.testing.assert_allclose(encoder.encode(events, 7, WINDOW_US), expected, atol=1e-6)
    latents = encoder.encode_windows(packed)
    np.testing.assert_allclose(latents[0], expected, atol=1e-6)
    np.testing.assert_allclose(latents[1], encoder.encode(events[:0], 0, WINDOW_US), atol=1e-6)
    assert np.abs(latents[0] - latents[1]).max() > 1e-3


def test_a_sensor_too_small_for_the_convolutions_is_refused():
    with pytest.raises(ValueError, match="36 pixels each way, got 40 x 20"):
        EventVAE("event_image_vae", width=40, height=20)
