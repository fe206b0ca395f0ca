"""Compare the encoder's lookup table with its network, with plain torch, and with only reading the rows.

Run `OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m benchmarks.encoder [rounds]` from the
repository root. CPU time on one core, medians of interleaved rounds in one process; the events are
uniform, which is the worst case for caches. It prints as JSON

- `codings`: for each coding of time, at the paper's sizes: microseconds per window of 300 and of
  2,000 events by the table, including the second half of the encoder; how many times longer the network takes
  for 2,000 events; nanoseconds per event; and the time per event relative to `np.copyto` of the bytes that an
  event reads (a row of features and a row of the time code);
- `rows`: for each precision, and 256 and 1,024 features: the same for 2,000 events; how many times longer
  plain torch takes for the context alone (Conv1d 3-64-128-features, batch norm, ReLU, maximum); and the
  time per event relative to only loading the same words of the same rows;
- `batch_us_per_window`: 32 windows of 20 to 280 events and 256 features, in one call and one by one;
- `neighbour_filter_ns_per_event`: time of `core.neighbour_filter`, at 64 x 64 pixels.
"""

import itertools
import json
import sys
import time
from collections.abc import Callable

import numba
import numpy as np
import torch
from torch import nn

from core.neighbour_filter import filter_neighbours, quiet_sensor
from envs.events import EVENT
from envs.events.windows import pack_window
from jobs.measure.encodings import encode_by_network
from jobs.measure.timing import interleaved
from jobs.training.pretrain import Window
from models.encoder.embedding import CODINGS
from models.encoder.evae import EventVAE
from models.encoder.event_batch import batch_windows
from models.encoder.table import PRECISIONS, EncoderTable

FEW, MANY, WINDOW_US = 300, 2000, 20_000
CALLS = 20  # of short functions, in each round
PART = 50  # events whose rows are copied at once, to a target that stays in the cache
CORRIDORS, SIDE, TAU_US = 32, 64, 2000


