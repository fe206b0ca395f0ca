"""Measure cost and latent error of several ways to encode events, against float64 with exact times."""

import copy
import csv
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from jobs.measure.measured import Measured
from jobs.measure.timing import interleaved
from jobs.training.pretrain import Window
from models.encoder.embedding import time_code
from models.encoder.evae import EventVAE, event_targets, reconstruct
from models.encoder.event_batch import EventBatch, batch_windows, index_events
from models.encoder.table import EncoderTable

TIME_BINS = (16, 64, 256, 1024, 4096, 65536)
CAPS = (250, 500, 1000, 2000, 4096)
CHUNKS = (1, 2, 5, 20)
TIMED_WINDOWS = 8
# Settings equal to the default, for a model with 1,024 time bins and windows of up to 4,096 events.
UNCHANGED = (("default", ""), ("time bins", "1024"), ("newest events", "4096"), ("chunks", "1"))
Encode = Callable[[Window], np.ndarray]


class Encoding(NamedTuple):
    """One way to encode a window: the changed knob, its setting, and the function to mu (latent,)."""

    knob: str
    setting: str
    encode: Encode
    evae: EventVAE


COST_FIELDS = ("knob", "setting", "step_us", "dense_us", "error_max", "error_mean", "explained")


def cost_values(row: Measured) -> tuple[str | float, ...]:
    """Return the values of `COST_FIELDS`."""
    of = row.outcome
    return (row.knob, row.setting, of["step_us"], row.cost_us, of["error_max"], row.error, of["explained"])


def default_encodings(evae: EventVAE) -> list[Encoding]:
    """Return the default lookup table, the plain network, and tables with one setting changed."""
    table = EncoderTable.from_evae(evae)
    forms = [("default", "", encode_whole(table)), ("torch", "plain network", encode_by_network(evae))]
    for precision in ("int16", "int8"):
        forms.append(("precision", precision, encode_whole(EncoderTable.from_evae(evae, precision))))
    if evae.ecn.coding != "none":
        for bins in TIME_BINS:
            forms.append(("time bins", str(bins), encode_whole(EncoderTable.from_evae(evae, time_bins=bins))))
    forms += [("newest events", str(most), encode_newest(table, most)) for most in CAPS]
    forms += [("chunks", str(count), encode_in_chunks(table, count)) for count in CHUNKS]
    forms.append(("chunks", "per event", encode_in_chunks(table, None)))
    return [Encoding(*form, evae) for form in forms]


def encode_whole(table: EncoderTable) -> Encode:
    """Return a function that encodes all events at once."""
    return lambda window: table.encode(*window)


def encode_newest(table: EncoderTable, most: int) -> Encode:
    """Return a function that encodes only the newest `most` events."""
    return lambda window: table.encode(window[0][-most:], *window[1:])


def encode_in_chunks(table: EncoderTable, count: int | None) -> Encode:
    """Return a function that encodes `count` chunks in turn, like a stream; None: event by event."""

    def encode(window: Window) -> np.ndarray:
        events, start_us, window_us = window
        context = table.empty()
        for part in np.array_split(events, count or max(1, len(events))):
            context = table.update(context, part, start_us, window_us)
        return table.latent(context)

    return encode


def encode_by_network(evae: EventVAE) -> Encode:
    """Return a function that sends every event through the network, as published."""

    @torch.no_grad()
    def encode(window: Window) -> np.ndarray:
        context = evae.ecn.plain(batch_windows([window], evae.grid))
        return evae.encoder(context)[0, : evae.settings.latent].numpy()

    return encode


