import dataclasses

import numpy as np
import pytest
import torch

from envs.config import CameraConfig, EnvConfig, FaultsConfig
from envs.events import EVENT
from envs.recordings import Recording
from jobs.config.config import ConfigError
from jobs.config.schema import PretrainConfig
from jobs.run.folder import open_run
from jobs.training.collect import record
from jobs.training.pretrain import (
    VALIDATION_WINDOWS,
    EvaeTraining,
    beta,
    check_sources,
    checkpoints,
    cut_window,
    decoded,
    held_out_figures,
    held_out_windows,
    prepare_encoder,
    restore,
    run,
    sample_windows,
    save_checkpoint,
    true_windows,
)
from models.encoder.evae import SECTORS, EventVAE
from models.encoder.weights import load_encoder, save_encoder
from models.kinds import FixedModel
from tests.support.configs import small_config

SETTINGS = PretrainConfig(
    encoder=None,
    denoise=False,
    iterations=100,
    batch_windows=8,
    window_events=500,
    windows="mixed",
    lr=1e-3,
    weight_decay=0.0,
    beta=1e-5,
    beta_schedule="constant",
    validate_every=10,
    checkpoint_every=10,
)
COUNT = dataclasses.replace(SETTINGS, windows="count")


@pytest.fixture(scope="module")
def recording():
    return record([(EnvConfig(observation="events"), 900)], 0, lambda count: None)[0]


@pytest.mark.parametrize("settings", [SETTINGS, COUNT], ids=["mixed", "count"])
def test_windows_hold_what_they_say_and_stay_in_one_flight(recording, settings):
    start, end, flight = (recording.index[name] for name in ("step_t_us", "step_end_us", "step_flight"))
    for events, start_us, window_us in sample_windows(recording, settings, 3000, np.random.default_rng(1)):
        assert len(events) <= 500
        assert np.all((events["t"] > start_us) & (events["t"] <= start_us + window_us))
        first = int(np.searchsorted(start, start_us, side="right")) - 1
        last = int(np.searchsorted(end, start_us + window_us, side="left"))
        assert flight[max(first, 0)] == flight[last]


def test_windows_at_slow_control_end_before_the_next_flight_begins():
    slow = EnvConfig(observation="events", control_hz=2.0, speed_mps=8.0)
    flown = record([(slow, 30)], 0, lambda count: None)[0]
    start, end, flight = (flown.index[name] for name in ("step_t_us", "step_end_us", "step_flight"))
    assert flight[-1] > 0
    for _, start_us, window_us in sample_windows(flown, SETTINGS, 500, np.random.default_rng(1)):
        step = int(np.searchsorted(start, start_us, side="right")) - 1
        last = int(np.searchsorted(flight, flight[step], side="right")) - 1
        assert 0 < window_us <= end[last] - start_us
    held_out = held_out_windows(flown, SETTINGS, EventVAE(context=64).settings)
    assert all(len(seen) == VALIDATION_WINDOWS for seen, _ in held_out.values())


def test_mixed_windows_last_from_half_a_step_to_eight_steps(recording):
    windows = sample_windows(recording, SETTINGS, 500, np.random.default_rng(2))
    lengths = np.array([window_us for _, _, window_us in windows]) / 5000
    assert lengths.min() < 0.7
    assert lengths.max() > 6
    assert np.all((lengths >= 0.499) & (lengths <= 8.001))


def test_count_windows_hold_the_asked_number_of_events(recording):
    sizes = [len(events) for events, _, _ in sample_windows(recording, COUNT, 100, np.random.default_rng(3))]
    assert np.median(sizes) == 500  # fewer only where a flight ends


def test_an_overfull_window_keeps_the_newest_events(recording):
    start_us, end_us = int(recording.index["step_t_us"][0]), int(recording.index["step_end_us"][200])
    everything = cut_window(recording, start_us, end_us - start_us, 10**9)[0]
    kept = cut_window(recording, start_us, end_us - start_us, 100)[0]
    assert len(everything) > 100
    assert np.array_equal(kept, everything[-100:])


def test_beta_follows_its_schedule():
    assert [beta(SETTINGS, iteration) for iteration in (0, 99)] == [1e-5, 1e-5]
    appendix = dataclasses.replace(SETTINGS, beta_schedule="appendix")
    assert beta(appendix, 1000) == 0.0
    assert beta(appendix, 20_000) == pytest.approx(2e-3)


