"""Measure peak memory and CPU time of writing and reading every event file format at 1280x720.

Run: python -m benchmarks.recording_memory
Expect: one table in a minute or two. Each task runs in its own process. Memory is what the task adds
to the libraries and, for writing, to the events; "in parts" means `PART` events at a time. The last rows
are a video.
"""

import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from envs.events import EVENT

WIDTH, HEIGHT = 1280, 720
COUNT, PART = 4_000_000, 500_000
FRAMES, FPS = 12, 60
FORMATS = ("aedat4", "csv", "dat", "evt2", "evt3", "hdf5", "npz", "txt")


def main() -> None:
    """Measure in processes of their own and print the table."""
    rows = []
    with TemporaryDirectory() as folder:
        for format in FORMATS:
            for task in ("write", "write in parts", "read", "read in parts"):
                rows.append((f"{task} {format}", *measured(task, folder, format)))
        video(Path(folder))
        for task in ("video to events", "video in parts"):
            rows.append((task, *measured(task, folder, "evt3")))
    print(f"{COUNT:,} events of {WIDTH}x{HEIGHT}, parts of {PART:,}")
    for name, *numbers in rows:
        print(f"{name:24}", *(f"{number:>12}" for number in numbers))


def measured(task: str, folder: str, format: str) -> tuple[str, str]:
    """Return processor time [s] and peak memory beyond the libraries [MiB] of a task, in a new process."""
    words = [sys.executable, "-W", "ignore", "-m", __spec__.name, task, folder, format]
    for _ in range(1 + (task in ("write", "video to events"))):  # the first run of a format may compile
        child = subprocess.run(  # noqa: S603  this module
            words, capture_output=True, text=True, check=False
        )
    if child.returncode:
        return "-", child.stderr.strip().rpartition("\n")[2][:60]
    seconds, mib = child.stdout.split()[-2:]
    return f"{float(seconds):.2f} s", f"{float(mib):,.0f} MiB"


def some() -> np.ndarray:
    """Return events of a dense 720p scene, sorted by time."""
    rng, events = np.random.default_rng(0), np.empty(COUNT, EVENT)
    events["t"] = np.sort(rng.integers(0, 1_000_000, COUNT))
    events["x"], events["y"] = rng.integers(0, WIDTH, COUNT), rng.integers(0, HEIGHT, COUNT)
    events["p"] = rng.choice(np.array([-1, 1], np.int8), COUNT)
    return events


def video(folder: Path) -> None:
    """Write frames of a moving pattern as images."""
    from PIL import Image

    y, x = np.mgrid[:HEIGHT, :WIDTH]
    for k in range(FRAMES):
        values = 128 + 100 * np.sin((x - 16 * k) / 36) * np.cos(y / 120)
        Image.fromarray(values.astype(np.uint8)).save(folder / f"{k}.png")


def do(task: str, folder: Path, format: str) -> Callable[[], object]:
    """Return a task as a function, after its imports and the creation of its events."""
    from envs import recordings
    from envs.recordings.video import video_steps

    path, name = folder / format, "txt" if format == "csv" else format
    size: dict[str, Any] = {"width": WIDTH, "height": HEIGHT} if format == "csv" else {}
    events = some() if task.startswith("write") else np.empty(0, EVENT)

    def in_parts() -> None:
        with recordings.event_writer(path, WIDTH, HEIGHT, format) as write:
            for first in range(0, COUNT, PART):
                write(events[first : first + PART])

    def of_video() -> None:
        with recordings.event_writer(folder / "video.raw", WIDTH, HEIGHT, format) as write:
            for step in video_steps(folder, fps=FPS):
                write(step.events)

    return {
        "write": lambda: recordings.write_events(path, events, WIDTH, HEIGHT, format),
        "write in parts": in_parts,
        "read": lambda: recordings.read_events(path, name, **size),
        "read in parts": lambda: [
            len(part.events) for part in recordings.read_parts(path, name, part_events=PART, **size)
        ],
        "video to events": lambda: recordings.video_to_events(folder, fps=FPS),
        "video in parts": of_video,
    }[task]


def child(task: str, folder: str, format: str) -> None:
    """Do one task; print its processor time [s] and the increase of the process's peak memory [MiB]."""
    work = do(task, Path(folder), format)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    begun = time.process_time()
    kept = work()
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(kept is None, time.process_time() - begun, (after - before) / 1024)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        child(*sys.argv[1:])
    else:
        main()
