"""Short trainings of event VAEs, and the held-out windows on which they are compared."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from envs.config import sensor_settings
from envs.recordings import Recording, read_recording
from jobs.config.config import Config
from jobs.run.folder import Run
from jobs.run.progress import progress
from jobs.training.collect import data_file
from jobs.training.pretrain import EvaeTraining, Window, cut_window, evae_settings, sample_windows
from models.encoder.evae import EventVAE
from models.encoder.weights import load_encoder, save_encoder
from models.kinds import EvaeSettings

MAX_EVENTS = 4096


def trained(config: Config, folder: Run, changes: Mapping[str, Any], seed: int) -> EventVAE:
    """A frozen event VAE after a short training with some settings of the model changed.

    The same seed gives the same windows, whatever is changed. A training that was finished
    before is read from the run folder.
    """
    settings = trial_settings(config, changes)
    iterations = config.own.iterations
    name = f"{settings.variant}-{settings.coding}-{settings.context}-s{seed}-{iterations}"
    file = folder.path / "trade" / "encoders" / f"{name}.safetensors"
    return kept(config, folder, file, settings, seed, iterations)


def trial_settings(config: Config, changes: Mapping[str, Any]) -> EvaeSettings:
    """The settings of the run's event VAE with some of them changed."""
    changed: EvaeSettings = dataclasses.replace(evae_settings(config), **changes)
    return changed


def kept(
    config: Config, folder: Run, file: Path, settings: EvaeSettings, seed: int, iterations: int
) -> EventVAE:
    """The frozen event VAE of a file, trained briefly on the run's recordings if it is not there yet."""
    if not file.with_suffix(".json").exists():
        train = read_recording(data_file(folder, "train"))
        evae = train_short(config, train, settings, seed, iterations, f"Train {file.stem}")
        sensor = sensor_settings(config.env)
        save_encoder(file, evae, {"sensor": sensor, "iterations": iterations})
    return load_encoder(file)[0]


def train_short(
    config: Config, train: Recording, settings: EvaeSettings, seed: int, iterations: int, title: str
) -> EventVAE:
    """Train for some iterations as `jobs.training.pretrain` does, without its checkpoints."""
    training = EvaeTraining.begin(settings, train, config.pretrain, (seed, 3))
    with progress(title, iterations, "iterations") as advance:
        for iteration in range(iterations):
            advance(1, note=f"loss {training.step(iteration)['loss']:.4f}")
    return training.evae.freeze()


def draw(
    config: Config, recording: Recording, windows: Literal["mixed", "count"], most_events: int, count: int
) -> list[Window]:
    """`count` fixed windows: "mixed" lengths, or "count", those of `most_events` events.

    At the end of an episode a window by count holds fewer; of four times as many the fullest are kept.
    """
    settings = dataclasses.replace(config.pretrain, windows=windows, window_events=most_events)
    rng = np.random.default_rng(1)
    if windows == "mixed":
        return sample_windows(recording, settings, count, rng)
    drawn = sample_windows(recording, settings, 4 * count, rng)
    return sorted(drawn, key=lambda window: -len(window[0]))[:count]


def control_steps(recording: Recording, count: int) -> list[Window]:
    """`count` fixed windows of one control step."""
    start, end = recording.index["step_t_us"], recording.index["step_end_us"]
    chosen = np.random.default_rng(1).choice(len(start), count)
    spans = [(int(start[step]), int(end[step] - start[step])) for step in chosen]
    return [cut_window(recording, first, span, MAX_EVENTS) for first, span in spans]