def trained(recording, iterations, checkpoint=None, true=None):
    """A training after some iterations, interrupted and continued at `checkpoint` if given."""
    model = EventVAE(context=64, latent=32, target="occupancy").settings
    settings = dataclasses.replace(SETTINGS, batch_windows=8)
    training = EvaeTraining(model, recording, settings, (0, 0), true)
    for iteration in range(0 if checkpoint is None else restore(checkpoint, training), iterations):
        training.step(iteration)
    return training


def test_an_interrupted_training_ends_with_the_same_weights(recording, tmp_path):
    whole = trained(recording, 20).evae
    save_checkpoint(tmp_path, trained(recording, 12), 12)
    continued = trained(recording, 20, tmp_path).evae
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
    flown = Recording(np.empty(0, EVENT), {"step_end_us": ends_us, "step_proximity": near}, {})
    windows = [(flown.events, 0, end_us) for end_us in (1, 14, 16, 20, 31, 139, 150)]
    read = decoded("proximity", flown, windows, None, None, 0)
    assert read.dtype == torch.float32
    assert (read[:, 0] / 0.2).round().tolist() == [0, 0, 1, 1, 2, 3, 4]


def test_training_learns_the_proximity_of_obstacles_in_corridors_that_it_never_saw():
    flown, unseen = (
        record([(EnvConfig(observation="events", split=split), 2000)], 0, lambda _: None, sectors=SECTORS)[0]
        for split in ("train", "validation")
    )
    model = EventVAE(context=64, latent=32, target="proximity").settings
    training = EvaeTraining(model, flown, dataclasses.replace(SETTINGS, lr=3e-3, batch_windows=32), (0, 0))
    held_out = held_out_windows(unseen, SETTINGS, model)
    before = held_out_figures(training.evae, held_out)
    for iteration in range(120):
        training.step(iteration)
    after = held_out_figures(training.evae, held_out)
    assert before["auc_step"] < 0.55 < 0.65 < after["auc_step"]


def test_training_explains_windows_of_flights_that_it_never_saw(recording):
    unseen = record([(EnvConfig(observation="events", split="validation"), 300)], 0, lambda count: None)[0]
    torch.manual_seed(0)
    untrained = EventVAE(context=64, latent=32, target="occupancy")
    held_out = held_out_windows(unseen, SETTINGS, untrained.settings)
    before = held_out_figures(untrained, held_out)
    after = held_out_figures(trained(recording, 40).evae, held_out)
    assert after["reconstruction_step"] < 0.5 * before["reconstruction_step"]
    assert after["explained_loss_four_steps"] > before["explained_loss_four_steps"]


class Listener:
    """Takes what a tracker would."""

    def __init__(self):
        self.logged = {}

    def log(self, step, figures):
        self.logged[step] = figures

    def artifact(self, *given):
        pass

    figure = artifact


@pytest.mark.system
@pytest.mark.parametrize(("weight", "dead"), [(100.0, 1.0), (1e-5, 0.0)])
def test_a_collapse_is_said_logged_and_written_down_and_training_goes_on(tmp_path, capsys, weight, dead):
    config = small_config(tmp_path)
    config = dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, context=64),
        collect=dataclasses.replace(config.collect, num_steps=200, num_validation_steps=100),
        pretrain=dataclasses.replace(config.pretrain, iterations=80, validate_every=40, beta=weight),
    )
    folder, listener = open_run(config), Listener()
    file = prepare_encoder(folder, listener)
    figures = [figures for step, figures in listener.logged.items() if step > 0]
    assert sorted(listener.logged) == [0, 40, 80]
    assert figures[-1]["evae/collapsed"] == dead
    assert load_encoder(file)[1]["figures"]["collapsed"] == dead
    assert capsys.readouterr().out.count("posterior collapse") == dead  # once


def refreshing(tmp_path, encoder, **changes):
    config = small_config(tmp_path)
    return dataclasses.replace(
        config,
        model=dataclasses.replace(config.model, **{"context": 64, **changes}),
        collect=dataclasses.replace(config.collect, num_steps=100, num_validation_steps=50),
        pretrain=dataclasses.replace(config.pretrain, iterations=1, lr=1e-9, encoder=encoder),
    )


