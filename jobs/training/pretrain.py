"""Train the event VAE on recorded episodes and freeze its encoder (appendix B).

Run: python -m platform.launch +exp=pretrain
Expect: about 0.05 s per iteration of 50 windows on two cores; `encoder/encoder.safetensors`
with its manifest, and `encoder/reconstructions.png`, in the run folder. A killed run
continues from its last checkpoint.
"""

import copy
import dataclasses
import hashlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from envs.recordings import Recording, read_recording
from jobs.analysis.plots import plot_reconstructions
from jobs.config.config import Config, ConfigError
from jobs.config.errors import differences
from jobs.config.schema import PretrainConfig
from jobs.run.checkpoints import UNSEALED, damage
from jobs.run.files import RunError, write_atomic
from jobs.run.folder import Run, finish, finished, locate_run, open_run
from jobs.run.progress import console, progress
from jobs.run.torch_threads import torch_threads
from jobs.tracking.tracker import Tracker, open_tracker
from jobs.training.collect import PROXIMITY_ONE, check_collect, collect, data_file, learns_to_denoise
from jobs.training.ppo.gpu_steps import exact
from models.encoder.evae import (
    EventVAE,
    appendix_beta,
    collapsed,
    event_targets,
    pictures,
    reconstruct,
    train_step,
    validate,
)
from models.encoder.event_batch import EventBatch, Grid, batch_windows
from models.encoder.weights import EncoderFileError, load_encoder, save_encoder
from models.kinds import KINDS, EvaeSettings, PolicySpec

Window = tuple[np.ndarray, int, int]  # events, start_us, window_us
HeldOut = dict[str, tuple[EventBatch, Tensor]]  # windows by their length, with the decoder's targets

ENCODER, CHECKPOINTS = "encoder.safetensors", "checkpoint-*.pt"
# Fixed, so that the number of cores changes no byte. A bytestream's encoder has the same bytes with 1 thread.
THREADS = 2
CHECKPOINTS_KEPT = 2  # the second serves if the newest is damaged
MIN_STEPS, MAX_STEPS = 0.5, 8.0
VALIDATION_WINDOWS = 200
PICTURE_WINDOWS = 8
MANY = 10**9  # events
NEVER_US = 1 << 62  # start of the episode after the last one
COLLAPSED = (
    "the latent says nothing of its window (posterior collapse), a policy would see nothing; "
    "if more iterations do not help, take a smaller pretrain.beta or pretrain.beta_schedule=constant"
)


def run(config: Config) -> dict[str, float]:
    """Collect data if there is none yet, then train the event VAE; return its metrics.

    Raises:
        ConfigError: The policy has no event VAE, or `check_sources` fails.
    """
    name = locate_run(config).config.model.name
    if not KINDS[name].encoder:
        raise ConfigError(f"model: {name} has no event VAE to pretrain; go on with job=train")
    check_sources(config)
    folder = open_run(config)
    with open_tracker(folder.config, folder) as tracker:
        prepare_encoder(folder, tracker)
    return finished(folder, "pretrain") or {}


def check_sources(config: Config) -> None:
    """Check the input files of collecting and pretraining, and the GPU, before the run writes anything.

    Raises:
        ConfigError: `collect.policy`, `collect.recordings` or `pretrain.encoder` names a file that does not
            fit; or torch sees no GPU for `cluster.device=cuda`.
    """
    if config.cluster.device == "cuda" and not torch.cuda.is_available():
        rule = "cuda needs a GPU and a build of torch with CUDA, and torch sees no GPU here; take cpu"
        raise ConfigError(f"cluster.device: {rule}, got 'cuda'")
    folder = locate_run(config)
    if KINDS[folder.config.model.name].encoder:
        check_collect(folder)
        initial_state(folder)


