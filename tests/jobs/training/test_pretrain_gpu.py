"""An event VAE learns on a GPU what it learns on the processor; without a GPU, that it is asked for."""

import dataclasses

import pytest
import torch

from envs.config import EnvConfig
from jobs.config.config import ConfigError
from jobs.run.folder import open_run
from jobs.training import pretrain
from jobs.training.collect import record
from jobs.training.ppo.gpu_steps import exact
from jobs.training.pretrain import EvaeTraining, check_sources, on_processor, restore, save_checkpoint
from models.encoder.evae import EventVAE
from models.kinds import EvaeSettings
from tests.support.configs import make_config, small_config

ON_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU here")
SETTINGS = dataclasses.replace(make_config().pretrain, batch_windows=8, window_events=500, weight_decay=1e-5)
MODELS = [
    EvaeSettings(**{**dataclasses.asdict(EventVAE(context=64).settings), **changes})
    for changes in (
        {"latent": 8, "target": "signed"},
        {"variant": "bytestream_xy", "norm": "none"},
        {"coding": "eventnet", "target": "counts"},
        {"variant": "event_image_vae", "target": "occupancy"},
    )
]


@pytest.fixture(scope="module")
def recording():
    return record([(EnvConfig(observation="events"), 400)], 0, lambda count: None)[0]


def begun(model, recording, device):
    return EvaeTraining(model, recording, SETTINGS, (0, 2), device=device)


def taught(training, first, last):
    with exact():
        return [training.step(k) for k in range(first, last)]


def weights(training):
    return {name: value.clone() for name, value in on_processor(training.evae).state_dict().items()}


@ON_GPU
@pytest.mark.parametrize("model", MODELS, ids=str)
def test_the_first_steps_on_a_gpu_are_those_of_the_processor(recording, model):
    plain, other = (begun(model, recording, device) for device in ("cpu", "cuda"))
    for name, value in weights(plain).items():
        assert torch.equal(value, weights(other)[name])
    for expected, found in zip(taught(plain, 0, 3), taught(other, 0, 3), strict=True):
        assert found == pytest.approx(expected, rel=2e-3, abs=1e-5)


@ON_GPU
@pytest.mark.parametrize("model", MODELS, ids=str)
def test_a_gpu_gives_the_same_bytes_again(recording, model):
    trainings = [begun(model, recording, "cuda") for _ in range(2)]
    told = [taught(training, 0, 20) for training in trainings]
    assert told[0] == told[1]
    first, second = map(weights, trainings)
    assert all(torch.equal(value, second[name]) for name, value in first.items())


@ON_GPU
@pytest.mark.parametrize("devices", [("cuda", "cpu"), ("cpu", "cuda"), ("cuda", "cuda")])
def test_a_training_goes_on_on_another_device(recording, tmp_path, devices):
    before, after = (begun(MODELS[0], recording, device) for device in devices)
    taught(before, 0, 3)
    save_checkpoint(tmp_path, before, 3)
    assert restore(tmp_path, after) == 3
    (expected,), (found,) = taught(before, 3, 4), taught(after, 3, 4)
    assert found == pytest.approx(expected, rel=1e-4, abs=1e-6)
    assert {float(state["step"]) for state in after.optimizer.state.values()} == {4.0}


def test_a_model_that_is_on_the_processor_is_not_copied():
    evae = EventVAE(context=64)
    assert on_processor(evae) is evae


def test_a_gpu_that_is_not_there_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match=r"cluster\.device"):
        check_sources(on_gpu(tmp_path))
    check_sources(small_config(tmp_path))


def test_pretraining_is_where_the_configuration_says(tmp_path, monkeypatch):
    asked = []

    def begin(*told):
        asked.append(told[-1])
        raise StopIteration

    monkeypatch.setattr(pretrain, "EvaeTraining", begin)
    monkeypatch.setattr(pretrain, "check_data", lambda folder: None)
    monkeypatch.setattr(pretrain, "read_split", lambda *told: (None, None))
    for config in (on_gpu(tmp_path / "a"), small_config(tmp_path / "b")):
        with pytest.raises(StopIteration):
            pretrain.pretrain(open_run(config), None)
    assert asked == ["cuda", "cpu"]


def on_gpu(tmp_path):
    config = small_config(tmp_path)
    return dataclasses.replace(config, cluster=dataclasses.replace(config.cluster, device="cuda"))
