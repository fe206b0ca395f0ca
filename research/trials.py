"""Short trainings of event VAEs on the recordings of a run."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from envs.config import sensor_settings
from envs.recordings import Recording, read_recording
from jobs.config.config import Config
from jobs.run.folder import Run
from jobs.run.progress import progress
from jobs.training.collect import data_file
from jobs.training.pretrain import EvaeTraining, evae_settings
from models.encoder.evae import EventVAE
from models.encoder.weights import load_encoder, save_encoder
from models.kinds import EvaeSettings

MAX_EVENTS = 4096


def trained(folder: Run, changes: Mapping[str, Any], seed: int) -> EventVAE:
    """Return a frozen event VAE after a short training with some settings of the model changed.

    The same seed gives the same windows, whatever is changed. A finished training is read from the
    run folder.
    """
    config = folder.config
    settings = trial_settings(config, changes)
    iterations = config.own.iterations
    name = f"{settings.variant}-{settings.coding}-{settings.context}-s{seed}-{iterations}"
    file = folder.path / "trade" / "encoders" / f"{name}.safetensors"
    return kept(folder, file, settings, seed, iterations)


def trial_settings(config: Config, changes: Mapping[str, Any]) -> EvaeSettings:
    """Return the settings of the run's event VAE with some of them changed."""
    changed: EvaeSettings = dataclasses.replace(evae_settings(config), **changes)
    return changed


def kept(folder: Run, file: Path, settings: EvaeSettings, seed: int, iterations: int) -> EventVAE:
    """Return the frozen event VAE of a file; if it is missing, train it briefly on the run's recordings."""
    config = folder.config
    if not file.with_suffix(".json").exists():
        train = read_recording(data_file(folder, "train"))
        evae = train_short(config, train, settings, seed, iterations, f"Train {file.stem}")
        sensor = sensor_settings(config.env)
        save_encoder(file, evae, {"sensor": sensor, "iterations": iterations})
    return load_encoder(file)[0]


def train_short(
    config: Config, train: Recording, settings: EvaeSettings, seed: int, iterations: int, title: str
) -> EventVAE:
    """Return a frozen event VAE trained as in `jobs.training.pretrain`, without checkpoints."""
    training = EvaeTraining(settings, train, config.pretrain, (seed, 3))
    with progress(title, iterations, "iterations") as advance:
        for iteration in range(iterations):
            advance(1, note=f"loss {training.step(iteration)['loss']:.4f}")
    return training.evae.freeze()
