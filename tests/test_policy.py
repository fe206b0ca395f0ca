import json
import subprocess
import sys

import numpy as np
import pytest
import torch
from torch import nn

from models.evae import EventVAE
from models.networks import build_heads, encoder_part, push_latents, read_encoder_part, tabulate
from models.policy import ENCODER, HEADS, MANIFEST, Policy, PolicyFileError, load_policy, save_policy
from models.table import EncoderTable
from models.weights import save_encoder

EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
SIZES = {"stack": 3, "latent": 8, "hidden": [64, 64], "num_actions": 3}
SENSOR = {"sensor": {"width": 16, "height": 16}, "sensor_hash": "0123456789ab"}


@pytest.fixture(scope="module")
def evae():
    torch.manual_seed(0)
    return EventVAE(width=16, height=16, context=64, time_bins=32).freeze()


@pytest.fixture(scope="module")
def heads():
    heads = build_heads(SIZES, seed=3)
    with torch.no_grad():
        heads["pi"][-1].weight.mul_(100.0)  # so that actions differ
    return heads


@pytest.fixture
def folder(tmp_path, evae, heads):
    return save_policy(tmp_path / "policy", evae, heads, {**SIZES, **SENSOR, "figures": {"return": 1.5}})


def make_windows(rng, count, capacity=40):
    windows = np.zeros((count, capacity + 1, 4), np.int32)
    for window in windows:
        events = int(rng.integers(0, capacity + 1))
        window[0] = events, 0, 5000, 0
        window[1 : events + 1, 0] = np.sort(rng.integers(1, 5001, events))
        window[1 : events + 1, 1:3] = rng.integers(0, 16, (events, 2))
        window[1 : events + 1, 3] = rng.choice([-1, 1], events)
    return windows


def expected_logits(evae, heads, flights):
    """Logits after the last of each flight's windows (B, T, capacity + 1, 4), window by window."""
    table, rows = EncoderTable.from_evae(evae), []
    for windows in flights:
        latents = list(table.encode_windows(windows))
        rows.append(np.concatenate(([latents[0]] * 3 + latents)[-3:] if len(latents) < 3 else latents[-3:]))
    with torch.no_grad():
        return heads["pi"](torch.from_numpy(np.array(rows, np.float32))).numpy()


def test_a_policy_folder_alone_gives_the_logits_of_the_policy_that_was_saved(folder, evae, heads):
    policy = load_policy(folder)
    flights = make_windows(np.random.default_rng(0), 5 * 4).reshape(5, 4, 41, 4)
    policy.reset(5)
    for t in range(1, 5):
        logits = policy.logits(flights[:, t - 1])
        np.testing.assert_allclose(logits, expected_logits(evae, heads, flights[:, :t]), rtol=0, atol=2e-6)
    assert policy.manifest["figures"] == {"return": 1.5}
    assert policy.manifest["sensor_hash"] == "0123456789ab"


def test_the_first_latent_fills_the_stack_and_later_ones_push_out_the_oldest():
    stacks = np.arange(12, dtype=np.float32).reshape(2, 6)
    latents = np.array([[90, 91], [92, 93]], np.float32)
    pushed = push_latents(stacks, latents, np.array([True, False]))
    np.testing.assert_array_equal(pushed, [[90, 91] * 3, [8, 9, 10, 11, 92, 93]])
    assert pushed.dtype == np.float32
    assert stacks[0, 0] == 0


def test_a_restarted_flight_forgets_and_its_neighbours_remember(folder):
    windows = make_windows(np.random.default_rng(1), 12).reshape(4, 3, 41, 4)
    kept, restarted, alone = load_policy(folder), load_policy(folder), load_policy(folder)
    kept.reset(3)
    restarted.reset(3)
    for step in windows[:3]:
        kept.logits(step)
        restarted.logits(step)
    whole = kept.logits(windows[3])
    part = restarted.logits(windows[3], np.array([False, True, False]))
    np.testing.assert_array_equal(part[[0, 2]], whole[[0, 2]])
    assert not np.array_equal(part[1], whole[1])
    np.testing.assert_allclose(part[1], alone.logits(windows[3][1:2])[0], rtol=0, atol=2e-6)


def test_events_give_the_same_actions_as_their_packed_windows(folder):
    windows = make_windows(np.random.default_rng(2), 30)
    batch, single = load_policy(folder), load_policy(folder)
    chosen = [int(batch(window[None])[0]) for window in windows]
    acted = []
    for step, window in enumerate(windows):
        rows = window[1 : window[0, 0] + 1]
        events = np.empty(len(rows), EVENT)
        for column, name in enumerate("txyp"):
            events[name] = rows[:, column]
        events["t"] += 5000 * step
        acted.append(single.act(events, 5000 * step, 5000))
    assert acted == chosen
    assert len(set(chosen)) > 1


def test_actions_are_int64_and_the_likeliest_ones(folder):
    policy = load_policy(folder)
    windows = make_windows(np.random.default_rng(3), 6)
    policy.reset(6)
    actions = policy(windows)
    policy.reset(6)
    assert actions.dtype == np.int64
    np.testing.assert_array_equal(actions, policy.logits(windows).argmax(axis=1))


