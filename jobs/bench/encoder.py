"""Encoding of events: lookup table against the network, and against copying the rows it reads.

Run `OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 python -m jobs.bench.encoder [rounds]` from the
repository root; it prints, for each coding of time, as JSON: microseconds per window of 300 and
2,000 events by the table, second half of the encoder included; how many times longer the network
takes for 2,000; nanoseconds per event; and those as a multiple of `np.copyto` of the bytes that an
event reads (a row of features and one of time code). CPU time, medians of rounds that take turns
in one process. The events are uniform, which is the worst case for caches.
"""

import json
import sys
import time
from collections.abc import Callable

import numpy as np
import torch

from envs.events import EVENT
from jobs.studies.encoder.costs import encode_by_network
from jobs.training.pretrain import Window
from models.encoder.embedding import CODINGS
from models.encoder.evae import EventVAE
from models.encoder.table import EncoderTable

FEW, MANY, WINDOW_US = 300, 2000, 20_000
CALLS = 20  # of what is short, in each round
PART = 50  # events whose rows are copied at once, to where the cache holds them


def compare(coding: str, rounds: int = 15) -> dict[str, float]:
    """Times of one coding, at the paper's sizes."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    evae = EventVAE(coding=coding).freeze()
    table, network = EncoderTable.from_evae(evae), encode_by_network(evae)
    few, many = uniform_window(FEW), uniform_window(MANY)
    rows = np.ones((MANY, 2 if len(table.embedding) > 1 else 1, table.features.shape[1]), np.float32)
    parts = np.split(rows, MANY // PART)
    copy = np.zeros_like(parts[0])
    calls: tuple[tuple[Callable[[], object], int], ...] = (
        (lambda: table.encode(*few), CALLS),
        (lambda: table.encode(*many), CALLS),
        (lambda: network(many), 1),
        (lambda: copy_rows(copy, parts), CALLS),
    )
    times = np.empty((rounds + 1, len(calls)))  # the first round compiles
    for turn in range(rounds + 1):
        times[turn] = [seconds(call, count) for call, count in calls]
    few_s, many_s, network_s, copy_s = np.median(times[1:], axis=0).tolist()
    event_s = (many_s - few_s) / (MANY - FEW)
    return {
        "us_300_events": 1e6 * few_s,
        "us_2000_events": 1e6 * many_s,
        "times_faster_than_network": network_s / many_s,
        "ns_per_event": 1e9 * event_s,
        "of_copying": event_s / (copy_s / MANY),
    }


def seconds(call: Callable[[], object], count: int) -> float:
    """CPU time of one of `count` calls."""
    start = time.process_time()
    for _ in range(count):
        call()
    return (time.process_time() - start) / count


def copy_rows(target: np.ndarray, parts: list[np.ndarray]) -> None:
    """Copy each part over the last."""
    for part in parts:
        np.copyto(target, part)


def uniform_window(count: int) -> Window:
    """A window of 64 x 64 pixels with `count` events anywhere."""
    rng = np.random.default_rng(count)
    events = np.zeros(count, EVENT)
    events["t"] = np.sort(rng.integers(1, WINDOW_US + 1, count))
    events["x"], events["y"] = rng.integers(0, 64, (2, count))
    events["p"] = rng.choice([-1, 1], count)
    return events, 0, WINDOW_US


if __name__ == "__main__":
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 15
    sys.stdout.write(json.dumps({coding: compare(coding, rounds) for coding in CODINGS}, indent=2) + "\n")
