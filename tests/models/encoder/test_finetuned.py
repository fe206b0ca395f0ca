import copy
import dataclasses

import numpy as np
import pytest
import torch

from models.encoder.evae import EventVAE
from models.encoder.event_batch import EventBatch, batch_packed
from models.encoder.finetuned import EVENTS, FinetunedEncoder
from models.encoder.frozen import encoder_part, tabulate
from models.encoder.table import EncoderTable
from models.kinds import EncoderModel, PolicySpec, model_keys
from models.policy import load_policy, save_policy
from models.policy.features import feature_of
from models.policy.networks import build_networks
from tests.support.policies import SENSOR, make_windows

SIDE, BINS = 40, 1024
ENCODERS = [
    ("bytestream", "additive"),
    ("bytestream", "eventnet"),
    ("bytestream", "none"),
    ("bytestream_xy", "none"),
]


def make_evae(variant="bytestream", coding="additive", norm="batch"):
    torch.manual_seed(0)
    evae = EventVAE(
        variant,
        width=SIDE,
        height=SIDE,
        context=64,
        time_bins=BINS,
        norm=norm,
        target="occupancy",
        coding=coding,
    )
    for normalisation in evae.ecn.norms:
        torch.nn.init.uniform_(normalisation.running_mean, -0.2, 0.2)
        torch.nn.init.uniform_(normalisation.running_var, 0.1, 0.5)
        torch.nn.init.uniform_(normalisation.bias, -0.3, 0.3)
    return evae.freeze()


def make_spec(evae):
    own = {
        name: getattr(evae.settings, name)
        for name in model_keys("bytestream")
        if hasattr(evae.settings, name)
    }
    model = EncoderModel(name=evae.settings.variant, encoder="finetuned", stack=3, hidden=[8], **own)
    return PolicySpec(model, SIDE, SIDE, 3)


def make_trunk(evae):
    trunk = FinetunedEncoder(evae.settings)
    trunk.load_state_dict(encoder_part(copy.deepcopy(evae)).state_dict())
    return trunk


def make_rows(windows, evae):
    """Stacks (B, 3, EVENTS, 4) of 3 B packed windows."""
    spec = make_spec(evae)
    rows = feature_of(spec).from_observations(windows, spec, None)
    return torch.from_numpy(rows.reshape(-1, 3, *rows.shape[1:]))


def plain_batch(windows, grid):
    """What a network that learns sees of packed windows, written down a second time."""
    whole, code, bins, sizes = batch_packed(windows, grid), [], [], [0]
    for start, stop in zip(whole.offsets[:-1], whole.offsets[1:], strict=True):
        count = int(stop - start)
        kept = range(count)
        if count > EVENTS:
            kept = [int((k + 0.5) * count / EVENTS) for k in range(EVENTS)]
        code += [int(whole.code[start + n]) for n in kept]
        bins += [int(whole.bin[start + n]) for n in kept]
        sizes.append(len(code))
    return EventBatch(grid, np.array(code, np.int32), np.array(bins, np.int32), np.array(sizes))


@pytest.mark.parametrize(("variant", "coding"), ENCODERS)
@pytest.mark.parametrize("norm", ["batch", "none"])
def test_before_the_first_update_the_latents_are_those_of_the_frozen_encoder(variant, coding, norm):
    evae = make_evae(variant, coding, norm)
    windows = make_windows(np.random.default_rng(0), 30, capacity=EVENTS, side=SIDE)
    frozen = EncoderTable.from_evae(evae).encode_windows(windows)
    with torch.no_grad():
        latents = make_trunk(evae)(make_rows(windows, evae)).reshape(30, -1).numpy()
    np.testing.assert_allclose(latents, frozen, atol=2e-6 * np.abs(frozen).max())
    assert np.ptp(frozen, axis=0).min() > 1e-3


@pytest.mark.parametrize(("variant", "coding"), ENCODERS)
def test_gradients_are_those_of_the_plain_formula(variant, coding):
    evae = make_evae(variant, coding)
    windows = make_windows(np.random.default_rng(1), 12, capacity=1500, side=SIDE)
    direction = torch.from_numpy(np.random.default_rng(2).standard_normal((4, 24)))
    trunk, plain = make_trunk(evae).double().train(), make_trunk(evae).double()
    (trunk(make_rows(windows, evae)) * direction).sum().backward()
    mu = plain.encoder(plain.ecn.plain(plain_batch(windows, evae.grid)))[:, :8]
    (mu.reshape(4, 24) * direction).sum().backward()
    expected = dict(plain.named_parameters())
    for name, value in trunk.named_parameters():
        wanted = expected[name].grad
        assert (value.grad - wanted).abs().max() <= 1e-10 * wanted.abs().max(), name
        assert wanted.any(), name


def test_training_moves_no_running_statistic():
    evae = make_evae()
    trunk = make_trunk(evae).train()
    before = {name: value.clone() for name, value in trunk.named_buffers()}
    trunk(make_rows(make_windows(np.random.default_rng(3), 6, side=SIDE), evae)).sum().backward()
    assert all(torch.equal(value, before[name]) for name, value in trunk.named_buffers())
    assert not any(part.training for part in trunk.modules())


def test_a_policy_sees_large_windows_thinned_as_in_training(tmp_path):
    evae = make_evae()
    spec = make_spec(evae)
    networks = build_networks(spec)
    networks["trunk"] = make_trunk(evae)
    networks["pi"][-1].weight.data.mul_(100.0)
    windows = make_windows(np.random.default_rng(4), 6, capacity=6000, side=SIDE)
    assert windows[:, 0, 0].max() > 2 * EVENTS
    policy = load_policy(save_policy(tmp_path, networks, spec, SENSOR))
    policy.reset(2)
    for step in windows.reshape(2, 3, *windows.shape[1:]).swapaxes(0, 1):
        logits = policy.logits(step)
    with torch.no_grad():
        expected = networks["pi"](networks["trunk"](make_rows(windows, evae))).numpy()
    np.testing.assert_allclose(logits, expected, rtol=1e-5, atol=1e-5)
    whole = dataclasses.replace(policy.encoder, most_events=None)
    assert not np.allclose(whole.encode_windows(windows), policy.encoder.encode_windows(windows), atol=1e-4)


def test_the_table_of_an_encoder_that_learnt_on_is_that_of_its_event_vae():
    evae = make_evae()
    windows = make_windows(np.random.default_rng(5), 5, side=SIDE)
    table = tabulate(make_trunk(evae), evae.settings)
    np.testing.assert_array_equal(
        table.encode_windows(windows), EncoderTable.from_evae(evae).encode_windows(windows)
    )


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time_bins": 1 << 16}, "time_bins must be at most 32768 .*got 65536"),
        ({"coding": "phase"}, "coding"),
    ],
)
def test_an_encoder_that_cannot_be_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(make_spec(make_evae()).model, **change)
