"""Compare codings of time and sizes of the context in the event encoder, and draw what its latent contains.

Run: python -m platform.launch +exp=codings
Expect: about 20 minutes on one core after the run's encoder is trained, mostly for thirteen short trainings.
Finished trainings are stored in the run folder, so an interrupted command resumes. A table and plots are in
the run folder under `trade/`, and in MLflow.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from matplotlib.figure import Figure
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT
from envs.recordings import Recording, read_recording
from jobs.analysis.colours import COLOURS, GRID, INK, MUTED
from jobs.analysis.plots import EVENT_COLOURS, tidy
from jobs.analysis.statistics import half_width
from jobs.analysis.tables import publish_plot, publish_table, write_csv
from jobs.config.config import Config
from jobs.config.schema import Count
from jobs.measure.encodings import (
    COST_FIELDS,
    Encoding,
    cost_values,
    default_encodings,
    encode_whole,
    explained,
    measure_encodings,
)
from jobs.measure.plots import plot_encoding_costs
from jobs.measure.trade_encoder import DENSE_EVENTS, HEADINGS, MAX_EVENTS, control_steps, cost_cells, draw
from jobs.run.folder import Run, finish, open_run
from jobs.run.progress import progress
from jobs.tracking.tracker import Tracker, open_tracker
from jobs.training.collect import check_pictures, data_file, record
from jobs.training.pretrain import encoder_file, held_out_windows, prepare_encoder
from models.encoder.embedding import CODINGS, temporal_embedding
from models.encoder.evae import EventVAE, event_targets, pictures, reconstruct
from models.encoder.event_batch import EventBatch, Grid, batch_windows
from models.encoder.table import EncoderTable
from models.encoder.weights import load_encoder
from research.trials import trained

CONTEXTS = (128, 256, 512, 1024)
CODING_CONTEXT = 256  # nine trainings at 1024 would take an hour
OTHER_SCENES = ("cones", "gates", "texture_change")
PICTURES = 3  # per condition, scene or pair
STEPS_BETWEEN = 7
SHOWN = ("sparse", "age over 0.9", "dense")
SPARSE_EVENTS = 200
OLDER_THAN = (0.5, 0.8, 0.9)
NEWEST = 0.2


@dataclass(frozen=True, config=STRICT)
class Settings:
    """Settings of the compared encoders: length of the trainings, and number of windows to measure."""

    iterations: Count
    seeds: Count
    windows: Annotated[int, Field(ge=4)]
    rounds: Count


def run(config: Config) -> dict[str, float]:
    """Train the encoder of the run if there is none yet, then compare codings; return the metrics."""
    check_pictures(config)
    folder = open_run(config)
    with open_tracker(folder.config, folder) as tracker:
        prepare_encoder(folder, tracker)
        evae, _ = load_encoder(encoder_file(folder))
        metrics = trade_coding(folder, tracker) | show_latent(folder, tracker, evae)
        trade_contexts(folder, tracker, evae)
        tracker.log(0, metrics)
    return finish(folder, "codings", metrics)


def trade_contexts(folder: Run, tracker: Tracker, evae: EventVAE) -> None:
    """Train each size of the context briefly, and measure these encodings together with those of the run."""
    config = folder.config
    models = [trained(folder, {"context": size}, 0) for size in CONTEXTS]
    validation = read_recording(data_file(folder, "validation"))
    count = config.own.windows
    usual = draw(config, validation, "mixed", MAX_EVENTS, count)
    dense = draw(config, validation, "count", DENSE_EVENTS, count)
    encodings = [*default_encodings(evae), *map(sized_encoding, models)]
    with progress("Measure encodings", len(encodings), "encodings") as advance:
        timed = control_steps(validation, count), dense
        rows = measure_encodings(encodings, usual, timed, config.own.rounds, advance)
    lines = [cost_cells(row, rows[1].cost_us) for row in rows]
    publish_table(folder, tracker, "trade/contexts", "Encoding a window", HEADINGS, lines)
    publish_plot(folder, tracker, "trade/contexts", plot_encoding_costs(rows))
    write_csv(folder.path / "trade" / "contexts.csv", COST_FIELDS, [cost_values(row) for row in rows])


def sized_encoding(evae: EventVAE) -> Encoding:
    """Return the encoding by the table of a model with another context size."""
    return Encoding("context", str(evae.settings.context), encode_whole(EncoderTable.from_evae(evae)), evae)


def trade_coding(folder: Run, tracker: Tracker) -> dict[str, float]:
    """Train each coding of time with the same seeds; return the share that each explains, mean over seeds."""
    config, trade = folder.config, folder.config.own
    validation = read_recording(data_file(folder, "validation"))
    shares: dict[str, dict[str, list[float]]] = {coding: {} for coding in CODINGS}
    models: dict[str, EventVAE] = {}
    for seed in range(trade.seeds):
        for coding in CODINGS:
            changes = {"variant": "bytestream", "context": CODING_CONTEXT, "coding": coding}
            evae = trained(folder, changes, seed)
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


def show_latent(folder: Run, tracker: Tracker, evae: EventVAE) -> dict[str, float]:
    """Draw the code of time, pictures between latents and other scenes; return explained shares per scene."""
    config = folder.config
    publish_plot(folder, tracker, "trade/embedding", plot_embedding())
    validation = read_recording(data_file(folder, "validation"))
    batch = held_out_windows(validation, config.pretrain, evae.settings)["four_steps"][0]
    heads = ("events", *(f"{share:.2f}" for share in np.linspace(0, 1, STEPS_BETWEEN)), "events")
    publish_plot(folder, tracker, "trade/interpolation", plot_pictures(between(evae, batch), heads))
    names = [*config.collect.scenes, *(Path(path).name for path in config.collect.recordings)]
    scenes = {" and ".join(names): batch}
    steps = 10 * config.own.windows
    with progress("Record other scenes", steps * len(OTHER_SCENES), "steps") as advance:
        for scene in OTHER_SCENES:
            world = dataclasses.replace(config.env, scene=scene, split="validation", observation="events")
            (recording,) = record([(world, steps)], config.seed, advance)
            scenes[scene] = held_out_windows(recording, config.pretrain, evae.settings)["four_steps"][0]
    shares = {scene: explained(evae, batch) for scene, batch in scenes.items()}
    rows = {
        f"{scene}\n{shares[scene]:.0%} explained": side_by_side({"": evae}, batch, PICTURES)
        for scene, batch in scenes.items()
    }
    publish_plot(folder, tracker, "trade/scenes", plot_pictures(rows, ("events", "decoded") * PICTURES))
    return {f"evae/explained_r2_in_{scene.replace(' ', '_')}": share for scene, share in shares.items()}


def held_out(config: Config, recording: Recording, grid: Grid, count: int) -> dict[str, EventBatch]:
    """Return `count` windows for each condition under which codings of time are compared.

    "usual": windows of all lengths, as in training; "sparse" and "dense": windows of 200 and 2,000 events;
    "age over" and "newest fifth": dense windows with ages squeezed into the oldest or newest part.
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
    """Return the same events in the same order, with ages 0..1 scaled linearly to `youngest`..`oldest`."""
    bins = batch.grid.time_bins
    age = 1.0 - (batch.bin + 0.5) / bins
    times = 1.0 - (youngest + age * (oldest - youngest))
    return dataclasses.replace(batch, bin=np.clip(times * bins, 0, bins - 1).astype(np.int32))


