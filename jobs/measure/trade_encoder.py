"""Measure what accuracy of the event encoder costs.

Run: python -m platform.launch +exp=trade_encoder
Expect: a minute on one core, plus the training of the run's encoder. A table and its plot, in the run folder
under `trade/` and in MLflow.
"""

import dataclasses
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT
from envs.recordings import Recording, read_recording
from jobs.analysis.tables import publish_plot, publish_table, short, write_csv
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Count
from jobs.measure.encodings import (
    COST_FIELDS,
    cost_values,
    default_encodings,
    measure_encodings,
)
from jobs.measure.measured import Measured, columns
from jobs.measure.plots import plot_encoding_costs
from jobs.run.folder import Run, finish, locate_run, open_run
from jobs.run.progress import progress
from jobs.tracking.tracker import Tracker, open_tracker
from jobs.training.collect import check_pictures, data_file
from jobs.training.pretrain import (
    Window,
    check_sources,
    cut_window,
    encoder_file,
    prepare_encoder,
    sample_windows,
)
from models.encoder.evae import EventVAE
from models.encoder.weights import load_encoder
from models.kinds import EncoderModel

EVENT_ENCODERS = ("bytestream", "bytestream_xy")
MAX_EVENTS, DENSE_EVENTS = 4096, 2000
HEADINGS = (
    "Knob", "Setting", "Control step [us]", "2,000 events [us]", "Times faster",
    "Error, mean [% of sd]", "Error, largest [% of sd]", "Explained [%]",
)  # fmt: skip


@dataclass(frozen=True, config=STRICT)
class Settings:
    """Number of held-out windows, and of rounds of timing."""

    windows: Annotated[int, Field(ge=4)]
    rounds: Count


def run(config: Config) -> dict[str, float]:
    """Train the run's encoder if it does not exist yet, then measure; return the metrics.

    Raises:
        ConfigError: The policy has no encoder of single events.
    """
    model = locate_run(config).config.model
    if model.name not in EVENT_ENCODERS:
        raise ConfigError(
            f"model: {model.name} has no encoder of single events; choose bytestream or bytestream_xy"
        )
    if isinstance(model, EncoderModel) and model.coding == "eventnet":
        raise ConfigError("model.coding: must be additive or none for this study, got 'eventnet'")
    check_pictures(config)
    check_sources(config)
    folder = open_run(config)
    with open_tracker(folder.config, folder) as tracker:
        prepare_encoder(folder, tracker)
        evae, _ = load_encoder(encoder_file(folder))
        metrics = trade_inference(folder, tracker, evae)
        tracker.log(0, metrics)
    return finish(folder, "trade_encoder", metrics)


def trade_inference(folder: Run, tracker: Tracker, evae: EventVAE) -> dict[str, float]:
    """Measure cost and error of every encoding; return the metrics of the default."""
    config, trade = folder.config, folder.config.own
    validation = read_recording(data_file(folder, "validation"))
    usual = draw(config, validation, "mixed", MAX_EVENTS, trade.windows)
    dense = draw(config, validation, "count", DENSE_EVENTS, trade.windows)
    encodings = default_encodings(evae)
    with progress("Measure encodings", len(encodings), "encodings") as advance:
        timed = control_steps(validation, trade.windows), dense
        rows = measure_encodings(encodings, usual, timed, trade.rounds, advance)
    lines = [cost_cells(row, rows[1].cost_us) for row in rows]
    title = "Encoding a window, one setting changed at a time"
    publish_table(folder, tracker, "trade/inference", title, HEADINGS, lines)
    tracker.table("trade/inference", columns(rows))
    publish_plot(folder, tracker, "trade/inference", plot_encoding_costs(rows))
    write_csv(folder.path / "trade" / "inference.csv", COST_FIELDS, [cost_values(row) for row in rows])
    first, network = rows[:2]
    return {
        "perf/encode_step_us": first.outcome["step_us"],
        "perf/encode_2000_events_us": first.cost_us,
        "perf/encode_times_faster_than_network": network.cost_us / first.cost_us,
        "evae/latent_error_max": first.outcome["error_max"],
        "evae/latent_error_mean": first.error,
    }


def draw(
    config: Config, recording: Recording, windows: Literal["mixed", "count"], most_events: int, count: int
) -> list[Window]:
    """Return `count` fixed windows, of "mixed" lengths or, for "count", of `most_events` events each.

    A window of a fixed count holds fewer events at the end of an episode. So four times as many windows are
    drawn, and the fullest are returned.
    """
    settings = dataclasses.replace(config.pretrain, windows=windows, window_events=most_events)
    rng = np.random.default_rng(1)
    if windows == "mixed":
        return sample_windows(recording, settings, count, rng)
    drawn = sample_windows(recording, settings, 4 * count, rng)
    return sorted(drawn, key=lambda window: -len(window[0]))[:count]


def control_steps(recording: Recording, count: int) -> list[Window]:
    """Return `count` fixed windows of one control step each."""
    start, end = recording.index["step_t_us"], recording.index["step_end_us"]
    chosen = np.random.default_rng(1).choice(len(start), count)
    spans = [(int(start[step]), int(end[step] - start[step])) for step in chosen]
    return [cut_window(recording, first, span, MAX_EVENTS) for first, span in spans]


def cost_cells(row: Measured, network_us: float) -> tuple[str, ...]:
    """Return a text for each of `HEADINGS`; "times faster" refers to the network's cost of 2,000 events."""
    costs = f"{row.outcome['step_us']:,.0f}", f"{row.cost_us:,.0f}", f"{network_us / row.cost_us:,.0f}"
    errors = short(100 * row.error), short(100 * row.outcome["error_max"])
    return (row.knob, row.setting, *costs, *errors, f"{100 * row.outcome['explained']:.1f}")
