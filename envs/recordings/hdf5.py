"""Read and write the recordings of this project: HDF5 files of events with their steps and settings.

The layout is DSEC's (github.com/uzh-rpg/DSEC), `events/{t,x,y,p}`, an offset and an index of
milliseconds, plus `index` and the attribute `about`.
"""

import bisect
import dataclasses
import json
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np

from core.files import replaced
from envs.events import EVENT
from envs.recordings.event_file import Request, assemble, check_file, check_order
from envs.recordings.hdf5_checks import ERRORS, attribute, check_own, declared_length, opened, time_offset

MAX_EVENTS = 2_000_000_000
MAX_INDEX = 200_000_000
MAX_BYTES = 8 << 30
# Compression of the data sets, with a checksum that detects a flipped bit.
PACKING = {**hdf5plugin.Blosc2(cname="zstd", clevel=3), "fletcher32": True}


@dataclasses.dataclass(frozen=True)
class Recording:
    """Events in time order, with an index of steps and the settings that produced them.

    Attributes:
        events: Shape (N,), dtype EVENT, sorted by t.
        index: Named integer arrays, such as `step_t_us` (start of each control step [us]).
        about: JSON values: sensor settings, scenes, seed.
    """

    events: np.ndarray
    index: dict[str, np.ndarray]
    about: dict[str, Any]

    def count_until(self, t_us: int) -> int:
        """Return the number of events with t <= t_us [us]; numpy's search would copy all times."""
        return bisect.bisect_right(self.events["t"], t_us)


def write_recording(path: Path, recording: Recording) -> None:
    """Write events, index and `about` to an HDF5 file, atomically.

    Raises:
        ValueError: The events are not of dtype EVENT or not sorted by time.
    """
    events = recording.events
    if events.dtype != EVENT:
        raise ValueError(f"events must have the dtype EVENT {EVENT}, got {events.dtype}")
    check_order(events)
    offset = int(events["t"][0]) if len(events) else 0
    t_us = events["t"] - offset
    check_span(path, t_us)
    # Built in memory, in its packed size, because HDF5 crashes the process on a full disk.
    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        columns = {"t": t_us, "x": events["x"], "y": events["y"], "p": (events["p"] > 0).astype(np.uint8)}
        for name, values in columns.items():
            file.create_dataset(f"events/{name}", data=values, **PACKING)
        file["t_offset"] = np.int64(offset)
        file["ms_to_idx"] = milliseconds_to_index(t_us)
        index = file.create_group("index")
        for name, values in recording.index.items():
            index.create_dataset(name, data=values, **PACKING)
        file.attrs["about"] = json.dumps(recording.about, allow_nan=False)
        file.flush()
        image = file.id.get_file_image()
    with replaced(path) as part:
        part.write_bytes(image)


def check_span(path: Path, t_us: np.ndarray) -> None:
    """Check that times [us] since the first event fit into an index of milliseconds.

    Raises:
        ValueError: The last time is too long after the first event.
    """
    if len(t_us) and t_us[-1] >= 1000 * MAX_INDEX:
        raise ValueError(
            f"{path}: the hdf5 layout has an index entry for each millisecond and this is {t_us[-1]} us; "
            f"write parts of at most {1000 * MAX_INDEX} us, or choose npz"
        )


def read_recording(path: Path) -> Recording:
    """Read a file written by `write_recording`.

    Raises:
        ValueError: The file is no such file, is truncated, links to other files, or declares
            more events than `MAX_EVENTS`; all this is checked before memory is allocated.
    """
    try:
        check_file(path, MAX_BYTES)
        with opened(path) as file:
            events = _events(Request(path, max_events=MAX_EVENTS), file)
            index = {}
            check_own(file, "index")
            for name in file["index"]:
                declared_length(file, f"index/{name}", MAX_INDEX)
                index[name] = file[f"index/{name}"][:]
            about = json.loads(attribute(file, "about"))
    except ERRORS as error:
        raise ValueError(f"{path} is no readable event recording ({error}); collect it again") from error
    return Recording(events, index, about)


def milliseconds_to_index(t_us: np.ndarray) -> np.ndarray:
    """Return the index of the first event at or after each millisecond, as in DSEC: t[i[ms]] >= ms * 1000."""
    last_ms = int(t_us[-1]) // 1000 if len(t_us) else 0
    return np.searchsorted(t_us, np.arange(last_ms + 1, dtype=np.int64) * 1000).astype(np.uint64)


def _events(request: Request, file: h5py.File) -> np.ndarray:
    """Return the stored events, with the offset added to their times."""
    count = declared_length(file, "events/t", request.max_events)
    columns = []
    for name in ("t", "x", "y", "p"):
        if declared_length(file, f"events/{name}", request.max_events) != count:
            raise ValueError(f"events/{name} and events/t differ in length")
        columns.append(file[f"events/{name}"][:])
    t, x, y, p = columns
    offset = time_offset(file)
    if t.dtype.kind not in "iu" or (len(t) and not 0 <= int(t.max()) + abs(offset) < 1 << 62):
        raise ValueError("events/t are no whole microseconds")
    t = t.astype(np.int64, copy=False)
    t += offset
    rows = assemble(request, t, x, y, p).events
    if request.tally.damage:
        raise ValueError(f"it has {dict(request.tally.damage)}")
    return rows
