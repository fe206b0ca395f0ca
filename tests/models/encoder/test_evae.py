from typing import get_args

import numpy as np
import pytest
import torch

from models.encoder.evae import (
    SECTORS,
    EventVAE,
    active_units,
    appendix_beta,
    collapsed,
    event_targets,
    kl_divergence,
    pictures,
    ranking_area,
    reconstruct,
    reconstruction_loss,
    target_shape,
    train_step,
    validate,
)
from models.encoder.event_batch import batch_windows
from models.kinds import Target
from tests.support.encoders import bars, events, small


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def step(evae, batch=None, targets=None, beta=1e-3, optimizer=None, **limits):
    """One update; of four bars unless told otherwise."""
    rng = np.random.default_rng(0)
    batch = bars(evae, 4, rng) if batch is None else batch
    targets = event_targets(batch, evae.target) if targets is None else targets
    optimizer = optimizer or torch.optim.Adam(evae.parameters())
    return train_step(evae, optimizer, batch, targets, beta, rng, **limits)


def flat(evae):
    return torch.cat([parameter.detach().flatten() for parameter in evae.parameters()])


def test_the_default_model_has_the_appendix_sizes():
    evae = EventVAE()
    assert count(EventVAE(norm="none").ecn) == 140_672
    assert count(evae.ecn) == 140_672 - (64 + 128 + 1024) + 2 * (64 + 128 + 1024)
    assert count(evae.encoder) == 266_512
    assert count(evae.decoder) == 4_463_872


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"variant": "event_image"}, "variant: .*'event_image_vae', got 'event_image'"),
        (
            {"variant": "bytestream_xy", "coding": "eventnet"},
            "coding must be additive or none for bytestream_xy",
        ),
        ({"context": 63}, "context: .*multiple of 2, got 63"),
    ],
)
def test_a_setting_out_of_range_is_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        small(**changes)


def test_kl_is_the_closed_form_summed_over_the_latent():
    mu, logvar = torch.randn(4, 8, dtype=torch.float64), torch.randn(4, 8, dtype=torch.float64)
    expected = -0.5 * (1 + logvar - mu**2 - logvar.exp()).sum(1)
    assert torch.allclose(kl_divergence(mu, logvar), expected, atol=1e-13)


def test_kl_of_a_nearly_standard_normal_is_not_lost_to_cancellation():
    logvar = torch.full((1, 1), 1e-3)
    assert kl_divergence(torch.zeros(1, 1), logvar).item() == pytest.approx(0.25e-6, rel=1e-3)


@pytest.mark.parametrize("value", [-1e4, 10.5, 1e4])
def test_kl_and_its_gradient_stay_finite_at_extreme_logvar_and_point_back(value):
    logvar = torch.full((1, 8), value, requires_grad=True)
    kl = kl_divergence(torch.zeros(1, 8), logvar).sum()
    kl.backward()
    assert torch.isfinite(kl)
    assert torch.isfinite(logvar.grad).all()
    assert (torch.sign(logvar.grad) == np.sign(value)).all()


def test_kl_continues_smoothly_where_the_exponential_is_replaced():
    logvar = torch.tensor([[9.999], [10.001]], dtype=torch.float64, requires_grad=True)
    kl = kl_divergence(torch.zeros(2, 1, dtype=torch.float64), logvar)
    kl.sum().backward()
    assert (kl[1] - kl[0]).item() == pytest.approx(0.002 * 0.5 * (np.exp(10) - 1), rel=1e-3)
    assert (logvar.grad[1] / logvar.grad[0]).item() == pytest.approx(1, rel=2e-3)


@pytest.mark.parametrize("logit", [-1e4, 17.0, 1e4])
def test_extreme_logits_have_a_finite_loss_and_cross_entropy_a_live_gradient(logit):
    for target in get_args(Target)[::-1]:
        logits = torch.full((1, 4), logit, requires_grad=True)
        loss = reconstruction_loss(logits, torch.full((1, 4), float(logit < 0)), target)
        loss.backward()
        assert torch.isfinite(loss)
        assert torch.isfinite(logits.grad).all()
        assert target == "signed" or (logits.grad != 0).all()


def test_the_reconstruction_error_is_a_mean_over_pixels():
    one, many = (
        reconstruction_loss(torch.ones(shape), torch.zeros(shape), "occupancy")
        for shape in ((1, 4), (3, 400))
    )
    assert one == pytest.approx(many)


def test_the_appendix_schedule_is_zero_up_to_iteration_1000_then_rises():
    assert [appendix_beta(it) for it in (0, 999, 1000)] == [0, 0, 0]
    assert [appendix_beta(it) for it in (1001, 20_000)] == pytest.approx([1.001e-4, 2e-3])


def test_without_noise_the_latent_is_the_mean_and_noise_is_scaled_by_the_deviation():
    evae = small()
    batch = bars(evae, 3, np.random.default_rng(0))
    logits, mu, logvar = evae(batch)
    assert torch.equal(logits, evae.decoder(mu))
    noise = torch.randn(3, 8)
    expected = evae.decoder(mu + noise * torch.exp(0.5 * logvar))
    assert torch.allclose(evae(batch, noise)[0], expected, atol=1e-6)


