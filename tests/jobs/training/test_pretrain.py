import dataclasses
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from envs.config import EnvConfig, FaultsConfig
from envs.events import EVENT
from envs.recordings import Recording
from jobs.config.config import ConfigError
from jobs.run.folder import open_run
from jobs.training import pretrain
from jobs.training.collect import record
from jobs.training.ppo.gpu_steps import exact
from jobs.training.pretrain import EvaeTraining, checkpoints, held_out_figures, restore, save_checkpoint
from models.encoder.evae import SECTORS, EventVAE
from models.encoder.weights import load_encoder, save_encoder
from models.kinds import FixedModel
from tests.support.configs import make_config, small_config

SETTINGS = dataclasses.replace(
    make_config().pretrain,
    **{"windows": "mixed", "batch_windows": 8, "window_events": 500, "weight_decay": 1e-5},
    **{"beta": 1e-5, "beta_schedule": "constant"},
)
COUNT = dataclasses.replace(SETTINGS, windows="count")
OCCUPANCY = dataclasses.replace(EventVAE(context=64, latent=32).settings, target="occupancy")


def flown(steps, split="train", **more):
    """Recordings of some steps."""
    return record([(EnvConfig(observation="events", split=split), steps)], 0, lambda count: None, **more)


@pytest.fixture(scope="module")
def recording():
    return flown(600)[0]


@pytest.mark.parametrize("settings", [SETTINGS, COUNT], ids=["mixed", "count"])
def test_windows_hold_what_they_say_and_stay_in_one_flight(recording, settings):
    start, end, flight = (recording.index[name] for name in ("step_t_us", "step_end_us", "step_flight"))
    windows = pretrain.sample_windows(recording, settings, 500, np.random.default_rng(1))
    for events, start_us, window_us in windows:
        assert len(events) <= 500
        assert np.all((events["t"] > start_us) & (events["t"] <= start_us + window_us))
        first = int(np.searchsorted(start, start_us, side="right")) - 1
        last = int(np.searchsorted(end, start_us + window_us, side="left"))
        assert flight[max(first, 0)] == flight[last]
    if settings is COUNT:
        assert np.median([len(events) for events, _, _ in windows]) == 500  # fewer only where a flight ends
    else:
        lasting = np.array([window_us for _, _, window_us in windows]) / 5000
        assert 0.499 <= lasting.min() < 0.7
        assert 6 < lasting.max() <= 8.001


def test_windows_at_slow_control_end_before_the_next_flight_begins():
    slow = EnvConfig(observation="events", control_hz=2.0, speed_mps=8.0)
    (seen,) = record([(slow, 30)], 0, lambda count: None)
    start, end, flight = (seen.index[name] for name in ("step_t_us", "step_end_us", "step_flight"))
    assert flight[-1] > 0
    for _, start_us, window_us in pretrain.sample_windows(seen, SETTINGS, 200, np.random.default_rng(1)):
        step = int(np.searchsorted(start, start_us, side="right")) - 1
        last = int(np.searchsorted(flight, flight[step], side="right")) - 1
        assert 0 < window_us <= end[last] - start_us
    held_out = pretrain.held_out_windows(seen, SETTINGS, EventVAE(context=64).settings)
    assert all(len(batch) == pretrain.VALIDATION_WINDOWS for batch, _ in held_out.values())


def test_an_overfull_window_keeps_the_newest_events(recording):
    start_us, end_us = int(recording.index["step_t_us"][0]), int(recording.index["step_end_us"][200])
    everything = pretrain.cut_window(recording, start_us, end_us - start_us, 10**9)[0]
    kept = pretrain.cut_window(recording, start_us, end_us - start_us, 100)[0]
    assert len(everything) > 100
    assert np.array_equal(kept, everything[-100:])


def test_beta_follows_its_schedule():
    appendix = dataclasses.replace(SETTINGS, beta_schedule="appendix")
    assert [pretrain.beta(SETTINGS, 99), pretrain.beta(appendix, 1000)] == [1e-5, 0.0]
    assert pretrain.beta(appendix, 20_000) == pytest.approx(2e-3)


def trained(recording, iterations, checkpoint=None, true=None):
    """A training after some iterations, interrupted and continued at `checkpoint` if given."""
    training = EvaeTraining(OCCUPANCY, recording, SETTINGS, (0, 0), true)
    for iteration in range(0 if checkpoint is None else restore(checkpoint, training), iterations):
        training.step(iteration)
    return training


