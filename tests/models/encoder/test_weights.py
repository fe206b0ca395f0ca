import hashlib
import json
import os
from functools import partial

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
from tests.support.encoders import WINDOW_US, make_events

SETTINGS = {
    "variant": "bytestream_xy",
    "width": 6,
    "height": 5,
    "context": 16,
    "latent": 3,
    "target": "occupancy",
    "coding": "none",
}


def window_of(evae):
    return batch_windows([(make_events(20, width=6, height=5), 0, WINDOW_US)], evae.grid)


def make_evae():
    """A small model after one update, so that its running statistics have moved."""
    torch.manual_seed(0)
    evae, rng = EventVAE(**SETTINGS), np.random.default_rng(0)
    batch = window_of(evae)
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


def test_saving_over_an_encoder_replaces_it_and_leaves_no_other_file(path):
    evae = make_evae()
    with torch.no_grad():
        evae.decoder[0].bias.fill_(7)
    save_encoder(path, evae, {})
    assert (load_encoder(path)[0].decoder[0].bias == 7).all()
    assert sorted(file.name for file in path.parent.iterdir()) == ["encoder.json", "encoder.safetensors"]


def foreign(path):
    """No safetensors, though its digest agrees."""
    data = b"not tensors"
    path.write_bytes(data)
    rewrite(path, lambda manifest: manifest.update(sha256=hashlib.sha256(data).hexdigest()))


def link(file):
    file.rename(file.with_name("elsewhere"))
    file.symlink_to("elsewhere")


def pipe(file):
    file.unlink()
    os.mkfifo(file)


def flip(path, place):
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)


def cut(path, size, suffix=".safetensors"):
    os.truncate(path.with_suffix(suffix), size)


def describe(path, text):
    path.with_suffix(".json").write_text(text)


TENSORS = [
    (lambda t: t["encoder.0.bias"].fill_(float("nan")), "encoder.0.bias has values that are not finite"),
    (lambda t: t["ecn.norms.0.running_var"].fill_(-1.0), "negative variances"),
    (lambda t: t.pop("encoder.0.bias"), "unexpected or missing tensors"),
    (lambda t: t.update({"encoder.0.bias": torch.zeros(3)}), "encoder.0.bias is"),
    (lambda t: t.update({"encoder.0.bias": torch.zeros(256, dtype=torch.float64)}), "encoder.0.bias is"),
]
MANIFESTS = [
    (lambda m: m.pop("sha256"), "lacks"),
    (lambda m: m.update(format=2), "format 2, this version reads 1"),
    (lambda m: m["model"].update(context=10**9), "context: .*got 1000000000"),
    (lambda m: m["model"].update(layers=3), "layers"),
    (lambda m: m["model"].update(variant="brp_full"), "variant 'brp_full', .* bytestream now"),
    (lambda m: m.update(model=[1]), "settings are refused"),
    (lambda m: m["model"].update(width=7), "decoder.4.weight is"),
]
# What is done to the two files, and the rule that reading them states.
DAMAGES = [
    *((partial(replace_tensors, change=change), rule) for change, rule in TENSORS),
    *((partial(rewrite, change=change), rule) for change, rule in MANIFESTS),
    *((partial(describe, text=text), r"encoder\.json") for text in ("{", "[]", "[" * 100_000)),
    *((partial(flip, place=place), "damaged: SHA-256") for place in (0, 1000, -1)),
    (partial(cut, size=0), r"encoder\.safetensors: damaged"),
    (partial(cut, size=1 << 33), "8589934592 bytes, at most"),
    (partial(cut, size=1 << 33, suffix=".json"), f"at most {MAX_MANIFEST_BYTES}"),
    (foreign, "not a safetensors file"),
    (link, r"encoder\.safetensors: cannot be read: a link, .*; copy"),
    (pipe, r"encoder\.safetensors: cannot be read: no regular file"),
    (os.unlink, r"encoder\.safetensors: cannot be read"),
    (lambda path: link(path.with_suffix(".json")), r"encoder\.json: cannot be read: a link"),
]


@pytest.mark.parametrize(("damage", "rule"), DAMAGES)
def test_damaged_files_are_refused_with_the_rule(path, damage, rule):
    damage(path)
    with pytest.raises(EncoderFileError, match=rule):
        load_encoder(path)


@pytest.mark.parametrize("manifest", [{"model": {}}, {"kl": float("nan")}, {"x": object()}])
def test_a_manifest_that_cannot_be_recorded_is_refused_and_nothing_is_written(tmp_path, manifest):
    with pytest.raises(EncoderFileError, match="manifest"):
        save_encoder(tmp_path / "encoder.safetensors", make_evae(), manifest)
    assert not list(tmp_path.iterdir())


def test_a_model_that_is_not_finite_or_not_float32_is_never_written(tmp_path):
    with pytest.raises(EncoderFileError, match=r"ends in \.safetensors"):
        save_encoder(tmp_path / "encoder.pt", make_evae(), {})
    broken = make_evae()
    with torch.no_grad():
        broken.encoder[0].weight[0, 0] = float("nan")
    for evae in (broken, make_evae().double()):
        with pytest.raises(EncoderFileError, match=r"encoder\.safetensors: tensor"):
            save_encoder(tmp_path / "encoder.safetensors", evae, {})
    assert not list(tmp_path.iterdir())


def test_a_lean_file_flies_nearly_the_same_and_draws_nothing(tmp_path, path):
    whole, lean = make_evae().eval(), tmp_path / "lean.safetensors"
    save_encoder(lean, whole, {}, lean=True)
    loaded, _ = load_encoder(lean)
    assert loaded.decoder is None
    assert lean.stat().st_size < path.stat().st_size / 10
    found, expected = (model.encoder(model.ecn(window_of(whole))) for model in (loaded, whole))
    torch.testing.assert_close(found, expected, atol=5e-3, rtol=5e-3)
    assert not torch.equal(found, expected)
    again = tmp_path / "again.safetensors"
    save_encoder(again, loaded, {})
    assert all(
        torch.equal(load_encoder(again)[0].state_dict()[name], value)
        for name, value in loaded.state_dict().items()
    )
