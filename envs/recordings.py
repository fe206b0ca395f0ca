"""Event files: flights recorded by the simulator, in the HDF5 layout of the DSEC data set.

`/events/{t,x,y,p}`, `/t_offset` and `/ms_to_idx` are what other tools read; `/index/*` and
the attribute `about` are ours: where each control step and flight begins, and how the
events were made.
"""

import dataclasses
import json
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np

from envs.events import EVENT

MAX_EVENTS = 2_000_000_000
MAX_INDEX = 200_000_000


@dataclasses.dataclass(frozen=True)
class Recording:
    """Events in time order, with where things begin and how they were made.

    Attributes:
        events: Shape (N,), dtype EVENT, sorted by t.
        index: Named integer arrays, such as `step_t_us` (start of each control step [us]).
        about: Plain facts: sensor settings, scenes, seed.
    """

    events: np.ndarray
    index: dict[str, np.ndarray]
    about: dict[str, Any]

    @cached_property
    def t_us(self) -> np.ndarray:
        """Times of the events [us], contiguous: searching the strided field copies all of it."""
        return np.ascontiguousarray(self.events["t"])


def write_recording(path: Path, recording: Recording) -> None:
    """Write events, index and facts to an HDF5 file; the file appears whole or not at all.

    Raises:
        ValueError: The events are not of dtype EVENT or not sorted by time.
    """
    events = recording.events
    if events.dtype != EVENT:
        raise ValueError(f"events must have the dtype EVENT {EVENT}, got {events.dtype}")
    if np.any(np.diff(events["t"]) < 0):
        first = int(np.argmax(np.diff(events["t"]) < 0))
        raise ValueError(f"events must be sorted by t; event {first + 1} is older than the one before it")
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    pack = hdf5plugin.Blosc2(cname="zstd", clevel=3)
    offset = int(events["t"][0]) if len(events) else 0
    with h5py.File(part, "w") as file:
        for name in ("t", "x", "y", "p"):
            values = events[name] - offset if name == "t" else events[name]
            file.create_dataset(f"events/{name}", data=values, **pack)
        file["t_offset"] = np.int64(offset)
        file["ms_to_idx"] = milliseconds_to_index(events["t"] - offset)
        index = file.create_group("index")
        for name, values in recording.index.items():
            index.create_dataset(name, data=values, **pack)
        file.attrs["about"] = json.dumps(recording.about, allow_nan=False)
    part.replace(path)


def read_recording(path: Path) -> Recording:
    """Read a file that `write_recording` wrote.

    Raises:
        ValueError: The file is no such file, is truncated, links to other files, or declares
            more events than `MAX_EVENTS`; nothing is allocated before that is known.
    """
    try:
        with h5py.File(path, "r") as file:
            count = _declared_length(file, "events/t", MAX_EVENTS)
            events = np.empty(count, EVENT)
            for name in ("t", "x", "y", "p"):
                if _declared_length(file, f"events/{name}", MAX_EVENTS) != count:
                    raise ValueError(f"events/{name} and events/t differ in length")
                events[name] = file[f"events/{name}"][:]
            events["t"] += int(file["t_offset"][()])
            index = {}
            for name in file["index"]:
                _declared_length(file, f"index/{name}", MAX_INDEX)
                index[name] = file[f"index/{name}"][:]
            about = json.loads(file.attrs["about"])
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"{path} is no readable event recording ({error}); collect it again") from error
    return Recording(events, index, about)


def milliseconds_to_index(t_us: np.ndarray) -> np.ndarray:
    """First event at or after each whole millisecond, as DSEC defines it: t[i[ms]] >= ms * 1000."""
    last_ms = int(t_us[-1]) // 1000 if len(t_us) else 0
    return np.searchsorted(t_us, np.arange(last_ms + 1, dtype=np.int64) * 1000).astype(np.uint64)


def _declared_length(file: h5py.File, name: str, most: int) -> int:
    """Length of a one-dimensional data set of this very file, checked before it is read."""
    for part in (name.split("/")[0], name):
        if not isinstance(file.get(part, getlink=True), h5py.HardLink):
            raise ValueError(f"{part} is missing or a link")
    data = file[name]
    if not isinstance(data, h5py.Dataset) or data.ndim != 1 or data.external or data.is_virtual:
        raise ValueError(f"{name} is not a plain one-dimensional data set")
    if len(data) > most:
        raise ValueError(f"{name} declares {len(data)} entries; at most {most} are read")
    return len(data)