def initial_state(folder: Run) -> dict[str, torch.Tensor] | None:
    """Return the initial weights of a run's event VAE; None for random ones, or if training has started.

    Raises:
        ConfigError: `pretrain.encoder` names no encoder, or one with other settings or without a decoder.
    """
    named, config = folder.config.pretrain.encoder, folder.config
    if named is None or checkpoints(folder.encoder) or finished(folder, "pretrain") is not None:
        return None
    path = Path(named)
    file = path if path.suffix == ".safetensors" else path / "encoder" / ENCODER
    try:
        evae, _ = load_encoder(file)
    except EncoderFileError as error:
        rule = f"must be a run folder with an encoder, or an encoder file, got {named!r}"
        raise ConfigError(f"pretrain.encoder: {rule}: {error}") from error
    differ = differences(dataclasses.asdict(evae.settings), dataclasses.asdict(evae_settings(config)))
    if differ:
        raise ConfigError(f"pretrain.encoder: must have the settings of the model, got {differ}")
    if evae.decoder is None:
        rule = "must have a decoder to learn on; a shipped policy's has none, its run folder's has"
        raise ConfigError(f"pretrain.encoder: {rule}, got {named!r}")
    return evae.state_dict()


def prepare_encoder(folder: Run, tracker: Tracker) -> Path | None:
    """Collect and pretrain if not done yet; return the encoder file, None for a policy without an encoder."""
    if not KINDS[folder.config.model.name].encoder:
        return None
    collect(folder, tracker)
    pretrain(folder, tracker)
    return encoder_file(folder)


def pretrain(folder: Run, tracker: Tracker) -> dict[str, float]:
    """Train an event VAE on the run's recordings and write its encoder file."""
    done = finished(folder, "pretrain")
    if done is not None:
        return done
    config, settings = folder.config, folder.config.pretrain
    check_data(folder)
    (train, true), (validation, validation_true) = (
        read_split(folder, split, learns_to_denoise(config)) for split in ("train", "validation")
    )
    seed, device = (config.seed, 2), config.cluster.device
    training = EvaeTraining(evae_settings(config), train, settings, seed, true, device)
    evae, first = training.evae, restore(folder.encoder, training)
    begin = initial_state(folder)  # None if a checkpoint was restored; `restore` has deleted damaged ones
    if begin is not None:
        evae.load_state_dict(begin)
    held_out = held_out_windows(validation, settings, evae.settings, validation_true)
    latest: dict[str, float] = {}
    title = "Pretrain the event VAE"
    with (
        torch_threads(THREADS),
        exact(),
        progress(title, settings.iterations, "iterations", done=first) as advance,
    ):
        for iteration in range(first, settings.iterations):
            losses = training.step(iteration)
            last = iteration + 1 == settings.iterations
            if last or (iteration + 1) % settings.validate_every == 0:
                before, latest = latest, held_out_figures(on_processor(evae), held_out)
                if latest["collapsed"] > before.get("collapsed", 0.0):
                    console.print(f"Iteration {iteration + 1}: {COLLAPSED}")
                tracker.log(
                    iteration + 1, {f"evae/{name}": value for name, value in {**losses, **latest}.items()}
                )
            if last or (iteration + 1) % settings.checkpoint_every == 0:
                save_checkpoint(folder.encoder, training, iteration + 1)
            measured = f", held out {latest['explained_loss_step']:.0%} explained" if latest else ""
            advance(1, note=f"loss {losses['loss']:.4f}{measured}")
    return freeze(folder, tracker, on_processor(evae), train.about, held_out)


def read_split(folder: Run, split: str, denoise: bool) -> tuple[Recording, Recording | None]:
    """Return the recording of a split and, with `denoise`, its events before the faults (else None)."""
    seen = read_recording(data_file(folder, split))
    return seen, read_recording(data_file(folder, f"{split}_true")) if denoise else None


def check_data(folder: Run) -> None:
    """Check that a run's recordings are unchanged since they were collected.

    Raises:
        RunError: A file is damaged.
    """
    reason = damage(folder.data)
    if reason not in (None, UNSEALED):  # older versions did not seal them
        marker = folder.path / "stages" / "collect.json"
        raise RunError(
            f"{folder.data}: damaged ({reason}); delete {marker}, and the same command collects again"
        )


