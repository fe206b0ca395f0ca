"""HDF5 event files in the layout of the DSEC data set, and the recordings that add to it.

`/events/{t,x,y,p}`, `/t_offset` and `/ms_to_idx` are what other tools read; `/index/*` and
the attribute `about` are ours: where each control step and episode begins, and how the
events were made. Polarity is 0 or 1 on disk, as in DSEC; files with -1 and 1 are read too.
"""

import contextlib
import dataclasses
import json
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np

from envs.events import EVENT
from envs.recordings.event_file import (
    MAX_BYTES,
    EventFile,
    Request,
    assemble,
    check_declared,
    check_file,
    check_order,
    finish,
    replaced,
)

MAX_EVENTS = 2_000_000_000
MAX_INDEX = 200_000_000
MAX_CHUNK_BYTES = 1 << 28

# Filters that event files use: deflate, shuffle, fletcher32, lzf, blosc, blosc2. Others (nbit,
# bitshuffle) crashed on damaged files, or (lz4, zstd) take the memory that the data declare.
FILTERS = (1, 2, 3, 32000, 32001, 32026)
BLOSC = (32001, 32026)
# How data sets are compressed, and given a checksum, so that a flipped bit is noticed.
PACKING = {**hdf5plugin.Blosc2(cname="zstd", clevel=3), "fletcher32": True}


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
    check_order(events)
    with _written(path, events) as file:
        index = file.create_group("index")
        for name, values in recording.index.items():
            index.create_dataset(name, data=values, **PACKING)
        file.attrs["about"] = json.dumps(recording.about, allow_nan=False)


def read_recording(path: Path) -> Recording:
    """Read a file that `write_recording` wrote.

    Raises:
        ValueError: The file is no such file, is truncated, links to other files, or declares
            more events than `MAX_EVENTS`; nothing is allocated before that is known.
    """
    try:
        check_file(path, MAX_BYTES)
        with h5py.File(path, "r") as file:
            events = _columns(Request(path, max_events=MAX_EVENTS), file)
            index = {}
            _check_own(file, "index")
            for name in file["index"]:
                _declared_length(file, f"index/{name}", MAX_INDEX)
                index[name] = file[f"index/{name}"][:]
            about = json.loads(file.attrs["about"])
    except (OSError, KeyError, ValueError, RuntimeError, TypeError) as error:
        raise ValueError(f"{path} is no readable event recording ({error}); collect it again") from error
    return Recording(events, index, about)


def write_hdf5(path: Path, events: np.ndarray, width: int, height: int) -> None:
    """Write checked events in the layout of DSEC, with the sensor's size as attributes."""
    with _written(path, events) as file:
        file.attrs["width"], file.attrs["height"] = width, height


def read_hdf5(request: Request) -> EventFile:
    """Events of an HDF5 file in the layout of DSEC, `write_hdf5` or `write_recording`.

    Raises:
        ValueError: It has no such layout, is truncated, links to other files, declares more
            than `max_events`, or breaks a rule of `finish`.
    """
    try:
        with h5py.File(request.path, "r") as file:
            request = request.sized(*_sensor(file))
            events = _columns(request, file)
    except (OSError, KeyError, ValueError, RuntimeError, TypeError) as error:
        if str(error).startswith(str(request.path)):
            raise
        raise request.refusal(f"is no readable HDF5 event file ({error}); copy or record it again") from None
    return finish(request, "hdf5", events)


def milliseconds_to_index(t_us: np.ndarray) -> np.ndarray:
    """First event at or after each whole millisecond, as DSEC defines it: t[i[ms]] >= ms * 1000."""
    last_ms = int(t_us[-1]) // 1000 if len(t_us) else 0
    return np.searchsorted(t_us, np.arange(last_ms + 1, dtype=np.int64) * 1000).astype(np.uint64)