@torch.no_grad()
def exact_latents(evae: EventVAE, windows: Sequence[Window]) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation (B, latent) of the posterior, float64, times not rounded to bins.

    Raises:
        ValueError: The model's contexts are complex.
    """
    if evae.ecn.coding == "eventnet":
        raise ValueError("coding must be additive or none, got 'eventnet'")
    model = copy.deepcopy(evae).double()
    features = model.ecn.cell_features().numpy()
    contexts = np.zeros((len(windows), features.shape[1]))
    for context, (events, start_us, window_us) in zip(contexts, windows, strict=True):
        if len(events):
            fields = tuple(events[name] for name in "txyp")
            cells = index_events(fields, start_us, window_us, evae.grid)[0] % len(features)
            times = np.clip((events["t"] - start_us) / window_us, 0.0, 1.0)
            codes = time_code(times, features.shape[1], evae.ecn.coding)
            context[:] = np.maximum((features[cells] + codes).max(axis=0), 0.0)
    mu, logvar = model.encoder(torch.from_numpy(contexts)).chunk(2, dim=-1)
    return mu.numpy(), torch.exp(0.5 * logvar).numpy()


@torch.no_grad()
def explained(evae: EventVAE, batch: EventBatch, mu: torch.Tensor | None = None) -> float:
    """Return the share of the variance of the windows' pictures that the decoded pictures explain (R2).

    1 - squared error / squared error of the mean picture: 0 for the mean picture, 1 for perfect decoding.

    Args:
        evae: Frozen model.
        batch: Windows.
        mu: Latents to decode (B, latent); None: the model's own.
    """
    targets = event_targets(batch, evae.target)
    logits = evae(batch)[0] if mu is None else evae.decoder(mu)
    error = (reconstruct(logits, evae.target) - targets).square().sum()
    return 1.0 - float(error / (targets.mean(0) - targets).square().sum().clamp_min(1e-12))


def measure_encodings(
    encodings: Sequence[Encoding],
    windows: list[Window],
    timed: tuple[list[Window], list[Window]],
    rounds: int,
    advance: Callable[[int], None],
) -> list[Measured]:
    """Measure cost and accuracy of each encoding.

    The cost is the process time per window of 2,000 events. The error is the mean distance of mu from float64
    with exact times, over latents and windows, in standard deviations of the posterior. Further outcomes are
    the process time of one control step, the largest distance, and the variance that pictures decoded from
    this mu explain (`explained`).

    Args:
        encodings: The encodings to measure.
        windows: Held-out windows for the accuracy.
        timed: Windows of one control step, and dense windows, for the cost.
        rounds: Rounds of timing.
        advance: Called with 1 after each encoding.
    """
    costs = costs_us(encodings, timed, rounds)
    rows: list[Measured] = []
    reference: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for encoding, (step_us, dense_us) in zip(encodings, costs.tolist(), strict=True):
        if id(encoding.evae) not in reference:
            reference[id(encoding.evae)] = exact_latents(encoding.evae, windows)
        mu, deviation = reference[id(encoding.evae)]
        own = np.stack([encoding.encode(window) for window in windows])
        error = np.abs(own - mu) / deviation
        share = explained(encoding.evae, batch_windows(windows, encoding.evae.grid), torch.from_numpy(own))
        outcome = {"step_us": step_us, "error_max": float(error.max()), "explained": float(share)}
        rows.append(Measured(*encoding[:2], dense_us, float(error.mean()), outcome))
        advance(1)
    return rows


def costs_us(encodings: Sequence[Encoding], timed: tuple[list[Window], ...], rounds: int) -> np.ndarray:
    """Return the process time per window [us], (encodings, kinds of windows), in interleaved rounds."""
    pairs = [(encoding.encode, windows[:TIMED_WINDOWS]) for encoding in encodings for windows in timed]
    work = {place: partial(_encode_all, *pair) for place, pair in enumerate(pairs)}
    # Load the table into the processor's cache, where it is during an episode.
    before = {place: partial(encode, windows[0]) for place, (encode, windows) in enumerate(pairs)}
    seconds = interleaved(work, rounds, time.process_time, before)
    costs = [1e6 * seconds[place] / len(windows) for place, (_, windows) in enumerate(pairs)]
    return np.reshape(costs, (len(encodings), len(timed)))


def _encode_all(encode: Encode, windows: Sequence[Window]) -> None:
    for window in windows:
        encode(window)


def repeats(rows: Sequence[Measured]) -> list[Measured]:
    """Return the default and the rows that compute the same; their costs differ by timing noise only."""
    (default,) = (row for row in rows if row.knob == "default")
    return [row for row in rows if (row.knob, row.setting) in UNCHANGED and row.error == default.error]


def read_costs(file: Path) -> list[Measured]:
    """Read the rows of a CSV file with the columns `COST_FIELDS`."""
    with file.open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    found = []
    for row in rows:
        values = {name: float(row[name]) for name in COST_FIELDS[2:]}
        cost_us, error = values.pop("dense_us"), values.pop("error_mean")
        found.append(Measured(row["knob"], row["setting"], cost_us, error, values))
    return found