class EvaeTraining:
    """An event VAE in training; each step changes the model, the optimiser and the generator.

    Attributes:
        evae: The model.
        optimizer: Adam over the model's parameters.
        recording: Recording from which windows are sampled.
        true: Recording of the same time from which the targets are made; None: the sampled windows.
        settings: Settings of the pretraining.
        rng: Draws the windows and the noise of the latent.
    """

    def __init__(
        self,
        model: EvaeSettings,
        recording: Recording,
        settings: PretrainConfig,
        seed: tuple[int, int],
        true: Recording | None = None,
        device: str = "cpu",
    ) -> None:
        """Start from random weights; `seed` is the experiment's seed and the number of the random stream.

        Initial weights and windows are the same on every torch `device`.

        Raises:
            ConfigError: `pretrain.windows` is "count" and the recording has no events.
        """
        if settings.windows == "count" and not len(recording.events):
            rule = (
                "count needs events, and none were recorded; lower camera.contrast_threshold, or take mixed"
            )
            raise ConfigError(f"pretrain.windows: {rule}")
        torch.manual_seed(seed[0])
        self.evae = EventVAE.of(model).to(device)
        self.optimizer = torch.optim.Adam(
            self.evae.parameters(), lr=settings.lr, weight_decay=settings.weight_decay, fused=True
        )
        self.recording, self.true, self.settings = recording, true, settings
        self.rng = np.random.default_rng(np.random.SeedSequence(seed))

    def step(self, iteration: int) -> dict[str, float]:
        """Take one update on a batch of sampled windows; return the losses of `train_step`."""
        evae, settings = self.evae.train(), self.settings
        windows = sample_windows(self.recording, settings, settings.batch_windows, self.rng)
        batch = batch_windows(windows, evae.grid)
        seen = self.recording, windows, batch
        targets = decoded(evae.target, *seen, self.true, settings.window_events)
        targets = targets.to(evae.decoder[0].weight.device)
        return train_step(evae, self.optimizer, batch, targets, beta(settings, iteration), self.rng)


def on_processor(evae: EventVAE) -> EventVAE:
    """Return the model on the CPU: itself, or a copy if it is on a GPU."""
    return evae if evae.decoder[0].weight.device.type == "cpu" else copy.deepcopy(evae).cpu()


def evae_settings(config: Config) -> EvaeSettings:
    """Return the settings of an experiment's event VAE."""
    camera = config.env.camera
    return PolicySpec(config.model, camera.width, camera.height).evae


def beta(settings: PretrainConfig, iteration: int) -> float:
    """Return the weight of the KL divergence at an iteration (appendix B.2, or a constant)."""
    if settings.beta_schedule == "appendix":
        return appendix_beta(iteration)
    return settings.beta


def sample_windows(
    recording: Recording, settings: PretrainConfig, count: int, rng: np.random.Generator
) -> list[Window]:
    """Draw event windows that never cross from one episode into the next.

    "count" windows have `window_events` events, starting at a random index (appendix B.2). "mixed"
    windows last between half a control step and eight, so that the encoder learns the short,
    sparse and empty windows of any control rate as well as long ones.

    Returns:
        (events, start_us, window_us) each; every event has start_us < t <= start_us + window_us.
    """
    draw = _window_by_count if settings.windows == "count" else _window_by_time
    return [draw(recording, settings.window_events, rng) for _ in range(count)]


def _window_by_time(recording: Recording, most_events: int, rng: np.random.Generator) -> Window:
    start, end, episode = (recording.index[name] for name in ("step_t_us", "step_end_us", "step_flight"))
    step = int(rng.integers(len(start)))
    period_us = int(end[step] - start[step])
    first, last = (int(np.searchsorted(episode, episode[step], side)) for side in ("left", "right"))
    begin_us, end_us = int(start[first]), int(end[last - 1])
    ratio = np.exp(rng.uniform(np.log(MIN_STEPS), np.log(MAX_STEPS)))
    window_us = min(max(1, round(period_us * ratio)), end_us - begin_us)
    start_us = int(start[step]) + int(rng.integers(period_us))
    start_us = max(min(start_us, end_us - window_us), begin_us)
    return cut_window(recording, start_us, window_us, most_events)