def spread(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean, and half the width of its 95 % interval (Student's t); NaN for a single value."""
    half = float(half_width(np.array(values))) if len(values) > 1 else float("nan")
    return float(np.mean(values)), half


def percent(spread_of: tuple[float, float]) -> str:
    """Return a mean and half its interval as text in percent."""
    mean, half = spread_of
    return f"{100 * mean:.0f}" + ("" if np.isnan(half) else f" ± {100 * half:.0f}")


@torch.no_grad()
def side_by_side(models: Mapping[str, EventVAE], batch: EventBatch, count: int = 2) -> list[np.ndarray]:
    """Return pictures (H, W) of some windows, each followed by the decoded picture of every model."""
    places = np.argsort(-np.diff(batch.offsets), kind="stable")[: max(count, len(batch) // 2)]
    chosen = places[:: len(places) // count][:count]  # from the half with more events, in falling order
    first = next(iter(models.values()))
    parts = [pictures(event_targets(batch, first.target), first.target, batch.grid)]
    for evae in models.values():
        parts.append(pictures(reconstruct(evae(batch)[0], evae.target), evae.target, batch.grid))
    return [part[place].numpy() for place in chosen for part in parts]


@torch.no_grad()
def between(evae: EventVAE, batch: EventBatch) -> dict[str, list[np.ndarray]]:
    """Return pictures along the line between latents, for pairs of full windows with distant latents."""
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


def plot_codings(spreads: Mapping[str, Mapping[str, tuple[float, float]]]) -> Figure:
    """Draw the explained share (mean, half interval) of each coding under each condition."""
    figure = Figure(figsize=(8.8, 4.2), layout="constrained")
    panel = figure.subplots()
    for shift, (coding, own) in zip((-0.16, 0.0, 0.16), spreads.items(), strict=False):
        means, halves = 100 * np.array(list(own.values())).T
        x = np.arange(len(means)) + shift
        panel.errorbar(
            x,
            means,
            yerr=np.nan_to_num(halves),
            label=coding,
            fmt="o",
            ms=6,
            capsize=4,
            color=COLOURS[coding],
        )
        panel.set_xticks(np.arange(len(means)), list(own))
    panel.axhline(0, color=MUTED, lw=0.8)
    panel.set_ylabel("Explained of held-out pictures [%]")
    tidy(panel, "y")
    panel.legend(frameon=False, title="coding of time")
    return figure


def plot_embedding(context: int = 1024, times: int = 400) -> Figure:
    """Draw the code of each time of a window, as in the paper's figure 6, and some features over time."""
    figure = Figure(figsize=(11.0, 4.0), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.6, 1))
    t = (np.arange(times) + 0.5) / times
    code = temporal_embedding(t, context)
    image = left.imshow(code, aspect="auto", extent=(0, context, 1, 0), cmap="RdBu_r", vmin=-1, vmax=1)
    figure.colorbar(image, ax=left)
    left.set(xlabel="Feature (sines, then cosines)", ylabel="Time in the window")
    left.set_title("Additive code", loc="left", fontsize=10)
    for place, colour in ((0, "#93c5fd"), (context // 4, "#3b82f6"), (context // 2 - 1, "#1e3a8a")):
        right.plot(t, code[:, place], color=colour, label=f"additive, feature {place}")
    right.plot(t, t - 1, color=COLOURS["eventnet"], lw=2, label="eventnet, all features")
    right.set(xlabel="Time in the window", ylim=(-1.1, 1.9))
    right.set_title("Added to a feature", loc="left", fontsize=10)
    right.legend(frameon=False, fontsize=8, loc="upper right")
    right.spines[["top", "right"]].set_visible(False)
    return figure


def plot_pictures(rows: Mapping[str, Sequence[np.ndarray]], heads: Sequence[str]) -> Figure:
    """Draw event pictures (H, W) in [-1, 1] in labelled rows, under the headings of their columns."""
    figure = Figure(figsize=(1.25 * len(heads) + 0.6, 1.3 * len(rows) + 0.3), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02)  # type: ignore[union-attr, call-arg]
    panels = figure.subplots(len(rows), len(heads), squeeze=False)
    for line, (name, shown) in zip(panels, rows.items(), strict=True):
        line[0].set_ylabel(name, color=INK, fontsize=9)
        for panel, picture in zip(line, shown, strict=True):
            panel.imshow(picture, cmap=EVENT_COLOURS, vmin=-1, vmax=1, interpolation="nearest")
    for panel, head in zip(panels[0], heads, strict=True):
        panel.set_title(head, color=INK, fontsize=9)
    for panel in panels.flat:
        panel.set(xticks=[], yticks=[])
        panel.spines[:].set_color(GRID)
    return figure
