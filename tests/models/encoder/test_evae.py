from typing import get_args

import numpy as np
import pytest
import torch

from models.encoder.evae import (
    EventVAE,
    active_units,
    appendix_beta,
    collapsed,
    event_targets,
    kl_divergence,
    ranking_area,
    reconstruct,
    reconstruction_loss,
    train_step,
    validate,
)
from models.encoder.event_batch import batch_windows
from models.kinds import Target
from tests.support.encoders import bars, events, small

EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])


def count(module):
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_default_model_has_the_appendix_sizes():
    evae = EventVAE()
    assert count(EventVAE(norm="none").ecn) == 140_672
    assert count(evae.ecn) == 140_672 - (64 + 128 + 1024) + 2 * (64 + 128 + 1024)
    assert count(evae.encoder) == 266_512
    assert count(evae.decoder) == 4_463_872


def test_the_settings_rebuild_the_model():
    evae = small(variant="bytestream_xy", target="occupancy", latent=5)
    assert EventVAE.of(evae.settings).settings == evae.settings


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"variant": "event_image"}, "variant: .*'event_image_vae', got 'event_image'"),
        ({"norm": "layer"}, "norm: .*got 'layer'"),
        ({"target": "age"}, "target: .*got 'age'"),
        ({"coding": "rotary"}, "coding: .*'none', got 'rotary'"),
        (
            {"variant": "bytestream_xy", "coding": "eventnet"},
            "coding must be additive or none for bytestream_xy",
        ),
        ({"context": 63}, "context: .*multiple of 2, got 63"),
        ({"latent": 0}, "latent: .*equal to 1, got 0"),
        ({"width": 4097}, "width: .*equal to 4096, got 4097"),
        ({"height": 3.0}, "height: .*integer, got 3.0"),
        ({"time_bins": True}, "time_bins: .*integer, got True"),
    ],
)
def test_a_setting_out_of_range_is_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        small(**changes)


def test_kl_is_the_closed_form_summed_over_the_latent():
    mu, logvar = torch.randn(4, 8, dtype=torch.float64), torch.randn(4, 8, dtype=torch.float64)
    expected = -0.5 * (1 + logvar - mu**2 - logvar.exp()).sum(1)
    assert torch.allclose(kl_divergence(mu, logvar), expected, atol=1e-13)
    assert kl_divergence(torch.zeros(1, 8), torch.zeros(1, 8)).item() == 0


def test_kl_of_a_nearly_standard_normal_is_not_lost_to_cancellation():
    logvar = torch.full((1, 1), 1e-3)
    assert kl_divergence(torch.zeros(1, 1), logvar).item() == pytest.approx(0.25e-6, rel=1e-3)


@pytest.mark.parametrize("value", [-1e4, -104.0, 10.0, 10.5, 89.0, 200.0, 1e4])
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
    small_error = reconstruction_loss(torch.ones(1, 4), torch.zeros(1, 4), "occupancy")
    assert reconstruction_loss(torch.ones(3, 400), torch.zeros(3, 400), "occupancy") == pytest.approx(
        small_error
    )


def test_pictures_lie_in_the_range_of_their_target():
    logits = torch.tensor([-50.0, 0.0, 50.0])
    assert reconstruct(logits, "signed").tolist() == [-1, 0, 1]
    assert reconstruct(logits, "occupancy").tolist() == pytest.approx([0, 0.5, 1])


def test_the_appendix_schedule_is_zero_up_to_iteration_1000_then_rises():
    assert [appendix_beta(it) for it in (0, 999, 1000)] == [0, 0, 0]
    assert appendix_beta(1001) == pytest.approx(1.001e-4)
    assert appendix_beta(20_000) == pytest.approx(2e-3)


def test_without_noise_the_latent_is_the_mean_and_noise_is_scaled_by_the_deviation():
    evae = small()
    batch = bars(evae, 3, np.random.default_rng(0))
    logits, mu, logvar = evae(batch)
    assert torch.equal(logits, evae.decoder(mu))
    noise = torch.randn(3, 8)
    expected = evae.decoder(mu + noise * torch.exp(0.5 * logvar))
    assert torch.allclose(evae(batch, noise)[0], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("variant", "target", "coding"),
    [
        ("bytestream", "signed", "additive"),
        ("bytestream_xy", "occupancy", "additive"),
        ("bytestream", "occupancy", "eventnet"),
        ("bytestream", "occupancy", "none"),
        ("bytestream", "aged", "additive"),
        ("bytestream", "counts", "additive"),
    ],
)
def test_training_beats_the_mean_picture_on_windows_never_seen(variant, target, coding):
    evae, rng = small(variant=variant, target=target, coding=coding), np.random.default_rng(3)
    optimizer = torch.optim.Adam(evae.parameters(), lr=1e-3)
    losses = []
    for _ in range(80):
        batch = bars(evae, 32, rng)
        losses.append(
            train_step(evae, optimizer, batch, event_targets(batch, target), 1e-5, rng)["reconstruction"]
        )
    held_out = bars(evae, 64, np.random.default_rng(99))
    figures = validate(evae.eval(), held_out, event_targets(held_out, target))
    assert np.mean(losses[-5:]) < 0.8 * np.mean(losses[:5])
    assert figures["reconstruction"] < 0.85 * figures["mean_picture"]
    assert figures["active_units"] >= 1
    assert figures["kl"] > 0


