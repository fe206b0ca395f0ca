import shutil
from types import SimpleNamespace

import pytest
import torch

from jobs.config.config import ConfigError
from jobs.run.folder import finish, locate_run, open_run, run_name
from jobs.training.algorithms import build_algorithm
from jobs.training.inputs import check_inputs, prepare_inputs
from models.policy import load_policy
from tests.support.configs import SHORT, make_config
from tests.support.policies import kinds, save_untrained
from tests.support.runs import write_encoder

# As `save_untrained` makes them.
SIZES = {
    "event_columns": ("model=event_columns", "model.hidden=[16]"),
    "bytestream": (
        *("model.hidden=[16]", "model.context=64", "model.latent=8"),
        *("model.target=signed", "model.time_bins=1024"),
    ),
}
SIZES["finetuned"] = (*SIZES["bytestream"], "model.encoder=finetuned")
ENCODERS = {"event_columns": set(), "finetuned": set(), "bytestream": {"encoder.json", "encoder.safetensors"}}


def tracker(told=None):
    """Writes down the tags of a run that began from the policy of another."""
    other = lambda path: SimpleNamespace(run_id=f"that of {path.name}")  # noqa: E731
    return SimpleNamespace(run_id="mine", of=other, tags=({} if told is None else told).update)


def begun(tmp_path, name):
    """The configuration of a training that begins from a policy of a kind."""
    own = *SHORT, f"runs_dir={tmp_path / 'runs'}", "algo.num_env_runners=0", *SIZES[name]
    save_untrained(tmp_path / "before" / "policy", make_config(*own).env, name)
    return make_config(*own, f"train.init={tmp_path / 'before'}")


@pytest.mark.parametrize("name", kinds(SIZES, quick=("event_columns",)))
def test_a_run_keeps_a_copy_of_the_policy_that_it_begins_from(tmp_path, name):
    config, told = begun(tmp_path, name), {}
    check_inputs(config)
    folder, source = open_run(config), tmp_path / "before" / "policy"
    found = prepare_inputs(folder, tracker(told))
    assert found == (folder.init / "encoder.safetensors" if name == "bytestream" else None)
    expected = load_policy(source).manifest["sha256"]["networks.safetensors"]
    assert told == {"init": source, "init_sha256": expected, "init_run": "that of before"}
    names = {path.name for path in folder.init.iterdir()}
    assert names == {"policy.json", "networks.safetensors"} | ENCODERS[name]
    assert all((folder.init / own).read_bytes() == (source / own).read_bytes() for own in names)
    shutil.rmtree(source.parent)
    check_inputs(config)
    told.clear()
    assert prepare_inputs(folder, tracker(told)) == found
    assert told == {}
    networks = load_policy(folder.init).networks.state_dict()
    ppo = build_algorithm(config, found, folder.init / "networks.safetensors")
    module = ppo.rl_module_spec.build()
    for own, value in module.networks().state_dict().items():
        if own in networks:  # a fine-tuned encoder acts from a table
            assert torch.equal(value, networks[own])
    assert {own.split(".")[0] for own in networks} >= {"pi", "vf"}


def test_a_shipped_policy_can_be_trained_on(tmp_path):
    config = make_config(f"runs_dir={tmp_path}", "train.init=models/pretrained/bytestream-s0")
    check_inputs(config)
    path = prepare_inputs(locate_run(config), tracker())
    module = build_algorithm(config, path, path.parent / "networks.safetensors").rl_module_spec.build()
    expected = load_policy("models/pretrained/bytestream-s0").networks
    assert torch.equal(module.pi[0].weight, expected["pi"][0].weight)


COLUMNS = "model=event_columns model.hidden=[16]"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (f"{COLUMNS} train.init=nowhere", "must be a run folder or a policy folder, got 'nowhere'"),
        (f"{COLUMNS} model.stack=2", "must be a policy of the same model, got stack: 3 there, 2 here; set "),
        (f"{COLUMNS} camera.contrast_threshold=0.3", "the policy's, got contrast_threshold = 0.3 instead of"),
    ],
)
def test_a_policy_that_does_not_fit_is_refused_before_anything_is_made(tmp_path, words, said):
    before = [] if "train.init" in words else [f"train.init={begun(tmp_path, 'event_columns').train.init}"]
    config = make_config(f"runs_dir={tmp_path / 'runs'}", *before, *words.split())
    with pytest.raises(ConfigError, match=f"train.init: .*{said}"):
        check_inputs(config)
    assert not (tmp_path / "runs").exists()


def test_a_damaged_policy_is_refused(tmp_path):
    config = begun(tmp_path, "event_columns")
    file = tmp_path / "before" / "policy" / "networks.safetensors"
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    with pytest.raises(ConfigError, match=r"train.init: .*networks.safetensors: SHA-256 must be"):
        check_inputs(config)


def test_a_run_with_an_encoder_of_its_own_begins_only_from_a_policy_of_the_same(tmp_path):
    config = begun(tmp_path, "bytestream")
    folder = open_run(config)
    folder.encoder.mkdir()
    for name in ENCODERS["bytestream"]:
        shutil.copy(tmp_path / "before" / "policy" / name, folder.encoder / name)
    finish(folder, "pretrain", {})
    check_inputs(config)
    write_encoder(folder.encoder, config)
    with pytest.raises(
        ConfigError, match=r"train.init: must have the encoder of this run, .*; delete .*pretrain.json"
    ):
        check_inputs(config)


def test_what_a_training_begins_from_is_part_of_its_name():
    names = [run_name(make_config(*words)) for words in ((), ("train.init=a",), ("train.init=b",))]
    assert len(set(names)) == 3