def test_an_interrupted_training_ends_with_the_same_weights(recording, tmp_path):
    whole = trained(recording, 5).evae
    save_checkpoint(tmp_path, trained(recording, 3), 3)
    continued = trained(recording, 5, tmp_path).evae
    for name, value in whole.state_dict().items():
        assert torch.equal(value, continued.state_dict()[name]), name


@pytest.mark.parametrize(
    "harm", [lambda content: content[:-9], lambda content: content[:900] + b"!" + content[901:]]
)
def test_a_damaged_checkpoint_is_left_for_the_one_before_it(recording, tmp_path, capsys, harm):
    training = trained(recording, 1)
    for iteration in (10, 20, 30):
        save_checkpoint(tmp_path, training, iteration)
    newest, before = checkpoints(tmp_path)
    newest.write_bytes(harm(newest.read_bytes()))
    assert restore(tmp_path, training) == 20
    assert capsys.readouterr().out == f"Checkpoint damaged, the one before it is taken: {newest}\n"
    assert checkpoints(tmp_path) == [before]


def test_proximity_is_decoded_as_at_the_end_of_the_nearest_step():
    ends_us = np.array([10, 20, 30, 140, 150])
    near = np.arange(10, dtype=np.uint16) * 6553
    seen = Recording(np.empty(0, EVENT), {"step_end_us": ends_us, "step_proximity": near}, {})
    windows = [(seen.events, 0, end_us) for end_us in (1, 14, 16, 20, 31, 139, 150)]
    read = pretrain.decoded("proximity", seen, windows, None, None, 0)
    assert read.dtype == torch.float32
    assert (read[:, 0] / 0.2).round().tolist() == [0, 0, 1, 1, 2, 3, 4]


def test_training_learns_the_proximity_of_obstacles_in_corridors_that_it_never_saw():
    (seen,), (unseen,) = (flown(1200, split, sectors=SECTORS) for split in ("train", "validation"))
    model = dataclasses.replace(OCCUPANCY, target="proximity")
    training = EvaeTraining(model, seen, dataclasses.replace(SETTINGS, lr=3e-3, batch_windows=32), (0, 0))
    held_out = pretrain.held_out_windows(unseen, SETTINGS, model)
    before = held_out_figures(training.evae, held_out)
    for iteration in range(100):
        training.step(iteration)
    after = held_out_figures(training.evae, held_out)
    assert before["auc_step"] < 0.55 < 0.65 < after["auc_step"]


def small(tmp_path, steps, **changes):
    """The configuration of a pretraining on few steps, half as many held out."""
    config = small_config(tmp_path)
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, context=64),
        collect=dataclasses.replace(config.collect, num_steps=steps, num_validation_steps=steps // 2),
        pretrain=dataclasses.replace(config.pretrain, **changes),
    )


@pytest.mark.system
@pytest.mark.parametrize(("weight", "dead"), [(100.0, 1.0), (1e-5, 0.0)])
def test_a_collapse_is_said_logged_and_written_down_and_training_goes_on(tmp_path, capsys, weight, dead):
    config, tracker = small(tmp_path, 200, iterations=80, validate_every=40, beta=weight), Mock()
    file = pretrain.prepare_encoder(open_run(config), tracker)
    logged = dict(call.args for call in tracker.log.call_args_list)
    assert sorted(logged) == [0, 40, 80]
    assert logged[80]["evae/collapsed"] == dead
    assert load_encoder(file)[1]["figures"]["collapsed"] == dead
    assert capsys.readouterr().out.count("posterior collapse") == dead  # once


def refreshing(tmp_path, encoder):
    return small(tmp_path, 100, iterations=1, lr=1e-9, encoder=str(encoder))


def test_a_refresh_begins_with_the_named_encoder_also_again_if_all_its_checkpoints_are_damaged(tmp_path):
    torch.manual_seed(7)
    evae, run_folder = EventVAE.of(OCCUPANCY), tmp_path / "before"
    save_encoder(run_folder / "encoder" / "encoder.safetensors", evae, {})
    for named, times in ((run_folder, 1), (run_folder / "encoder" / "encoder.safetensors", 2)):
        config = refreshing(tmp_path, named)
        folder = open_run(config)
        for _ in range(times):
            file = pretrain.prepare_encoder(folder, Mock())
            for name, value in load_encoder(file)[0].named_parameters():
                torch.testing.assert_close(value, evae.state_dict()[name], atol=1e-6, rtol=0)
            (folder.path / "stages" / "pretrain.json").rename(tmp_path / "finished")
            for checkpoint in checkpoints(folder.encoder):
                checkpoint.write_bytes(b"damaged")
    (tmp_path / "finished").rename(folder.path / "stages" / "pretrain.json")
    (run_folder / "encoder" / "encoder.json").unlink()
    pretrain.check_sources(config)  # pretrained already: the encoder is no longer needed


