import copy
import dataclasses

import numpy as np
import pytest
import torch

from models.encoder.evae import EventVAE
from models.encoder.event_batch import batch_packed, thin
from models.encoder.finetuned import EVENTS, FinetunedEncoder
from models.encoder.frozen import encoder_part, read_encoder_part, tabulate
from models.encoder.table import EncoderTable
from models.encoder.weights import save_encoder
from models.kinds import EncoderModel, PolicySpec, model_keys
from models.policy import load_policy, save_policy
from models.policy.features import feature_of
from models.policy.networks import build_networks
from tests.support.policies import SENSOR, make_windows

SIDE, BINS = 40, 1024


def make_evae(variant="bytestream", coding="additive", norm="batch"):
    torch.manual_seed(0)
    own = {"context": 64, "time_bins": BINS, "norm": norm, "target": "occupancy", "coding": coding}
    evae = EventVAE(variant, width=SIDE, height=SIDE, **own)
    for normalisation in evae.ecn.norms:
        torch.nn.init.uniform_(normalisation.running_mean, -0.2, 0.2)
        torch.nn.init.uniform_(normalisation.running_var, 0.1, 0.5)
        torch.nn.init.uniform_(normalisation.bias, -0.3, 0.3)
    return evae.freeze()


def make_spec(evae):
    names = [name for name in model_keys("bytestream") if hasattr(evae.settings, name)]
    own = {name: getattr(evae.settings, name) for name in names}
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


@pytest.mark.parametrize(
    ("variant", "coding", "norm"),
    [
        ("bytestream", "additive", "none"),
        ("bytestream", "eventnet", "batch"),
        ("bytestream_xy", "none", "batch"),
    ],
)
def test_before_the_first_update_the_latents_are_those_of_the_frozen_encoder(variant, coding, norm):
    evae = make_evae(variant, coding, norm)
    windows = make_windows(np.random.default_rng(0), 30, capacity=EVENTS, side=SIDE)
    frozen = EncoderTable.from_evae(evae).encode_windows(windows)
    with torch.no_grad():
        latents = make_trunk(evae)(make_rows(windows, evae)).reshape(30, -1).numpy()
    np.testing.assert_allclose(latents, frozen, atol=2e-6 * np.abs(frozen).max())
    assert np.ptp(frozen, axis=0).min() > 1e-3


@pytest.mark.parametrize(("variant", "coding"), [("bytestream", "eventnet"), ("bytestream_xy", "none")])
def test_gradients_are_those_of_the_plain_formula(variant, coding):
    evae = make_evae(variant, coding)
    windows = make_windows(np.random.default_rng(1), 12, capacity=1500, side=SIDE)
    direction = torch.from_numpy(np.random.default_rng(2).standard_normal((4, 24)))
    trunk, plain = make_trunk(evae).double().train(), make_trunk(evae).double()
    (trunk(make_rows(windows, evae)) * direction).sum().backward()
    mu = plain.encoder(plain.ecn.plain(thin(batch_packed(windows, evae.grid), EVENTS)))[:, :8]
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


def test_the_frozen_half_of_an_encoder_is_all_buffers_and_gives_the_table_of_the_whole():
    evae = make_evae()
    windows = make_windows(np.random.default_rng(8), 10, side=SIDE)
    whole = EncoderTable.from_evae(evae).encode_windows(windows)
    part = encoder_part(evae)
    assert list(part.parameters()) == []
    assert not [name for name in part.state_dict() if name.startswith("decoder")]
    np.testing.assert_array_equal(tabulate(part, evae.settings).encode_windows(windows), whole)


def test_an_encoder_whose_file_is_missing_or_changed_does_not_fly(tmp_path):
    evae, path = make_evae(), str(tmp_path / "encoder.safetensors")
    missing = read_encoder_part(path, "0" * 64, evae.settings)
    save_encoder(path, evae, {})
    changed = read_encoder_part(path, "0" * 64, evae.settings)
    for part in (missing, changed):
        with pytest.raises(ValueError, match="its file is missing or changed"):
            tabulate(part, evae.settings)