def test_a_refresh_begins_with_the_weights_of_the_encoder_that_is_named(tmp_path):
    torch.manual_seed(7)
    evae, run_folder = EventVAE(context=64, latent=32, target="occupancy"), tmp_path / "before"
    save_encoder(run_folder / "encoder" / "encoder.safetensors", evae, {})
    for named in (run_folder, run_folder / "encoder" / "encoder.safetensors"):
        config = refreshing(tmp_path, str(named))
        file = prepare_encoder(open_run(config), Listener())
        for name, value in load_encoder(file)[0].named_parameters():
            torch.testing.assert_close(value, evae.state_dict()[name], atol=1e-6, rtol=0)
    (run_folder / "encoder" / "encoder.json").unlink()
    check_sources(config)  # pretrained already: the encoder is no longer needed


def test_a_refresh_whose_checkpoints_are_all_damaged_begins_with_the_named_encoder_again(tmp_path):
    torch.manual_seed(7)
    evae, run_folder = EventVAE(context=64, latent=32, target="occupancy"), tmp_path / "before"
    save_encoder(run_folder / "encoder" / "encoder.safetensors", evae, {})
    folder = open_run(refreshing(tmp_path, str(run_folder)))
    prepare_encoder(folder, Listener())
    (folder.path / "stages" / "pretrain.json").unlink()
    for checkpoint in checkpoints(folder.encoder):
        checkpoint.write_bytes(b"damaged")
    file = prepare_encoder(folder, Listener())
    for name, value in load_encoder(file)[0].named_parameters():
        torch.testing.assert_close(value, evae.state_dict()[name], atol=1e-6, rtol=0)


def test_windows_of_so_many_events_need_a_recording_with_some(tmp_path):
    config = refreshing(tmp_path, None)
    config = dataclasses.replace(
        config,
        env=dataclasses.replace(config.env, camera=CameraConfig(contrast_threshold=10.0)),
        pretrain=dataclasses.replace(config.pretrain, windows="count"),
    )
    with pytest.raises(ConfigError, match=r"pretrain\.windows: count needs events, and none were recorded"):
        prepare_encoder(open_run(config), Listener())


def test_an_encoder_that_is_not_there_or_of_another_model_is_refused_before_anything_is_made(tmp_path):
    save_encoder(tmp_path / "encoder.safetensors", EventVAE(context=64, latent=32, target="signed"), {})
    rules = {
        str(tmp_path): r"must be a run folder with an encoder, or an encoder file, got .*cannot be read",
        str(tmp_path / "encoder.safetensors"): r"got context: 64 there, 32 here, target: 'signed' there",
    }
    for named, rule in rules.items():
        with pytest.raises(ConfigError, match=rf"pretrain\.encoder: .*{rule}"):
            run(refreshing(tmp_path, named, context=32))
    lean = tmp_path / "lean" / "encoder.safetensors"
    save_encoder(lean, EventVAE(context=64, latent=32, target="occupancy"), {}, lean=True)
    with pytest.raises(ConfigError, match=r"pretrain\.encoder: must have a decoder .*got .*lean"):
        run(refreshing(tmp_path, str(lean)))
    assert not (tmp_path / "runs").exists()


def test_a_policy_without_an_event_vae_has_nothing_to_pretrain(tmp_path):
    model = FixedModel(name="event_image", stack=3)
    config = dataclasses.replace(small_config(tmp_path), model=model)
    with pytest.raises(
        ConfigError, match="model: event_image has no event VAE to pretrain; go on with job=train"
    ):
        run(config)
    assert not (tmp_path / "runs").exists()  # refused before anything was made
    assert prepare_encoder(open_run(config), None) is None


def test_an_encoder_that_denoises_decodes_the_events_before_the_faults():
    noisy = EnvConfig(observation="events", faults=FaultsConfig(sparsity=0.5, background_activity=1.0))
    seen, true = record([(noisy, 300)], 0, lambda count: None, keep_true=True)
    rng = np.random.default_rng(0)
    windows = sample_windows(seen, SETTINGS, 200, rng)
    found = true_windows(true, windows, SETTINGS.window_events)
    for (events, start_us, window_us), (clean, begin_us, length_us) in zip(windows, found, strict=True):
        assert (start_us, window_us) == (begin_us, length_us)
        times = true.events["t"][(true.events["t"] > start_us) & (true.events["t"] <= start_us + window_us)]
        if len(events) == SETTINGS.window_events:  # the window begins with its oldest event
            times = times[times >= events["t"][0]]
        assert np.array_equal(clean["t"], times)
    plain, denoising = (trained(seen, 1, true=whole) for whole in (None, true))
    assert not torch.equal(plain.evae.decoder[0].weight, denoising.evae.decoder[0].weight)