def compare(coding: str, rounds: int = 15) -> dict[str, float]:
    """Return the times of one coding, at the paper's sizes."""
    torch.manual_seed(0)
    evae = EventVAE(coding=coding).freeze()
    table, network = EncoderTable.from_evae(evae), encode_by_network(evae)
    few, many = uniform_window(FEW), uniform_window(MANY)
    rows = np.ones((MANY, 2 if len(table.embedding) > 1 else 1, table.features.shape[1]), np.float32)
    parts = np.split(rows, MANY // PART)
    copy = np.zeros_like(parts[0])
    seconds = medians(
        {
            "few": lambda: table.encode(*few),
            "many": lambda: table.encode(*many),
            "copy": lambda: copy_rows(copy, parts),
        },
        {"network": lambda: network(many)},
        rounds,
    )
    event_s = (seconds["many"] - seconds["few"]) / (MANY - FEW)
    return {
        "us_300_events": 1e6 * seconds["few"],
        "us_2000_events": 1e6 * seconds["many"],
        "times_faster_than_network": seconds["network"] / seconds["many"],
        "ns_per_event": 1e9 * event_s,
        "of_copying": event_s / (seconds["copy"] / MANY),
    }


def compare_rows(features: int, precision: str, rounds: int) -> dict[str, float]:
    """Return the times of rows with `features` features and a precision."""
    torch.manual_seed(0)
    table = EncoderTable.from_evae(EventVAE(context=features).freeze(), precision)
    many, none = uniform_window(MANY), uniform_window(0)
    batch = batch_windows([many], table.grid)
    words = table.features.view(np.int64), table.embedding.view(np.int64)
    network, inputs = plain_torch(features), torch.rand(1, 3, MANY)
    seconds = medians(
        {
            "many": lambda: table.encode(*many),
            "none": lambda: table.encode(*none),
            "read": lambda: read_rows(*words, batch.code, batch.bin),
        },
        {"torch": lambda: network(inputs).amax(2)},
        rounds,
    )
    event_s = (seconds["many"] - seconds["none"]) / MANY
    return {
        "us_2000_events": 1e6 * seconds["many"],
        "times_faster_than_plain_torch": seconds["torch"] / seconds["many"],
        "ns_per_event": 1e9 * event_s,
        "of_reading": event_s / (seconds["read"] / MANY),
    }


def compare_batch(rounds: int) -> dict[str, float]:
    """Return microseconds per packed window of a batch, in one call and one by one."""
    table = EncoderTable.from_evae(EventVAE(context=256, latent=32).freeze())
    counts = np.linspace(20, 280, CORRIDORS).astype(int)
    windows = [pack_window(*uniform_window(count), capacity=count) for count in counts]
    one_by_one = [window[None] for window in windows]
    seconds = medians(
        {
            "one call": lambda: table.encode_windows(windows),
            "one by one": lambda: [table.encode_windows(window) for window in one_by_one],
        },
        {},
        rounds,
    )
    return {name: 1e6 * value / CORRIDORS for name, value in seconds.items()}


def filter_cost(support: int, rounds: int) -> float:
    """Return the neighbour filter's time per event [ns]."""
    (events, _, _), last_us = uniform_window(MANY), quiet_sensor(SIDE, SIDE)
    seconds = medians({"": lambda: filter_neighbours(events, last_us, support, TAU_US)}, {}, rounds)
    return 1e9 * seconds[""] / MANY


def medians(
    short: dict[str, Callable[[], object]], long: dict[str, Callable[[], object]], rounds: int
) -> dict[str, float]:
    """Return the CPU time of one call [s]; each in `short` is called `CALLS` times in a row."""
    torch.set_num_threads(1)
    work = {name: repeated(call) for name, call in short.items()} | long
    with torch.inference_mode():
        seconds = interleaved(work, rounds, time.process_time)
    return {name: value / (CALLS if name in short else 1) for name, value in seconds.items()}


def repeated(call: Callable[[], object]) -> Callable[[], object]:
    """Return a function that makes `CALLS` calls."""
    return lambda: [call() for _ in range(CALLS)]


def plain_torch(features: int) -> nn.Module:
    """Return the context network as published, without time: three convolutions over single events."""
    sizes = [3, 64, 128, features]
    layers = [
        nn.Sequential(nn.Conv1d(fan_in, fan_out, 1), nn.BatchNorm1d(fan_out), nn.ReLU())
        for fan_in, fan_out in itertools.pairwise(sizes)
    ]
    return nn.Sequential(*layers).eval()


def copy_rows(target: np.ndarray, parts: list[np.ndarray]) -> None:
    """Copy each part over the previous one."""
    for part in parts:
        np.copyto(target, part)


@numba.njit(error_model="numpy")
def read_rows(features: np.ndarray, embedding: np.ndarray, code: np.ndarray, bins: np.ndarray) -> np.int64:
    """Load every word of the rows of the events, and do next to nothing with it."""
    total = np.int64(0)
    for n in range(len(code)):
        feature, shift = features[code[n]], embedding[bins[n]]
        for j in range(len(feature)):
            total ^= feature[j] ^ shift[j]
    return total


def uniform_window(count: int) -> Window:
    """Return a window of `count` uniform events on 64 x 64 pixels."""
    rng = np.random.default_rng(count)
    events = np.zeros(count, EVENT)
    events["t"] = np.sort(rng.integers(1, WINDOW_US + 1, count))
    events["x"], events["y"] = rng.integers(0, SIDE, (2, count))
    events["p"] = rng.choice([-1, 1], count)
    return events, 0, WINDOW_US


def main(rounds: int) -> None:
    """Measure and print all numbers."""
    rows = [(features, precision) for features in (256, 1024) for precision in PRECISIONS]
    figures = {
        "codings": {coding: compare(coding, rounds) for coding in CODINGS},
        "rows": {f"{size}, {precision}": compare_rows(size, precision, rounds) for size, precision in rows},
        "batch_us_per_window": compare_batch(rounds),
        "neighbour_filter_ns_per_event": {f"k={k}": filter_cost(k, rounds) for k in (0, 1, 8)},
    }
    sys.stdout.write(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 15)