@contextlib.contextmanager
def _written(path: Path, events: np.ndarray) -> Iterator[h5py.File]:
    """A new file that holds the events already and takes its name when all is written.

    It is made in memory, where it takes its packed size: HDF5 crashes the process on a full disk.
    """
    offset = int(events["t"][0]) if len(events) else 0
    t_us = events["t"] - offset
    if len(events) and t_us[-1] >= 1000 * MAX_INDEX:
        raise ValueError(
            f"{path}: the hdf5 layout has an index entry for each millisecond and this is {t_us[-1]} us; "
            f"write parts of at most {1000 * MAX_INDEX} us, or choose npz"
        )
    with h5py.File(path.name, "w", driver="core", backing_store=False) as file:
        columns = {"t": t_us, "x": events["x"], "y": events["y"], "p": (events["p"] > 0).astype(np.uint8)}
        for name, values in columns.items():
            file.create_dataset(f"events/{name}", data=values, **PACKING)
        file["t_offset"] = np.int64(offset)
        file["ms_to_idx"] = milliseconds_to_index(t_us)
        yield file
        file.flush()
        image = file.id.get_file_image()
    with replaced(path) as part:
        part.write_bytes(image)


def _sensor(file: h5py.File) -> tuple[int | None, int | None]:
    """Width and height by the attributes, or by the sensor settings of a recording."""
    if "width" in file.attrs and "height" in file.attrs:
        return int(file.attrs["width"]), int(file.attrs["height"])
    about = json.loads(file.attrs.get("about", "{}"))
    sensor = about.get("sensor") if isinstance(about, dict) else None
    if not isinstance(sensor, dict) or not all(type(sensor.get(name)) is int for name in ("width", "height")):
        return None, None
    return sensor["width"], sensor["height"]


def _columns(request: Request, file: h5py.File) -> np.ndarray:
    """The events as they are stored, times with their offset."""
    count = _declared_length(file, "events/t", request.max_events)
    columns = []
    for name in ("t", "x", "y", "p"):
        if _declared_length(file, f"events/{name}", request.max_events) != count:
            raise ValueError(f"events/{name} and events/t differ in length")
        columns.append(file[f"events/{name}"][:])
    t, x, y, p = columns
    offset = 0
    if file.get("t_offset", getlink=True) is not None:
        _check_plain(file, "t_offset", ())
        offset = int(file["t_offset"][()])
    if t.dtype.kind not in "iu" or (len(t) and not 0 <= int(t.max()) + abs(offset) < 1 << 62):
        raise ValueError("events/t are no whole microseconds")
    return assemble(request, t.astype(np.int64) + offset, x, y, p)


def _declared_length(file: h5py.File, name: str, most: int) -> int:
    """Length of a one-dimensional data set of this very file, checked before it is read."""
    _check_plain(file, name, (None,))
    length = len(file[name])
    if length > most:
        raise ValueError(f"{name} declares {length} entries; at most {most} are read")
    check_declared(Path(file.filename), name, length * file[name].dtype.itemsize)
    return length


def _check_plain(file: h5py.File, name: str, shape: tuple[None, ...]) -> None:
    """Refuse links, virtual and external data, other types than numbers, and huge chunks."""
    _check_own(file, name.split("/")[0])
    _check_own(file, name)
    data = file[name]
    if not isinstance(data, h5py.Dataset) or data.ndim != len(shape) or data.external or data.is_virtual:
        raise ValueError(f"{name} is not a plain data set of {len(shape)} dimensions")
    if data.dtype.kind not in "iufb":
        raise ValueError(f"{name} holds {data.dtype}, not numbers")
    if data.chunks and int(np.prod(data.chunks, dtype=object)) * data.dtype.itemsize > MAX_CHUNK_BYTES:
        raise ValueError(f"{name} has chunks of more than {MAX_CHUNK_BYTES} bytes")
    _check_filters(data, name)


def _check_own(file: h5py.File, name: str) -> None:
    """Refuse a name that leads elsewhere, before it is followed: another file would be opened."""
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"{name} is missing or a link")


def _check_filters(data: h5py.Dataset, name: str) -> None:
    """Refuse filters that are unknown, or told another size of elements or chunks than there is."""
    pipeline = data.id.get_create_plist()
    for number in range(pipeline.get_nfilters()):
        code, _, values, _ = pipeline.get_filter(number)
        if code not in FILTERS:
            raise ValueError(f"{name} is packed with the filter {code}; write it again with blosc or gzip")
        sizes = (data.dtype.itemsize, data.dtype.itemsize * data.chunks[0]) if data.chunks else ()
        if code in BLOSC and values[2:4] != sizes:
            raise ValueError(f"{name} describes its packing wrongly")
