"""Short trainings of the event VAE side by side, and the held-out windows they are compared on."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from envs.config import sensor_settings
from envs.recordings import Recording, read_recording
from jobs.analysis.statistics import half_width
from jobs.config.config import Config
from jobs.run.folder import Run
from jobs.run.progress import progress
from jobs.training.collect import data_file
from jobs.training.pretrain import EvaeTraining, Window, cut_window, evae_settings, sample_windows
from models.encoder.evae import EventVAE
from models.encoder.event_batch import EventBatch, Grid, batch_windows
from models.encoder.weights import load_encoder, save_encoder
from models.kinds import EvaeSettings

MAX_EVENTS, DENSE_EVENTS, SPARSE_EVENTS = 4096, 2000, 200
OLDER_THAN = (0.5, 0.8, 0.9)
NEWEST = 0.2


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


def held_out(config: Config, recording: Recording, grid: Grid, count: int) -> dict[str, EventBatch]:
    """`count` windows for each condition under which codings of time are compared.

    "usual": of all lengths, as in training; "sparse" and "dense": of 200 and 2,000 events; then
    the dense ones with their ages squeezed into the oldest or newest part of the window.
    """
    drawn = {
        "usual": draw(config, recording, "mixed", MAX_EVENTS, count),
        "sparse": draw(config, recording, "count", SPARSE_EVENTS, count),
        "dense": draw(config, recording, "count", DENSE_EVENTS, count),
    }
    batches = {name: batch_windows(windows, grid) for name, windows in drawn.items()}
    for age in OLDER_THAN:
        batches[f"age over {age:g}"] = squeezed(batches["dense"], age, 1.0)
    return batches | {"newest fifth": squeezed(batches["dense"], 0.0, NEWEST)}


def squeezed(batch: EventBatch, youngest: float, oldest: float) -> EventBatch:
    """The same events in the same order, their ages 0..1 squeezed linearly to `youngest`..`oldest`."""
    bins = batch.grid.time_bins
    age = 1.0 - (batch.bin + 0.5) / bins
    times = 1.0 - (youngest + age * (oldest - youngest))
    return dataclasses.replace(batch, bin=np.clip(times * bins, 0, bins - 1).astype(np.int32))


def spread(values: Sequence[float]) -> tuple[float, float]:
    """Mean, and half the width of its 95 % interval (Student's t); NaN for a single value."""
    half = float(half_width(np.array(values))) if len(values) > 1 else float("nan")
    return float(np.mean(values)), half
