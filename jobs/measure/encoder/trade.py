"""What the event encoder's exactness costs, and what its code of time is worth.

Run: python -m platform.launch +exp=trade_encoder
Expect: about 20 minutes on one core beyond the run's own encoder, nearly all of it short trainings;
they are kept in the run folder, so that a killed job goes on. Two tables and their plots,
and plots of what the latent holds, in the run folder under `trade/` and in MLflow.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT
from envs.recordings import read_recording
from jobs.analysis.tables import publish_plot, publish_table, short, write_csv
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Count
from jobs.measure.encoder.costs import (
    EncodingCost,
    default_encodings,
    explained,
    measure_encodings,
    sized_encoding,
)
from jobs.measure.encoder.plots import plot_codings, plot_embedding, plot_encoding_costs, plot_pictures
from jobs.measure.encoder.trials import (
    DENSE_EVENTS,
    MAX_EVENTS,
    control_steps,
    draw,
    held_out,
    spread,
    trained,
)
from jobs.run.folder import Run, finish, locate_run, open_run
from jobs.run.progress import progress
from jobs.tracking.tracker import Tracker, open_tracker
from jobs.training.collect import data_file, record
from jobs.training.pretrain import check_sources, encoder_file, held_out_windows, prepare_encoder
from models.encoder.embedding import CODINGS
from models.encoder.evae import EventVAE, event_targets, pictures, reconstruct
from models.encoder.event_batch import EventBatch
from models.encoder.weights import load_encoder
from models.kinds import EncoderModel

EVENT_ENCODERS = ("bytestream", "bytestream_xy")
CONTEXTS = (128, 256, 512, 1024)
CODING_CONTEXT = 256  # nine trainings at 1024 would take an hour
OTHER_SCENES = ("cones", "gates", "texture_change")
PICTURES = 3  # of each condition, scene or pair
STEPS_BETWEEN = 7
SHOWN = ("sparse", "age over 0.9", "dense")
HEADINGS = (
    "Knob", "Setting", "Control step [us]", "2,000 events [us]", "Times faster",
    "Error, mean [% of sd]", "Error, largest [% of sd]", "Explained [%]",
)  # fmt: skip


@dataclass(frozen=True, config=STRICT)
class Settings:
    """How long the compared encoders are trained, and on how many windows they are measured."""

    iterations: Count
    seeds: Count
    windows: Annotated[int, Field(ge=4)]
    rounds: Count


def run(config: Config) -> dict[str, float]:
    """Train the run's encoder if there is none yet, then measure; return the metrics.

    Raises:
        ConfigError: The policy has no encoder that reads events one by one.
    """
    model = locate_run(config).config.model
    if model.name not in EVENT_ENCODERS:
        raise ConfigError(
            f"model: {model.name} has no encoder of single events; choose bytestream or bytestream_xy"
        )
    if isinstance(model, EncoderModel) and model.coding == "eventnet":
        raise ConfigError("model.coding: must be additive or none for this study, got 'eventnet'")
    check_sources(config)
    folder = open_run(config)
    config = folder.config
    with open_tracker(config, folder) as tracker:
        prepare_encoder(config, folder, tracker)
        evae, _ = load_encoder(encoder_file(folder))
        metrics = trade_inference(config, folder, tracker, evae)
        metrics |= trade_coding(config, folder, tracker)
        metrics |= show_latent(config, folder, tracker, evae)
        tracker.log(0, metrics)
    return finish(folder, "trade_encoder", metrics)


def trade_inference(config: Config, folder: Run, tracker: Tracker, evae: EventVAE) -> dict[str, float]:
    """Measure cost against error of every way to encode; return the metrics of the default."""
    trade = config.own
    models = [trained(config, folder, {"context": size}, 0) for size in CONTEXTS]
    validation = read_recording(data_file(folder, "validation"))
    usual = draw(config, validation, "mixed", MAX_EVENTS, trade.windows)
    dense = draw(config, validation, "count", DENSE_EVENTS, trade.windows)
    encodings = [*default_encodings(evae), *map(sized_encoding, models)]
    with progress("Measure encodings", len(encodings), "encodings") as advance:
        timed = control_steps(validation, trade.windows), dense
        rows = measure_encodings(encodings, usual, timed, trade.rounds, advance)
    lines = [cost_cells(row, rows[1].dense_us) for row in rows]
    title = "Encoding a window, one setting changed at a time"
    publish_table(folder, tracker, "trade/inference", title, HEADINGS, lines)
    tracker.table("trade/inference", cost_columns(rows))
    publish_plot(folder, tracker, "trade/inference", plot_encoding_costs(rows))
    write_csv(folder.path / "trade" / "inference.csv", EncodingCost._fields, rows)
    first, network = rows[:2]
    return {
        "perf/encode_step_us": first.step_us,
        "perf/encode_2000_events_us": first.dense_us,
        "perf/encode_times_faster_than_network": network.dense_us / first.dense_us,
        "evae/latent_error_max": first.error_max,
        "evae/latent_error_mean": first.error_mean,
    }


def trade_coding(config: Config, folder: Run, tracker: Tracker) -> dict[str, float]:
    """Train each coding of time side by side; return what each explains, as means over seeds."""
    trade = config.own
    validation = read_recording(data_file(folder, "validation"))
    shares: dict[str, dict[str, list[float]]] = {coding: {} for coding in CODINGS}
    models: dict[str, EventVAE] = {}
    for seed in range(trade.seeds):
        for coding in CODINGS:
            changes = {"variant": "bytestream", "context": CODING_CONTEXT, "coding": coding}
            evae = trained(config, folder, changes, seed)
            models.setdefault(coding, evae)
            conditions = held_out(config, validation, evae.grid, trade.windows)
            for name, batch in conditions.items():
                shares[coding].setdefault(name, []).append(explained(evae, batch))
    spreads = {
        coding: {name: spread(values) for name, values in own.items()} for coding, own in shares.items()
    }
    lines = [(coding, *map(percent, own.values())) for coding, own in spreads.items()]
    title = f"Explained [%] by coding of time, mean and 95 % interval over {trade.seeds} trainings"
    publish_table(folder, tracker, "trade/coding", title, ("Coding", *conditions), lines)
    publish_plot(folder, tracker, "trade/coding", plot_codings(spreads))
    rows = {name: side_by_side(models, conditions[name]) for name in SHOWN}
    publish_plot(folder, tracker, "trade/coding_pictures", plot_pictures(rows, ("events", *CODINGS) * 2))
    return {
        f"evae/explained_r2_{coding}_{name.replace(' ', '_')}": mean
        for coding, own in spreads.items()
        for name, (mean, _) in own.items()
    }


def show_latent(config: Config, folder: Run, tracker: Tracker, evae: EventVAE) -> dict[str, float]:
    """Draw the code of time, pictures between latents, and other scenes; return what is explained."""
    publish_plot(folder, tracker, "trade/embedding", plot_embedding())
    validation = read_recording(data_file(folder, "validation"))
    batch = held_out_windows(validation, config.pretrain, evae.grid)["four_steps"][0]
    heads = ("events", *(f"{share:.2f}" for share in np.linspace(0, 1, STEPS_BETWEEN)), "events")
    publish_plot(folder, tracker, "trade/interpolation", plot_pictures(between(evae, batch), heads))
    names = [*config.collect.scenes, *(Path(path).name for path in config.collect.recordings)]
    scenes = {" and ".join(names): batch}
    steps = 10 * config.own.windows
    with progress("Record other scenes", steps * len(OTHER_SCENES), "steps") as advance:
        for scene in OTHER_SCENES:
            world = dataclasses.replace(config.env, scene=scene, split="validation", observation="events")
            (recording,) = record([(world, steps)], config.seed, advance)
            scenes[scene] = held_out_windows(recording, config.pretrain, evae.grid)["four_steps"][0]
    shares = {scene: explained(evae, batch) for scene, batch in scenes.items()}
    rows = {
        f"{scene}\n{shares[scene]:.0%} explained": side_by_side({"": evae}, batch, PICTURES)
        for scene, batch in scenes.items()
    }
    publish_plot(folder, tracker, "trade/scenes", plot_pictures(rows, ("events", "decoded") * PICTURES))
    return {f"evae/explained_r2_in_{scene.replace(' ', '_')}": share for scene, share in shares.items()}


@torch.no_grad()
def side_by_side(models: Mapping[str, EventVAE], batch: EventBatch, count: int = 2) -> list[np.ndarray]:
    """Pictures of some windows, each followed by what each model decodes of it: (H, W) each."""
    places = np.argsort(-np.diff(batch.offsets), kind="stable")[: max(count, len(batch) // 2)]
    chosen = places[:: len(places) // count][:count]  # of the fuller half, from the fullest on
    first = next(iter(models.values()))
    parts = [pictures(event_targets(batch, first.target), first.target, batch.grid)]
    for evae in models.values():
        parts.append(pictures(reconstruct(evae(batch)[0], evae.target), evae.target, batch.grid))
    return [part[place].numpy() for place in chosen for part in parts]


@torch.no_grad()
def between(evae: EventVAE, batch: EventBatch) -> dict[str, list[np.ndarray]]:
    """For pairs of full windows whose latents lie far apart: pictures along the line between them."""
    mu, targets = evae(batch)[1], event_targets(batch, evae.target)
    full = np.argsort(-np.diff(batch.offsets), kind="stable")[:40]
    distance = torch.cdist(mu[full], mu[full]).numpy()
    rows = {}
    for pair in range(min(PICTURES, len(full) // 2)):
        ends = np.unravel_index(distance.argmax(), distance.shape)
        distance[list(ends)] = distance[:, list(ends)] = -1.0
        a, b = (int(full[end]) for end in ends)
        share = torch.linspace(0, 1, STEPS_BETWEEN)[:, None]
        way = reconstruct(evae.decoder(torch.lerp(mu[a], mu[b], share)), evae.target)
        shown = pictures(torch.cat([targets[a][None], way, targets[b][None]]), evae.target, batch.grid)
        rows[f"pair {pair + 1}"] = list(shown.numpy())
    return rows


def cost_cells(row: EncodingCost, network_us: float) -> tuple[str, ...]:
    """A text for each of `HEADINGS`; "times faster" refers to the network's cost of 2,000 events."""
    costs = f"{row.step_us:,.0f}", f"{row.dense_us:,.0f}", f"{network_us / row.dense_us:,.0f}"
    errors = short(100 * row.error_mean), short(100 * row.error_max)
    return (row.knob, row.setting, *costs, *errors, f"{100 * row.explained:.1f}")


def cost_columns(rows: Sequence[EncodingCost]) -> dict[str, list[str | float]]:
    """The columns of a tracker's table; the first is unique."""
    named: dict[str, list[str | float]] = {"form": [f"{row.knob} {row.setting}".strip() for row in rows]}
    return named | {name: [getattr(row, name) for row in rows] for name in EncodingCost._fields[2:]}


def percent(spread_of: tuple[float, float]) -> str:
    """A mean and half its interval in percent."""
    mean, half = spread_of
    return f"{100 * mean:.0f}" + ("" if np.isnan(half) else f" ± {100 * half:.0f}")