def _window_by_count(recording: Recording, num_events: int, rng: np.random.Generator) -> Window:
    t_us, start, episode = recording.events["t"], recording.index["step_t_us"], recording.index["step_flight"]
    first = int(rng.integers(len(t_us)))
    step = int(np.searchsorted(start, t_us[first], side="left")) - 1
    last_step = int(np.searchsorted(episode, episode[step], side="right")) - 1
    episode_end = recording.count_until(int(recording.index["step_end_us"][last_step]))
    stop = min(first + num_events, episode_end)
    start_us = int(t_us[first]) - 1
    return recording.events[first:stop], start_us, int(t_us[stop - 1]) - start_us


def cut_window(recording: Recording, start_us: int, window_us: int, most_events: int) -> Window:
    """Return the newest `most_events` of the events with start_us < t <= start_us + window_us."""
    first, stop = (recording.count_until(t_us) for t_us in (start_us, start_us + window_us))
    return recording.events[max(first, stop - most_events) : stop], start_us, window_us


def true_windows(true: Recording, windows: Sequence[Window], most_events: int) -> list[Window]:
    """Return the events of a recording in the time of given windows.

    A window with `most_events` was cut to its newest events, so its time starts at its first event.
    """
    found = []
    for events, start_us, window_us in windows:
        first_us = start_us if len(events) < most_events else int(events["t"][0]) - 1
        cut, _, _ = cut_window(true, first_us, start_us + window_us - first_us, MANY)
        found.append((cut, start_us, window_us))
    return found


def decoded(
    target: str,
    recording: Recording,
    windows: Sequence[Window],
    batch: EventBatch,
    true: Recording | None,
    most_events: int,
) -> Tensor:
    """Return the decoder's targets of windows, float32 (B, outputs): recorded proximity or `event_targets`.

    Args:
        target: Target of the model. "proximity" is recorded at the end of each control step; a window gets
            the value nearest to its end.
        recording: Recording from which the windows were cut.
        windows: The windows.
        batch: The same windows as a batch.
        true: Recording of the same time from which pictures are made; None: the windows themselves.
        most_events: Largest number of events in a window.
    """
    if target == "proximity":
        if "step_proximity" not in recording.index:
            rule = "proximity needs recordings that hold it; collect anew with model.target=proximity"
            raise ConfigError(f"model.target: {rule}")
        ends_us = np.array([start_us + window_us for _, start_us, window_us in windows], np.int64)
        steps_us = recording.index["step_end_us"]
        after = np.searchsorted(steps_us, ends_us).clip(1, len(steps_us) - 1)
        nearest = after - (ends_us - steps_us[after - 1] < steps_us[after] - ends_us)
        proximity = recording.index["step_proximity"].reshape(len(steps_us), -1)[nearest]
        return torch.from_numpy(proximity.astype(np.float32) / np.float32(PROXIMITY_ONE))
    if true is not None:
        batch = batch_windows(true_windows(true, windows, most_events), batch.grid)
    return event_targets(batch, target)


def held_out_windows(
    recording: Recording, settings: PretrainConfig, model: EvaeSettings, true: Recording | None = None
) -> HeldOut:
    """Return fixed windows of unseen episodes, one and four control steps long, with their targets."""
    rng = np.random.default_rng(0)
    start, end, episode = (recording.index[name] for name in ("step_t_us", "step_end_us", "step_flight"))
    following = np.searchsorted(episode, episode, side="right")  # the first step of the next episode
    room = np.append(start, NEVER_US)[following] - start
    windows: HeldOut = {}
    for name, steps in (("step", 1), ("four_steps", 4)):
        chosen = rng.choice(len(start), VALIDATION_WINDOWS)
        lengths = np.minimum(steps * (end - start), room)
        spans = [(int(start[step]), int(lengths[step])) for step in chosen]
        cut = [cut_window(recording, begin, span, settings.window_events) for begin, span in spans]
        batch = batch_windows(cut, Grid(model.width, model.height, model.time_bins))
        targets = decoded(model.target, recording, cut, batch, true, settings.window_events)
        windows[name] = batch, targets
    return windows


