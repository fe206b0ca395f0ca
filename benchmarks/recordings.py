"""Measure speed and size of every event file format, relative to numpy's npz and to a copy in memory.

Run: python -m benchmarks.recordings
Expect: one table in about twenty seconds. "time / np.load" is relative to `np.load` of the four
arrays of a compressed npz file of the same events, without checks; "time / copy" is relative to
the limit of any reader, a copy of the same events in memory. The events are from a real recording if
there is one (folder EVADE_DATA, by default ../shared/data), otherwise from a simulated flight.
"""

import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from envs.corridor import CorridorEnv
from envs.recordings import WRITERS, downscale_events, read_events, write_events
from jobs.analysis.tables import show_table
from jobs.measure.timing import interleaved
from jobs.run.provenance import REPOSITORY

DATA = Path(os.environ.get("EVADE_DATA", REPOSITORY.parent / "shared" / "data"))
SAMPLE = DATA / "expelliarmus_evt" / "evt3_sample.raw"
SIMULATED_STEPS = 600


def main() -> None:
    """Measure and print the table."""
    events, width, height, source = recording()
    with TemporaryDirectory() as folder:
        paths = {format: Path(folder) / f"events.{format}" for format in WRITERS}
        work: dict[str, Callable[[], object]] = {
            "np.load of npz": partial(load_npz, paths["npz"]),
            "copy": events.view(np.uint8).copy,
        }
        if SAMPLE.is_file():
            work["read the camera's own evt3"] = partial(read_events, SAMPLE)
        for format, path in paths.items():
            work[f"write {format}"] = partial(write_events, path, events, width, height, format)
            name = "txt" if format == "csv" else None
            work[f"read {format}"] = partial(read_events, path, name)
        shapes = (height, width), (height // 4, width // 4)
        work["downscale, 4 times each way"] = partial(downscale_events, events, *shapes)
        for format, path in paths.items():
            write_events(path, events, width, height, format)
        seconds = interleaved(work, clock=time.thread_time)
        sizes = {format: path.stat().st_size / len(events) for format, path in paths.items()}
    whole, least = seconds["np.load of npz"], seconds["copy"]
    rows = []
    for name, taken in seconds.items():
        size = sizes.get(name.partition(" ")[2])
        speed = f"{len(events) / taken / 1e6:,.1f}", f"{taken / whole:.2f}", f"{taken / least:,.1f}"
        rows.append((name, *speed, "" if size is None else f"{size:.2f}"))
    title = (
        f"{len(events):,} events of {source}, {width}x{height}; processor time, medians of interleaved rounds"
    )
    show_table(title, ("work", "Mev/s", "time / np.load", "time / copy", "bytes per event"), rows)


def recording() -> tuple[np.ndarray, int, int, str]:
    """Return events to write and read, width and height of their sensor, and their source."""
    if SAMPLE.is_file():
        file = read_events(SAMPLE)
        return file.events, file.width or 0, file.height or 0, f"a street ({SAMPLE.name})"
    env = CorridorEnv()
    env.reset(seed=0)
    parts, clock_us = [], 0
    for _ in range(SIMULATED_STEPS):
        _, _, terminated, truncated, info = env.step(1)
        parts.append(env.events.copy())
        parts[-1]["t"] += clock_us
        if terminated or truncated:
            clock_us += info["t_us"]
            env.reset()
    return np.concatenate(parts), env.config.camera.width, env.config.camera.height, "a simulated flight"


def load_npz(path: Path) -> list[np.ndarray]:
    """Read the four arrays, without checks."""
    with np.load(path) as file:
        return [file[name] for name in ("t", "x", "y", "p")]


if __name__ == "__main__":
    main()
