import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from models.encoder.weights import save_encoder
from models.kinds import KINDS
from models.policy import PolicyFileError, load_policy, save_policy
from models.policy.networks import build_networks
from models.policy.policy import ENCODER, MANIFEST, MAX_BYTES, NETWORKS, read_policy_manifest
from tests.support.policies import ABOUT, RECURRENT, make_evae, make_spec, save


@pytest.fixture
def folder(tmp_path):
    return save(tmp_path / "policy", "bytestream")


def flip_a_bit(file):
    def change(folder):
        data = bytearray((folder / file).read_bytes())
        data[-1] ^= 1
        (folder / file).write_bytes(data)

    return change


def swap_encoder(folder):
    save_encoder(folder / ENCODER, make_evae(99), {})


def grow_networks(folder):
    os.truncate(folder / NETWORKS, MAX_BYTES + 1)  # a hole: takes no space


def cut_manifest(folder):
    (folder / MANIFEST).write_text((folder / MANIFEST).read_text()[:-20])


def change_manifest(*forgotten, **values):
    def change(folder):
        manifest = {**read_policy_manifest(folder / MANIFEST), **values}
        left = {name: value for name, value in manifest.items() if name not in forgotten}
        (folder / MANIFEST).write_text(json.dumps(left))

    return change


def first_format(folder):
    """As the folders of format 1 were."""
    manifest = {"format": 1, "sha256": {}, "stack": 3, "latent": 8, "hidden": [64, 64], "num_actions": 3}
    (folder / NETWORKS).rename(folder / "heads.safetensors")
    (folder / MANIFEST).write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (flip_a_bit(NETWORKS), r"networks\.safetensors: SHA-256 must be"),
        (flip_a_bit("encoder.json"), r"encoder\.json: SHA-256 must be"),
        (swap_encoder, r"encoder\.safetensors: SHA-256 must be"),
        (grow_networks, rf"networks\.safetensors: {MAX_BYTES + 1} bytes, at most {MAX_BYTES} are read"),
        (cut_manifest, r"policy\.json: not a JSON file"),
        (first_format, r"policy\.json: format 1, this version reads 2; train it again$"),
        (change_manifest("name"), r"the manifest lacks \['name'\]"),
        (change_manifest(name="snn"), r"name must be one of bytestream, .*, got 'snn'"),
        (change_manifest(name="brp_full"), r"name must be one of .*, got 'brp_full', .* bytestream now"),
        (change_manifest(width=64), r"encoder\.safetensors: must be that of .*width=64"),
        (change_manifest(hidden=[60_000, 60_000]), "not the networks of this policy"),
        (change_manifest(stack=10**9), "stack: .*got 1000000000"),
        (change_manifest("latent"), "lack latent"),
        (change_manifest(sha256={}), "sha256 must name encoder"),
        (change_manifest(encoder="finetuned"), r"sha256 must name networks\.safetensors, got"),
    ],
)
def test_a_folder_that_is_not_the_one_exported_is_refused_by_name(folder, spoil, message):
    spoil(folder)
    with pytest.raises(PolicyFileError, match=message):
        load_policy(folder)


@pytest.mark.parametrize(
    ("side", "message"), [(35, "at least 36 for event_image"), (60_000, "not the networks of this policy")]
)
def test_a_picture_of_another_size_is_refused_before_a_network_of_it_is_made(tmp_path, side, message):
    folder = save(tmp_path, "event_image")
    change_manifest(width=side, height=side)(folder)
    with pytest.raises(PolicyFileError, match=message):
        load_policy(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"context": 128}, "not the networks of this policy"),
        ({"time_bins": 40_000}, "time_bins must be at most 32768 .*got 40000"),
        ({"encoder": "frozen"}, r"sha256 must name encoder\.safetensors"),
    ],
)
def test_an_encoder_that_learnt_on_is_checked_as_an_encoder_file_is(tmp_path, changes, message):
    folder = save(tmp_path, "finetuned")
    change_manifest(**changes)(folder)
    with pytest.raises(PolicyFileError, match=message):
        load_policy(folder)


def a_weight_that_is_not_finite(networks):
    with torch.no_grad():
        next(networks["pi"].parameters())[0, 3] = torch.nan


def a_variance_below_zero(networks):
    networks["trunk"].ecn.norms[0].running_var[3] = -1.0


def another_precision(networks):
    networks.double()


@pytest.mark.parametrize(
    ("name", "spoil", "message"),
    [
        ("event_image", a_weight_that_is_not_finite, r"weights must be finite.*pi\."),
        ("finetuned", a_variance_below_zero, r"variances must not be negative.*norms\.0\.running_var"),
        ("event_image", another_precision, "not the networks of this policy"),
    ],
)
def test_networks_that_cannot_be_run_are_refused(tmp_path, name, spoil, message):
    networks = build_networks(make_spec(name))
    spoil(networks)
    folder = save_policy(tmp_path, networks, make_spec(name), ABOUT)
    with pytest.raises(PolicyFileError, match=message):
        load_policy(folder)


PRETRAINED = Path(__file__).resolve().parents[3] / "models" / "pretrained"
FOLDERS = sorted(path.parent for path in PRETRAINED.glob("*/policy.json"))


def test_policies_of_every_kind_are_shipped():
    names = {json.loads((folder / "policy.json").read_text())["name"] for folder in FOLDERS}
    assert names == set(KINDS) - set(RECURRENT)


EMPTY = {
    "window": np.zeros((1, 4096, 4), np.int32),
    "event_image": np.zeros((1, 64, 64), np.uint8),
    "luminance": np.zeros((1, 64, 64), np.float32),
}


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)
def test_a_shipped_policy_loads_and_gives_finite_logits(folder):
    policy = load_policy(folder)
    logits = policy.logits(EMPTY[policy.observation])
    assert logits.shape == (1, policy.spec.num_actions)
    assert np.all(np.isfinite(logits))