def test_a_stochastic_policy_draws_actions_with_their_probabilities(evae):
    class Fixed(nn.Module):
        def forward(self, stacks):
            return torch.log(torch.tensor([0.2, 0.5, 0.3])).repeat(len(stacks), 1) + 40.0

    table, count = EncoderTable.from_evae(evae), 4000
    policy = Policy(table, Fixed(), SIZES, deterministic=False, rng=np.random.default_rng(4))
    policy.reset(count)
    actions = policy(np.repeat(make_windows(np.random.default_rng(5), 1), count, axis=0))
    shares = np.bincount(actions, minlength=3) / count
    np.testing.assert_allclose(shares, [0.2, 0.5, 0.3], atol=0.03)  # 4 standard errors
    with pytest.raises(ValueError, match="rng must be given"):
        Policy(table, Fixed(), SIZES, deterministic=False)


def test_a_number_of_windows_other_than_that_of_the_flights_is_refused(folder):
    policy = load_policy(folder)
    with pytest.raises(ValueError, match=r"one for each of 1 flights, got 2: call reset\(num_envs\)"):
        policy(make_windows(np.random.default_rng(6), 2))


def test_hidden_layers_are_orthogonal_and_the_two_networks_share_nothing():
    heads = build_heads(SIZES, seed=7)
    for name, gain in (("pi", 0.01), ("vf", 1.0)):
        layers = [layer for layer in heads[name] if isinstance(layer, nn.Linear)]
        assert [tuple(layer.weight.shape) for layer in layers[:2]] == [(64, 24), (64, 64)]
        for layer, scale in zip(layers, (2**0.5, 2**0.5, gain), strict=True):
            weight = layer.weight.detach().double()
            gram = weight @ weight.T if weight.shape[0] <= weight.shape[1] else weight.T @ weight
            torch.testing.assert_close(gram, scale**2 * torch.eye(len(gram)).double(), atol=1e-5, rtol=0)
            assert not layer.bias.any()
        assert [type(layer) for layer in heads[name][1::2]] == [nn.Tanh, nn.Tanh]
    again, other = build_heads(SIZES, seed=7), build_heads(SIZES, seed=8)
    assert torch.equal(heads["pi"][0].weight, again["pi"][0].weight)
    assert not torch.equal(heads["pi"][0].weight, other["pi"][0].weight)
    assert not torch.equal(heads["pi"][0].weight, heads["vf"][0].weight)


def damage_heads(folder):
    data = bytearray((folder / HEADS).read_bytes())
    data[-1] ^= 1
    (folder / HEADS).write_bytes(data)


def swap_encoder(folder):
    torch.manual_seed(99)
    evae = EventVAE(width=16, height=16, context=64, time_bins=32).freeze()
    save_encoder(folder / ENCODER, evae, {})


def drop_heads(folder):
    (folder / HEADS).unlink()


def cut_manifest(folder):
    (folder / MANIFEST).write_text((folder / MANIFEST).read_text()[:-20])


def change_manifest(key, value):
    def change(folder):
        manifest = json.loads((folder / MANIFEST).read_text())
        (folder / MANIFEST).write_text(json.dumps({**manifest, key: value}))

    return change


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (damage_heads, r"heads\.safetensors: SHA-256 must be"),
        (swap_encoder, r"encoder\.safetensors: SHA-256 must be"),
        (drop_heads, r"heads\.safetensors: cannot be read: No such file"),
        (cut_manifest, r"policy\.json: not a JSON file"),
        (change_manifest("format", 2), r"format 2, this version reads 1"),
        (change_manifest("hidden", [64, 32]), "not the networks of this policy"),
        (change_manifest("stack", 10**9), "must be integers in 1"),
        (change_manifest("hidden", "x"), "must be integers in 1"),
        (change_manifest("sha256", {}), "sha256 must name"),
    ],
)
def test_a_folder_that_is_not_the_one_exported_is_refused_by_name(folder, spoil, message):
    spoil(folder)
    with pytest.raises(PolicyFileError, match=message):
        load_policy(folder)


def test_weights_that_are_not_finite_are_refused(tmp_path, evae):
    heads = build_heads(SIZES)
    with torch.no_grad():
        heads["pi"][0].bias[3] = torch.nan
    folder = save_policy(tmp_path, evae, heads, {**SIZES, **SENSOR})
    with pytest.raises(PolicyFileError, match=r"weights must be finite.*pi\.0\.bias"):
        load_policy(folder)


def test_the_flying_half_of_an_encoder_gives_the_table_of_the_whole(evae):
    part = tabulate(encoder_part(evae_copy(evae)), evae.settings)
    windows = make_windows(np.random.default_rng(8), 10)
    whole = EncoderTable.from_evae(evae)
    np.testing.assert_array_equal(part.encode_windows(windows), whole.encode_windows(windows))


def test_the_flying_half_is_all_buffers_and_without_the_decoder(evae):
    part = encoder_part(evae_copy(evae))
    assert list(part.parameters()) == []
    assert not [name for name in part.state_dict() if name.startswith("decoder")]
    assert not part.training


def test_an_encoder_whose_file_is_missing_or_changed_does_not_fly(tmp_path, evae):
    path = str(tmp_path / "encoder.safetensors")
    missing = read_encoder_part(path, "0" * 64, evae.settings)
    save_encoder(path, evae, {})
    changed = read_encoder_part(path, "0" * 64, evae.settings)
    for part in (missing, changed):
        with pytest.raises(ValueError, match="its file is missing or changed"):
            tabulate(part, evae.settings)


def test_flying_needs_no_ray():
    code = "import sys, models.policy; sys.exit('ray' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def evae_copy(evae):
    copy = EventVAE(**evae.settings)
    copy.load_state_dict(evae.state_dict())
    return copy.freeze()
