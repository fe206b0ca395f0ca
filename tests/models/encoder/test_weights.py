import hashlib
import json
import os

import numpy as np
import pytest
import safetensors.torch
import torch

from models.encoder.evae import EventVAE, event_targets, train_step
from models.encoder.event_batch import batch_windows
from models.encoder.weights import (
    MAX_MANIFEST_BYTES,
    EncoderFileError,
    load_encoder,
    save_encoder,
    without_checksum,
)

EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
SETTINGS = {
    "variant": "bytestream_xy",
    "width": 6,
    "height": 5,
    "context": 16,
    "latent": 3,
    "target": "occupancy",
}


def make_evae():
    """A small model after one update, so that its running statistics have moved."""
    torch.manual_seed(0)
    evae, rng = EventVAE(**SETTINGS), np.random.default_rng(0)
    window = np.zeros(20, EVENT)
    window["x"], window["y"], window["p"] = rng.integers(0, 6, 20), rng.integers(0, 5, 20), 1
    batch = batch_windows([(window, 0, 10)], evae.grid)
    train_step(evae, torch.optim.Adam(evae.parameters()), batch, event_targets(batch, "occupancy"), 0.0, rng)
    return evae


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "encoder" / "encoder.safetensors"
    save_encoder(file, make_evae(), {"sensor": {"width": 6}, "sensor_hash": "abc", "figures": {"kl": 1.5}})
    return file


def rewrite(path, change):
    """Change a manifest in place."""
    file = path.with_suffix(".json")
    manifest = without_checksum(json.loads(file.read_text()))
    change(manifest)
    file.write_text(json.dumps(manifest))


def replace_tensors(path, change):
    """Change the tensors and let the manifest agree with the new file."""
    tensors = safetensors.torch.load(path.read_bytes())
    change(tensors)
    data = safetensors.torch.save(tensors)
    path.write_bytes(data)
    rewrite(path, lambda manifest: manifest.update(sha256=hashlib.sha256(data).hexdigest()))


def test_a_saved_encoder_comes_back_bit_for_bit_frozen_with_its_manifest(path):
    loaded, manifest = load_encoder(path)
    saved = make_evae()
    assert loaded.settings == saved.settings
    assert all(torch.equal(saved.state_dict()[name], value) for name, value in loaded.state_dict().items())
    assert not loaded.training
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    assert manifest["sensor"] == {"width": 6}
    assert manifest["figures"] == {"kl": 1.5}
    assert manifest["model"] == saved.settings


def test_an_encoder_from_before_there_was_a_choice_of_coding_comes_back_with_the_additive_one(path):
    rewrite(path, lambda manifest: manifest["model"].pop("coding"))
    loaded, manifest = load_encoder(path)
    assert loaded.settings.coding == manifest["model"].coding == "additive"
    assert torch.equal(loaded.encoder[0].weight, make_evae().encoder[0].weight)


def test_an_encoder_of_another_coding_comes_back_with_it(tmp_path):
    torch.manual_seed(0)
    evae = EventVAE(**{**SETTINGS, "variant": "bytestream", "coding": "eventnet"})
    save_encoder(tmp_path / "e.safetensors", evae, {})
    loaded, _ = load_encoder(tmp_path / "e.safetensors")
    assert loaded.settings.coding == "eventnet"
    assert loaded.encoder[0].in_features == 32


def test_saving_over_an_encoder_replaces_it_and_leaves_no_other_file(path):
    evae = make_evae()
    with torch.no_grad():
        evae.decoder[0].bias.fill_(7)
    save_encoder(path, evae, {})
    assert (load_encoder(path)[0].decoder[0].bias == 7).all()
    assert sorted(file.name for file in path.parent.iterdir()) == ["encoder.json", "encoder.safetensors"]


def test_every_flipped_bit_is_refused(path):
    data = bytearray(path.read_bytes())
    for position in np.linspace(0, len(data) - 1, 25).astype(int):
        data[position] ^= 1
        path.write_bytes(data)
        with pytest.raises(EncoderFileError, match="damaged: SHA-256"):
            load_encoder(path)
        data[position] ^= 1


@pytest.mark.parametrize("size", [0, 7, 1000])
def test_a_truncated_file_is_refused(path, size):
    path.write_bytes(path.read_bytes()[:size])
    with pytest.raises(EncoderFileError, match=r"encoder\.safetensors: damaged"):
        load_encoder(path)


def test_a_file_that_is_no_safetensors_is_refused_even_if_its_digest_agrees(path):
    data = b"not tensors"
    path.write_bytes(data)
    rewrite(path, lambda manifest: manifest.update(sha256=hashlib.sha256(data).hexdigest()))
    with pytest.raises(EncoderFileError, match="not a safetensors file"):
        load_encoder(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t["encoder.0.bias"].fill_(float("nan")), "encoder.0.bias has values that are not finite"),
        (lambda t: t["encoder.0.bias"].fill_(float("inf")), "encoder.0.bias has values that are not finite"),
        (lambda t: t["ecn.norms.0.running_var"].fill_(-1.0), "negative variances"),
        (lambda t: t.pop("encoder.0.bias"), "unexpected or missing tensors"),
        (lambda t: t.update(more=torch.zeros(1)), "unexpected or missing tensors"),
        (lambda t: t.update({"encoder.0.bias": torch.zeros(3)}), "encoder.0.bias is"),
        (lambda t: t.update({"encoder.0.bias": torch.zeros(256, dtype=torch.float64)}), "encoder.0.bias is"),
    ],
)
def test_tensors_that_do_not_fit_the_model_are_refused(path, change, message):
    replace_tensors(path, change)
    with pytest.raises(EncoderFileError, match=message):
        load_encoder(path)