def trained(evae, beta, steps):
    """Losses of training on bars, and figures on bars never seen."""
    rng, optimizer = np.random.default_rng(3), torch.optim.Adam(evae.parameters(), lr=1e-3)
    losses = []
    for _ in range(steps):
        batch = bars(evae, 32, rng)
        figures = train_step(evae, optimizer, batch, event_targets(batch, evae.target), beta, rng)
        losses.append(figures["reconstruction"])
    held_out = bars(evae, 64, np.random.default_rng(99))
    return losses, validate(evae.eval(), held_out, event_targets(held_out, evae.target))


@pytest.mark.parametrize(
    ("variant", "target", "coding"),
    [
        ("bytestream", "signed", "eventnet"),
        ("bytestream_xy", "occupancy", "additive"),
        ("bytestream", "aged", "additive"),
        ("bytestream", "counts", "none"),
    ],
)
def test_training_beats_the_mean_picture_on_windows_never_seen(variant, target, coding):
    losses, figures = trained(small(variant=variant, target=target, coding=coding), 1e-5, 80)
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:5])
    assert figures["reconstruction"] < 0.85 * figures["mean_picture"]
    assert figures["active_units"] >= 1
    assert figures["kl"] > 0
    assert not collapsed(figures)


def test_an_enormous_kl_weight_collapses_the_latent():
    _, figures = trained(small(target="occupancy"), 1e2, 40)
    assert collapsed(figures)


def test_the_loss_is_the_reconstruction_plus_beta_times_kl_and_the_seeds_decide_the_parameters():
    models = small(), small()
    figures, again = (step(evae, beta=0.5) for evae in models)
    assert figures == again
    assert figures["loss"] == pytest.approx(figures["reconstruction"] + 0.5 * figures["kl"], rel=1e-6)
    assert torch.equal(flat(models[0]), flat(models[1]))


def test_empty_windows_take_part_in_training():
    evae = small()
    windows = [(events(), 0, 5), (events((1, 2, 0, 1), (2, 3, 0, 1)), 0, 5), (events(), 0, 5)]
    assert np.isfinite(step(evae, batch_windows(windows, evae.grid))["loss"])


@pytest.mark.parametrize("value", [-1e4, 1e4])
def test_training_survives_an_encoder_whose_logvar_is_extreme(value):
    evae = small()
    with torch.no_grad():
        evae.encoder[-1].bias[8:] = value
    optimizer = torch.optim.Adam(evae.parameters(), lr=1e-2)
    for _ in range(3):
        assert np.isfinite(list(step(evae, optimizer=optimizer).values())).all()
    assert torch.isfinite(flat(evae)).all()
    assert (evae.encoder[-1].bias.detach()[8:].abs() < abs(value)).all()


def test_a_gradient_that_is_not_finite_stops_before_the_parameters_move():
    evae = small()
    batch = bars(evae, 4, np.random.default_rng(0))
    targets = event_targets(batch, "signed")
    targets[0, 0] = np.nan
    before = flat(evae)
    with pytest.raises(RuntimeError, match="non-finite"):
        step(evae, batch, targets)
    assert torch.equal(before, flat(evae))


def test_the_gradient_is_clipped_to_its_limit():
    evae = small()
    before = flat(evae)
    step(evae, beta=1e3, optimizer=torch.optim.SGD(evae.parameters(), lr=1.0), max_norm=1e-3)
    assert (flat(evae) - before).norm().item() == pytest.approx(1e-3, rel=0.02)


def test_a_frozen_model_is_in_eval_mode_and_stays_bit_equal_through_passes_in_train_mode():
    evae = small().freeze()
    assert not evae.training
    before = {name: value.clone() for name, value in evae.state_dict().items()}
    evae.train()
    logits, mu, _ = evae(bars(evae, 4, np.random.default_rng(0)))
    assert not logits.requires_grad
    assert not mu.requires_grad
    assert all(torch.equal(before[name], value) for name, value in evae.state_dict().items())


def test_active_units_are_those_that_vary_over_windows():
    mu = torch.zeros(10, 3)
    mu[::2, 0], mu[::2, 1] = 1.0, 0.01
    assert active_units(mu) == 1
    assert active_units(mu[:1]) == 0


@pytest.mark.parametrize("levels", [3, 10_000], ids=["many ties", "few ties"])
def test_the_area_is_the_share_of_pairs_in_order_a_tie_half(levels):
    rng = np.random.default_rng(levels)
    scores, positive = rng.integers(levels, size=(9, 20)).astype(np.float32), rng.random((9, 20)) < 0.3
    own, others = scores[positive], scores[~positive]
    pairs = [float(mine > other) + 0.5 * float(mine == other) for mine in own for other in others]
    assert ranking_area(scores, positive) == pytest.approx(np.mean(pairs), abs=1e-12)