def test_the_loss_is_the_reconstruction_plus_beta_times_kl():
    evae, rng = small(), np.random.default_rng(0)
    batch = bars(evae, 4, rng)
    figures = train_step(
        evae, torch.optim.Adam(evae.parameters()), batch, event_targets(batch, "signed"), 0.5, rng
    )
    assert figures["loss"] == pytest.approx(figures["reconstruction"] + 0.5 * figures["kl"], rel=1e-6)
    assert all(isinstance(value, float) and np.isfinite(value) for value in figures.values())


def test_the_same_seeds_give_the_same_parameters():
    states = []
    for _ in range(2):
        evae, rng = small(), np.random.default_rng(1)
        batch = bars(evae, 4, rng)
        train_step(
            evae, torch.optim.Adam(evae.parameters()), batch, event_targets(batch, "signed"), 1e-3, rng
        )
        states.append(evae.state_dict())
    assert all(torch.equal(states[0][name], states[1][name]) for name in states[0])


def test_empty_windows_take_part_in_training():
    evae, rng = small(), np.random.default_rng(0)
    batch = batch_windows(
        [(events(), 0, 5), (events((1, 2, 0, 1), (2, 3, 0, 1)), 0, 5), (events(), 0, 5)], evae.grid
    )
    figures = train_step(
        evae, torch.optim.Adam(evae.parameters()), batch, event_targets(batch, "signed"), 1e-3, rng
    )
    assert np.isfinite(figures["loss"])


@pytest.mark.parametrize("value", [-1e4, 1e4])
def test_training_survives_an_encoder_whose_logvar_is_extreme(value):
    evae, rng = small(), np.random.default_rng(0)
    with torch.no_grad():
        evae.encoder[-1].bias[8:] = value
    batch = bars(evae, 4, rng)
    optimizer = torch.optim.Adam(evae.parameters(), lr=1e-2)
    for _ in range(3):
        figures = train_step(evae, optimizer, batch, event_targets(batch, "signed"), 1e-3, rng)
        assert all(np.isfinite(figure) for figure in figures.values())
    bias = evae.encoder[-1].bias.detach()[8:]
    assert torch.isfinite(torch.cat([p.detach().flatten() for p in evae.parameters()])).all()
    assert (bias.abs() < abs(value)).all()


def test_a_gradient_that_is_not_finite_stops_before_the_parameters_move():
    evae, rng = small(), np.random.default_rng(0)
    batch = bars(evae, 4, rng)
    targets = event_targets(batch, "signed")
    targets[0, 0] = np.nan
    before = {name: p.clone() for name, p in evae.named_parameters()}
    with pytest.raises(RuntimeError, match="non-finite"):
        train_step(evae, torch.optim.Adam(evae.parameters()), batch, targets, 1e-3, rng)
    assert all(torch.equal(before[name], p) for name, p in evae.named_parameters())


def test_the_gradient_is_clipped_to_its_limit():
    evae, rng = small(), np.random.default_rng(0)
    batch = bars(evae, 4, rng)
    optimizer = torch.optim.SGD(evae.parameters(), lr=1.0)
    before = torch.cat([p.detach().flatten() for p in evae.parameters()])
    train_step(evae, optimizer, batch, event_targets(batch, "signed"), 1e3, rng, max_norm=1e-3)
    after = torch.cat([p.detach().flatten() for p in evae.parameters()])
    assert (after - before).norm().item() == pytest.approx(1e-3, rel=0.02)


def test_a_frozen_model_is_in_eval_mode_and_stays_bit_equal_through_passes_in_train_mode():
    evae = small().freeze()
    assert not evae.training
    before = {name: value.clone() for name, value in evae.state_dict().items()}
    evae.train()
    for seed in range(3):
        logits, mu, _ = evae(bars(evae, 4, np.random.default_rng(seed)))
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


def test_the_area_is_one_for_the_truth_half_for_a_constant_and_half_where_there_is_no_pair():
    positive = np.array([True, False, False, True])
    assert ranking_area(positive.astype(float), positive) == 1.0
    assert ranking_area(1.0 - positive, positive) == 0.0
    assert ranking_area(np.ones(4), positive) == 0.5
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


@pytest.mark.parametrize(("beta", "expected"), [(1e2, True), (1e-5, False)])
def test_an_enormous_kl_weight_collapses_the_latent_and_a_small_one_does_not(beta, expected):
    evae, rng = small(target="occupancy"), np.random.default_rng(3)
    optimizer = torch.optim.Adam(evae.parameters(), lr=1e-3)
    for _ in range(80):
        batch = bars(evae, 32, rng)
        train_step(evae, optimizer, batch, event_targets(batch, "occupancy"), beta, rng)
    held_out = bars(evae, 64, np.random.default_rng(99))
    assert collapsed(validate(evae.eval(), held_out, event_targets(held_out, "occupancy"))) is expected


def test_a_collapse_needs_a_silent_latent_and_pictures_that_explain_nothing():
    alive = {"kl": 12.0, "active_units": 8.0, "explained_loss": 0.2}
    assert not collapsed(alive)
    assert not collapsed({**alive, "explained_loss": -0.1})  # young
    assert not collapsed({**alive, "active_units": 0.0})  # on a small scale
    assert collapsed({**alive, "active_units": 0.0, "explained_loss": 0.0})
    assert collapsed({**alive, "kl": 0.03, "explained_loss": 0.0})
