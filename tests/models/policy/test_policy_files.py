import json
import os

import pytest
import torch

from models.encoder.weights import save_encoder
from models.policy import PolicyFileError, load_policy, save_policy
from models.policy.networks import build_networks
from models.policy.policy import ENCODER, MANIFEST, MAX_BYTES, NETWORKS, read_policy_manifest
from tests.support.policies import ABOUT, make_evae, make_spec, save


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


def drop_networks(folder):
    (folder / NETWORKS).unlink()


def grow_networks(folder):
    with (folder / NETWORKS).open("r+b") as file:
        file.truncate(MAX_BYTES + 1)  # a hole: takes no space


def link_networks(folder):
    (folder / NETWORKS).rename(folder.parent / "elsewhere")
    (folder / NETWORKS).symlink_to(folder.parent / "elsewhere")


def pipe_networks(folder):
    (folder / NETWORKS).unlink()
    os.mkfifo(folder / NETWORKS)


def cut_manifest(folder):
    (folder / MANIFEST).write_text((folder / MANIFEST).read_text()[:-20])


def change_manifest(**values):
    def change(folder):
        manifest = read_policy_manifest(folder / MANIFEST)
        (folder / MANIFEST).write_text(json.dumps({**manifest, **values}))

    return change


def forget(key):
    def change(folder):
        manifest = read_policy_manifest(folder / MANIFEST)
        del manifest[key]
        (folder / MANIFEST).write_text(json.dumps(manifest))

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
        (flip_a_bit(ENCODER), r"encoder\.safetensors: SHA-256 must be"),
        (flip_a_bit("encoder.json"), r"encoder\.json: SHA-256 must be"),
        (swap_encoder, r"encoder\.safetensors: SHA-256 must be"),
        (drop_networks, r"networks\.safetensors: cannot be read: No such file"),
        (grow_networks, rf"networks\.safetensors: {MAX_BYTES + 1} bytes, at most {MAX_BYTES} are read"),
        (link_networks, r"networks\.safetensors: cannot be read: a link, which could name any file; copy"),
        (pipe_networks, r"networks\.safetensors: cannot be read: no regular file"),
        (cut_manifest, r"policy\.json: not a JSON file"),
        (first_format, r"policy\.json: format 1, this version reads 2; train it again$"),
        (change_manifest(format=3), r"format 3, this version reads 2"),
        (forget("name"), r"the manifest lacks \['name'\]"),
        (change_manifest(name="snn"), r"name must be one of bytestream, .*, got 'snn'"),
        (change_manifest(name=["event_image"]), r"name: .*, got \['event_image'\]"),
        (change_manifest(name="bytestream_xy"), r"encoder\.safetensors: must be that of .*'bytestream_xy'"),
        (change_manifest(width=64), r"encoder\.safetensors: must be that of .*width=64"),
        (change_manifest(name="event_columns"), r"sha256 must name networks\.safetensors, got"),
        (change_manifest(hidden=[64, 32]), "not the networks of this policy"),
        (change_manifest(hidden=[60_000, 60_000]), "not the networks of this policy"),
        (change_manifest(name="brp_full"), r"name must be one of .*, got 'brp_full', .* bytestream now"),
        (change_manifest(stack=10**9), "stack: .*got 1000000000"),
        (change_manifest(stack=True), "stack: .*got True"),
        (change_manifest(hidden="x"), "hidden: .*got 'x'"),
        (change_manifest(hidden=None), "hidden: .*got None"),
        (change_manifest(latent=None), "latent: .*got None"),
        (forget("latent"), "lack latent"),
        (change_manifest(sha256={}), "sha256 must name encoder"),
        (change_manifest(encoder="finetuned"), r"sha256 must name networks\.safetensors, got"),
        (
            change_manifest(encoder="finetuned", name="event_image"),
            r"sha256 must name networks\.safetensors, got",
        ),
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


@pytest.mark.parametrize("name", ["event_columns", "event_image"])
def test_weights_that_are_not_finite_are_refused(tmp_path, name):
    networks = build_networks(make_spec(name))
    weight = next(iter(networks["pi"].parameters()))
    with torch.no_grad():
        weight[0, 3] = torch.nan
    folder = save_policy(tmp_path, networks, make_spec(name), ABOUT)
    with pytest.raises(PolicyFileError, match=r"weights must be finite.*pi\."):
        load_policy(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"context": 63}, "context: .*multiple of 2, got 63"),
        ({"context": 128}, "not the networks of this policy"),
        ({"coding": "phase"}, "coding: .*got 'phase'"),
        ({"norm": ["batch"]}, "norm: .*got"),
        ({"time_bins": 40_000}, "time_bins must be at most 32768 .*got 40000"),
        ({"encoder": "frozen"}, r"sha256 must name encoder\.safetensors"),
    ],
)
def test_an_encoder_that_learnt_on_is_checked_as_an_encoder_file_is(tmp_path, change, message):
    folder = save(tmp_path, "finetuned")
    change_manifest(**change)(folder)
    with pytest.raises(PolicyFileError, match=message):
        load_policy(folder)


def test_an_encoder_that_learnt_on_needs_its_settings_and_variances(tmp_path):
    folder = save(tmp_path / "one", "finetuned")
    forget("coding")(folder)
    with pytest.raises(PolicyFileError, match="lack coding"):
        load_policy(folder)
    networks = build_networks(make_spec("finetuned"))
    networks["trunk"].ecn.norms[0].running_var[3] = -1.0
    folder = save_policy(tmp_path / "other", networks, make_spec("finetuned"), ABOUT)
    with pytest.raises(PolicyFileError, match=r"variances must not be negative.*norms\.0\.running_var"):
        load_policy(folder)


def test_weights_of_another_precision_are_refused(tmp_path):
    spec = make_spec("event_image")
    folder = save_policy(tmp_path, build_networks(spec).double(), spec, ABOUT)
    with pytest.raises(PolicyFileError, match="not the networks of this policy"):
        load_policy(folder)
