"""Untrained encoders, their files, and events to encode for tests."""

import numpy as np
import torch

from models.encoder.evae import EventVAE
from models.encoder.event_batch import batch_windows

EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "i1")])
WINDOW_US = 5000
SMALL = {"width": 12, "height": 10, "context": 64, "time_bins": 32}


def make_evae(variant="bytestream", dtype=torch.float32, **settings):
    """A model whose running statistics are not the initial ones."""
    torch.manual_seed(2)
    evae = EventVAE(
        **{"variant": variant, "width": 16, "height": 12, "context": 128, "time_bins": 64} | settings
    )
    for _ in range(20):
        evae.ecn(batch_windows([(make_events(400, seed), 0, WINDOW_US) for seed in range(2)], evae.grid))
    return evae.to(dtype).freeze()


def make_events(count, seed=0, start_us=0, width=16, height=12):
    rng = np.random.default_rng(seed)
    events = np.zeros(count, EVENT)
    events["t"] = start_us + np.sort(rng.integers(1, WINDOW_US + 1, count))
    events["x"], events["y"] = rng.integers(0, width, count), rng.integers(0, height, count)
    events["p"] = rng.choice([-1, 1], count)
    return events


def events(*rows):
    return np.array(list(rows), EVENT)


def bars(evae, windows, rng):
    """Windows of a vertical bar each, at a random column, its polarity by the side of the sensor."""
    parts = []
    for _ in range(windows):
        count, column = int(rng.integers(20, 120)), int(rng.integers(0, 11))
        window = np.zeros(count, EVENT)
        window["t"] = np.sort(rng.integers(1, 5001, count))
        window["x"] = column + rng.integers(0, 2, count)
        window["y"] = rng.integers(0, 10, count)
        window["p"] = 1 if column < 5 else -1
        parts.append((window, 0, 5000))
    return batch_windows(parts, evae.grid)


def small(seed=0, **settings):
    torch.manual_seed(seed)
    return EventVAE(**{**SMALL, **settings})
