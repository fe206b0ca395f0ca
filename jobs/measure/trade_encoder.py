"""Measure what accuracy of the event encoder costs.

Run: python -m platform.launch +exp=trade_encoder
Expect: some minutes on one core beyond the run's own encoder, nearly all of it one short training for each
size of the context. Finished trainings stay in the run folder, so an interrupted job continues. A table and
its plot, in the run folder under `trade/` and in MLflow.
"""

from collections.abc import Sequence
from typing import Annotated

import torch
from pydantic import Field
from pydantic.dataclasses import dataclass

from envs.config import STRICT
from envs.recordings import read_recording
from jobs.analysis.tables import publish_plot, publish_table, short, write_csv
from jobs.config.config import Config, ConfigError
from jobs.config.schema import Count
from jobs.measure.encoding_plots import plot_encoding_costs
from jobs.measure.encodings import (
    EncodingCost,
    default_encodings,
    measure_encodings,
    sized_encoding,
)
from jobs.measure.trials import (
    MAX_EVENTS,
    control_steps,
    draw,
    trained,
)
from jobs.run.folder import Run, finish, locate_run, open_run
from jobs.run.progress import progress
from jobs.tracking.tracker import Tracker, open_tracker
from jobs.training.collect import data_file
from jobs.training.pretrain import check_sources, encoder_file, prepare_encoder
from models.encoder.evae import EventVAE
from models.encoder.weights import load_encoder
from models.kinds import EncoderModel

EVENT_ENCODERS = ("bytestream", "bytestream_xy")
CONTEXTS = (128, 256, 512, 1024)
DENSE_EVENTS = 2000
HEADINGS = (
    "Knob", "Setting", "Control step [us]", "2,000 events [us]", "Times faster",
    "Error, mean [% of sd]", "Error, largest [% of sd]", "Explained [%]",
)  # fmt: skip


@dataclass(frozen=True, config=STRICT)
class Settings:
    """How long the compared encoders are trained, and on how many windows they are measured."""

    iterations: Count
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


@torch.no_grad()
@torch.no_grad()
def cost_cells(row: EncodingCost, network_us: float) -> tuple[str, ...]:
    """A text for each of `HEADINGS`; "times faster" refers to the network's cost of 2,000 events."""
    costs = f"{row.step_us:,.0f}", f"{row.dense_us:,.0f}", f"{network_us / row.dense_us:,.0f}"
    errors = short(100 * row.error_mean), short(100 * row.error_max)
    return (row.knob, row.setting, *costs, *errors, f"{100 * row.explained:.1f}")


def cost_columns(rows: Sequence[EncodingCost]) -> dict[str, list[str | float]]:
    """The columns of a tracker's table; the first is unique."""
    named: dict[str, list[str | float]] = {"form": [f"{row.knob} {row.setting}".strip() for row in rows]}
    return named | {name: [getattr(row, name) for row in rows] for name in EncodingCost._fields[2:]}