def test_the_area_is_half_where_there_is_no_pair_and_scores_that_are_no_numbers_are_refused():
    assert [ranking_area(np.arange(4.0), np.full(4, every)) for every in (False, True)] == [0.5, 0.5]
    with pytest.raises(ValueError, match="scores must be numbers, got NaN"):
        ranking_area(np.array([0.0, np.nan]), np.array([True, False]))


def test_the_area_of_a_signed_picture_asks_for_events_of_either_polarity():
    evae = small().eval()
    batch = batch_windows([(events((1, 0, 0, 1), (2, 1, 0, -1)), 0, 5)], evae.grid)
    with torch.no_grad():
        evae.decoder[-1].weight.zero_()
        evae.decoder[-1].bias.zero_()
        evae.decoder[-1].bias[:2] = torch.tensor([2.0, -2.0])
    assert validate(evae, batch, event_targets(batch, "signed"))["auc"] == 1.0


def test_windows_that_are_all_the_same_leave_nothing_to_explain():
    evae = small(target="occupancy").eval()
    empty = batch_windows([(events(), 0, 5)] * 3, evae.grid)
    figures = validate(evae, empty, event_targets(empty, "occupancy"))
    assert (figures["explained_loss"], figures["auc"]) == (0.0, 0.5)
    assert np.isfinite(list(figures.values())).all()


def test_a_collapse_needs_a_silent_latent_and_pictures_that_explain_nothing():
    alive = {"kl": 12.0, "active_units": 8.0, "explained_loss": 0.2}
    assert not collapsed({**alive, "explained_loss": -0.1})  # young
    assert not collapsed({**alive, "active_units": 0.0})  # on a small scale
    assert collapsed({**alive, "active_units": 0.0, "explained_loss": 0.0})
    assert collapsed({**alive, "kl": 0.03, "explained_loss": 0.0})


def test_the_signed_target_is_the_polarity_of_the_pixels_last_event_and_occupancy_where_it_is_not_0():
    window = events((1, 2, 0, 1), (2, 2, 0, -1), (3, 4, 1, 1), (3, 5, 1, -1), (4, 5, 1, 1))
    batch = batch_windows([(window, 0, 5), (events(), 0, 5)], small().grid)
    expected = torch.zeros(2, 10, 12)
    expected[0, 0, 2], expected[0, 1, 4], expected[0, 1, 5] = -1, 1, 1
    assert torch.equal(event_targets(batch, "signed"), expected.flatten(1))
    assert torch.equal(event_targets(batch, "occupancy"), expected.flatten(1).abs())


def test_the_aged_target_is_the_time_of_the_pixels_newest_event():
    window = events((100, 3, 1, 1), (1, 2, 0, 1), (5000, 2, 0, -1), (2500, 2, 0, 1))  # in any order
    picture = event_targets(batch_windows([(window, 0, 5000), (events(), 0, 5000)], small().grid), "aged")
    expected = torch.zeros(2, 10, 12)
    expected[0, 0, 2], expected[0, 1, 3] = 31.5 / 32, 0.5 / 32
    assert torch.allclose(picture, expected.flatten(1))


def test_the_counts_target_counts_every_event_once_and_its_picture_shows_the_prevailing_polarity():
    evae = small()
    batch = bars(evae, 5, np.random.default_rng(0))
    counts = 2.0 ** (12 * event_targets(batch, "counts").double().reshape(5, 2, 8, 8)) - 1
    assert torch.allclose(counts.sum((1, 2, 3)), torch.from_numpy(np.diff(batch.offsets)).double(), atol=1e-3)
    window = events((1, 11, 0, 1), (2, 11, 0, 1), (3, 11, 0, -1), (4, 0, 9, -1))
    values = event_targets(batch_windows([(window, 0, 5)], evae.grid), "counts")
    expected = torch.zeros(10, 12)
    expected[:2, 11], expected[9, :2] = np.log2(3) / 12, -1 / 12  # of 12 x 10 pixels some share a cell
    assert torch.allclose(pictures(values, "counts", evae.grid)[0], expected)


@pytest.mark.parametrize("target", get_args(Target))
def test_every_target_has_its_shape_its_decoder_and_a_picture_of_the_sensors_size(target):
    evae = small(target=target)
    batch = bars(evae, 3, np.random.default_rng(0))
    logits = evae(batch)[0]
    given = target == "proximity"  # of the scene, not of events
    targets = torch.rand(3, SECTORS) if given else event_targets(batch, target)
    assert targets.dtype == torch.float32
    assert targets.shape == logits.shape == (3, np.prod(target_shape(target, evae.grid)))
    values = reconstruct(logits, target)
    assert (values.min() < 0) == (target in ("signed", "counts"))
    for shown in (pictures(own, target, evae.grid) for own in (targets, values)):
        assert shown.shape == (3, 10, 12)
        assert shown.abs().max() <= 1