def held_out_figures(evae: EventVAE, held_out: HeldOut) -> dict[str, float]:
    """Return the metrics of `evae.validate` per window length; `collapsed` is 1 if all lengths collapsed."""
    evae.eval()
    found = {name: validate(evae, batch, targets) for name, (batch, targets) in held_out.items()}
    figures = {
        f"{key}_{name}": value
        for name, values in found.items()
        for key, value in values.items()
        if key != "mean_picture"
    }
    return figures | {"collapsed": float(all(map(collapsed, found.values())))}


def freeze(
    folder: Run, tracker: Tracker, evae: EventVAE, about: Mapping[str, object], held_out: HeldOut
) -> dict[str, float]:
    """Write the encoder file and a picture of its reconstructions; return its held-out metrics."""
    figures = held_out_figures(evae, held_out)
    manifest = {
        **{name: about[name] for name in ("sensor", "sensor_hash", "scenes")},
        "iterations": folder.config.pretrain.iterations,
        "figures": figures,
    }
    save_encoder(encoder_file(folder), evae, manifest)
    tracker.artifact(encoder_file(folder).with_suffix(".json"), "encoder")
    figure = plot_reconstructions(*example_pictures(evae, held_out))
    tracker.figure("evae/reconstructions.png", figure)
    return finish(folder, "pretrain", figures)


@torch.no_grad()
def example_pictures(evae: EventVAE, held_out: HeldOut) -> tuple[np.ndarray, np.ndarray]:
    """Return target pictures and their reconstructions, the first few of each length: (K, H, W) each."""
    targets = [own[:PICTURE_WINDOWS] for _, own in held_out.values()]
    drawn = [reconstruct(evae(batch)[0], evae.target)[:PICTURE_WINDOWS] for batch, _ in held_out.values()]
    shown = [pictures(torch.cat(values), evae.target, evae.grid).numpy() for values in (targets, drawn)]
    return shown[0], shown[1]


def encoder_file(folder: Run) -> Path:
    """Return the path of the frozen encoder in a run folder."""
    return folder.encoder / ENCODER


def checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints of a pretraining, newest first."""
    return sorted(folder.glob(CHECKPOINTS), reverse=True)


def save_checkpoint(folder: Path, training: EvaeTraining, iteration: int) -> None:
    """Write everything that a killed training needs to resume; the file's name contains its SHA-256."""
    state = {
        "evae": training.evae.state_dict(),
        "optimizer": training.optimizer.state_dict(),
        "rng": training.rng.bit_generator.state,
        "torch_rng": torch.get_rng_state(),
        "iteration": iteration,
    }
    buffer = io.BytesIO()
    torch.save(state, buffer)
    content = buffer.getvalue()
    write_atomic(folder / f"checkpoint-{iteration:09d}-{hashlib.sha256(content).hexdigest()}.pt", content)
    for old in checkpoints(folder)[CHECKPOINTS_KEPT:]:
        old.unlink()


def restore(folder: Path, training: EvaeTraining) -> int:
    """Load the newest undamaged checkpoint; return the number of iterations done, 0 without a checkpoint."""
    for path in checkpoints(folder):
        content = path.read_bytes()
        if hashlib.sha256(content).hexdigest() != path.stem.rpartition("-")[2]:
            console.print(f"Checkpoint damaged, the one before it is taken: {path}")
            path.unlink()
            continue
        state = torch.load(io.BytesIO(content), weights_only=True, map_location="cpu")
        training.evae.load_state_dict(state["evae"])
        training.optimizer.load_state_dict(state["optimizer"])
        training.rng.bit_generator.state = state["rng"]
        torch.set_rng_state(state["torch_rng"])
        return int(state["iteration"])
    return 0