def test_windows_of_so_many_events_need_a_recording_with_some():
    with pytest.raises(ConfigError, match=r"pretrain\.windows: count needs events, and none were recorded"):
        EvaeTraining(OCCUPANCY, Recording(np.empty(0, EVENT), {}, {}), COUNT, (0, 0))


@pytest.mark.parametrize(
    ("name", "rule"),
    [
        ("", r"must be a run folder with an encoder, or an encoder file, got .*cannot be read"),
        ("other.safetensors", r"got context: 32 there, 64 here, target: 'signed' there"),
        ("lean.safetensors", r"must have a decoder .*got .*lean"),
    ],
)
def test_an_encoder_that_does_not_fit_is_refused_before_anything_is_made(tmp_path, name, rule):
    save_encoder(tmp_path / "other.safetensors", EventVAE(context=32, latent=32, target="signed"), {})
    save_encoder(tmp_path / "lean.safetensors", EventVAE.of(OCCUPANCY), {}, lean=True)
    with pytest.raises(ConfigError, match=rf"pretrain\.encoder: .*{rule}"):
        pretrain.run(refreshing(tmp_path, tmp_path / name))
    assert not (tmp_path / "runs").exists()


def test_a_policy_without_an_event_vae_has_nothing_to_pretrain(tmp_path):
    model = FixedModel(name="event_image", stack=3)
    config = dataclasses.replace(small_config(tmp_path), model=model)
    with pytest.raises(ConfigError, match="model: event_image has no event VAE to pretrain; go on with"):
        pretrain.run(config)
    assert not (tmp_path / "runs").exists()  # refused before anything was made
    assert pretrain.prepare_encoder(open_run(config), None) is None


def test_an_encoder_that_denoises_decodes_the_events_before_the_faults():
    noisy = EnvConfig(observation="events", faults=FaultsConfig(sparsity=0.5, background_activity=1.0))
    seen, true = record([(noisy, 150)], 0, lambda count: None, keep_true=True)
    rng = np.random.default_rng(0)
    windows = pretrain.sample_windows(seen, SETTINGS, 200, rng)
    found = pretrain.true_windows(true, windows, SETTINGS.window_events)
    for (events, start_us, window_us), (clean, begin_us, length_us) in zip(windows, found, strict=True):
        assert (start_us, window_us) == (begin_us, length_us)
        times = true.events["t"][(true.events["t"] > start_us) & (true.events["t"] <= start_us + window_us)]
        if len(events) == SETTINGS.window_events:  # the window begins with its oldest event
            times = times[times >= events["t"][0]]
        assert np.array_equal(clean["t"], times)
    plain, denoising = (trained(seen, 1, true=whole) for whole in (None, true))
    assert not torch.equal(plain.evae.decoder[0].weight, denoising.evae.decoder[0].weight)


ON_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no GPU here")
MODELS = [
    dataclasses.replace(OCCUPANCY, **changes)
    for changes in (
        {"latent": 8, "target": "signed"},
        {"variant": "bytestream_xy", "norm": "none"},
        {"coding": "eventnet", "target": "counts"},
        {"variant": "event_image_vae"},
    )
]


def begun(model, recording, device):
    return EvaeTraining(model, recording, SETTINGS, (0, 2), device=device)


def taught(training, first, last):
    with exact():
        return [training.step(k) for k in range(first, last)]


def weights(training):
    return {name: value.clone() for name, value in pretrain.on_processor(training.evae).state_dict().items()}


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


def test_pretraining_is_where_the_configuration_says(tmp_path, monkeypatch):
    asked = []

    def begin(*told):
        asked.append(told[-1])
        raise StopIteration

    monkeypatch.setattr(pretrain, "EvaeTraining", begin)
    monkeypatch.setattr(pretrain, "check_data", lambda folder: None)
    monkeypatch.setattr(pretrain, "read_split", lambda *told: (None, None))
    plain = small_config(tmp_path)
    on_gpu = dataclasses.replace(plain, cluster=dataclasses.replace(plain.cluster, device="cuda"))
    for config in (on_gpu, plain):
        with pytest.raises(StopIteration):
            pretrain.pretrain(open_run(config), None)
    assert asked == ["cuda", "cpu"]