def test_a_file_larger_than_the_model_can_be_is_refused_before_it_is_read(path):
    with path.open("r+b") as file:
        file.truncate(1 << 33)
    with pytest.raises(EncoderFileError, match="8589934592 bytes, at most"):
        load_encoder(path)


def test_a_huge_manifest_is_refused_before_it_is_read(path):
    with path.with_suffix(".json").open("r+b") as file:
        file.truncate(1 << 33)
    with pytest.raises(EncoderFileError, match=f"at most {MAX_MANIFEST_BYTES}"):
        load_encoder(path)


@pytest.mark.parametrize("suffix", [".json", ".safetensors"])
def test_a_link_or_a_pipe_is_refused_before_it_is_read(path, suffix):
    file = path.with_suffix(suffix)
    file.rename(file.with_name("elsewhere"))
    file.symlink_to("elsewhere")
    with pytest.raises(EncoderFileError, match=rf"encoder\{suffix}: cannot be read: a link, .*; copy"):
        load_encoder(path)
    file.unlink()
    os.mkfifo(file)
    with pytest.raises(EncoderFileError, match=rf"encoder\{suffix}: cannot be read: no regular file"):
        load_encoder(path)


@pytest.mark.parametrize("suffix", [".json", ".safetensors"])
def test_a_missing_file_is_named(path, suffix):
    path.with_suffix(suffix).unlink()
    with pytest.raises(EncoderFileError, match=rf"encoder\{suffix}: cannot be read"):
        load_encoder(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m.pop("sha256"), "lacks"),
        (lambda m: m.update(format=2), "format 2, this version reads 1"),
        (lambda m: m["model"].update(context=10**9), "context: .*got 1000000000"),
        (lambda m: m["model"].update(layers=3), "layers"),
        (lambda m: m["model"].pop("norm"), "norm"),
        (lambda m: m["model"].update(variant="brp_full"), "variant 'brp_full', .* bytestream now"),
        (lambda m: m.update(model=[1]), "settings are refused"),
        (lambda m: m["model"].update(width=7), "decoder.4.weight is"),
    ],
)
def test_a_manifest_that_does_not_describe_the_model_is_refused(path, change, message):
    rewrite(path, change)
    with pytest.raises(EncoderFileError, match=message):
        load_encoder(path)


@pytest.mark.parametrize("text", ["", "{", "[]", "[" * 100_000, "\x00"])
def test_a_manifest_that_is_not_a_json_object_is_refused(path, text):
    path.with_suffix(".json").write_text(text)
    with pytest.raises(EncoderFileError, match=r"encoder\.json"):
        load_encoder(path)


@pytest.mark.parametrize("manifest", [{"model": {}}, {"kl": float("nan")}, {"x": object()}])
def test_a_manifest_that_cannot_be_recorded_is_refused_and_nothing_is_written(tmp_path, manifest):
    with pytest.raises(EncoderFileError, match="manifest"):
        save_encoder(tmp_path / "encoder.safetensors", make_evae(), manifest)
    assert not list(tmp_path.iterdir())


def test_a_model_that_is_not_finite_or_not_float32_is_never_written(tmp_path):
    broken = make_evae()
    with torch.no_grad():
        broken.encoder[0].weight[0, 0] = float("nan")
    for evae in (broken, make_evae().double()):
        with pytest.raises(EncoderFileError, match=r"encoder\.safetensors: tensor"):
            save_encoder(tmp_path / "encoder.safetensors", evae, {})
    assert not list(tmp_path.iterdir())


def test_a_name_with_another_ending_is_refused(tmp_path):
    with pytest.raises(EncoderFileError, match=r"ends in \.safetensors"):
        load_encoder(tmp_path / "encoder.pt")


def test_a_lean_file_flies_nearly_the_same_and_draws_nothing(tmp_path, path):
    whole, lean = make_evae().eval(), tmp_path / "lean.safetensors"
    save_encoder(lean, whole, {}, lean=True)
    loaded, _ = load_encoder(lean)
    assert loaded.decoder is None
    assert lean.stat().st_size < path.stat().st_size / 10
    window = np.zeros(9, EVENT)
    window["t"], window["x"], window["y"], window["p"] = range(1, 10), np.arange(9) % 6, np.arange(9) % 5, 1
    batch = batch_windows([(window, 0, 10)], whole.grid)
    found, expected = (model.encoder(model.ecn(batch)) for model in (loaded, whole))
    torch.testing.assert_close(found, expected, atol=5e-3, rtol=5e-3)
    assert not torch.equal(found, expected)
    again = tmp_path / "again.safetensors"
    save_encoder(again, loaded, {})
    assert all(
        torch.equal(load_encoder(again)[0].state_dict()[name], value)
        for name, value in loaded.state_dict().items()
    )
