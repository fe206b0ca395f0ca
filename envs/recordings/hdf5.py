"""HDF5 event files in the layouts of the DSEC data set and of Metavision, and the project's recordings.

`/events/{t,x,y,p}`, `/t_offset` and `/ms_to_idx` are what other tools read; `/index/*` and
the attribute `about` are ours: where each control step and episode begins, and how the
events were made. Polarity is 0 or 1 on disk, as in DSEC; files with -1 and 1 are read too. Metavision's
`/CD/events` are rows of x, y, p, t, packed by a filter of its own.
"""

import bisect
import contextlib
import dataclasses
import json
import mmap
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np

from core.files import replaced
from envs.events import EVENT
from envs.recordings.ecf import FILTER_ECF, MAX_CHUNK_EVENTS, decode_ecf
from envs.recordings.event_file import (
    MAX_BYTES,
    EventFile,
    Request,
    assemble,
    check_declared,
    check_file,
    check_order,
    finish,
)

MAX_EVENTS = 2_000_000_000
MAX_INDEX = 200_000_000
MAX_CHUNK_BYTES = 1 << 28

# Filters that event files use: deflate, shuffle, fletcher32, lzf, blosc, blosc2. Others (nbit,
# bitshuffle) crashed on damaged files, or (lz4, zstd) take the memory that the data declare.
FILTERS = (1, 2, 3, 32000, 32001, 32026)
BLOSC = (32001, 32026)
FLETCHER32, CHECKSUM_BYTES = 3, 4
SIMPLE = (h5py.h5t.TypeIntegerID, h5py.h5t.TypeFloatID, h5py.h5t.TypeStringID)  # types of attributes
NOISE = "events/is_noise"  # labels, where there are any
HEAP = b"GCOL\1"  # begins a heap of values of variable length, such as the texts of attributes
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

    def count_until(self, t_us: int) -> int:
        """How many events have t <= t_us [us]; numpy's search would copy the times of all."""
        return bisect.bisect_right(self.events["t"], t_us)


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
        _check_heaps(path)
        with h5py.File(path, "r") as file:
            events = _columns(Request(path, max_events=MAX_EVENTS), file)
            index = {}
            _check_own(file, "index")
            for name in file["index"]:
                _declared_length(file, f"index/{name}", MAX_INDEX)
                index[name] = file[f"index/{name}"][:]
            about = json.loads(_attribute(file, "about"))
    except (OSError, KeyError, ValueError, RuntimeError, TypeError, OverflowError) as error:
        raise ValueError(f"{path} is no readable event recording ({error}); collect it again") from error
    return Recording(events, index, about)


def write_hdf5(
    path: Path, events: np.ndarray, width: int, height: int, is_noise: np.ndarray | None = None
) -> None:
    """Write checked events in the layout of DSEC, with the sensor's size as attributes, and labels if any."""
    with _written(path, events) as file:
        file.attrs["width"], file.attrs["height"] = width, height
        if is_noise is not None:
            file.create_dataset(NOISE, data=is_noise.astype(np.uint8), **PACKING)


def read_hdf5(request: Request) -> EventFile:
    """Events of an HDF5 file in the layout of DSEC, Metavision, `write_hdf5` or `write_recording`.

    Raises:
        ValueError: It has no such layout, is truncated, links to other files, declares more
            than `max_events`, or breaks a rule of `finish`.
    """
    try:
        _check_heaps(request.path)
        with h5py.File(request.path, "r") as file:
            request = request.sized(*_sensor(file))
            events = (_metavision if "CD" in file else _columns)(request, file)
            is_noise = _labels(request, file)
    except (OSError, KeyError, ValueError, RuntimeError, TypeError, OverflowError) as error:
        if str(error).startswith(str(request.path)):
            raise
        raise request.refusal(f"is no readable HDF5 event file ({error}); copy or record it again") from None
    return finish(request, "hdf5", events, is_noise=is_noise)


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
    given = file.attrs
    if "width" in given and "height" in given:
        return int(_attribute(file, "width")), int(_attribute(file, "height"))
    geometry = str(_attribute(file, "geometry")) if "geometry" in given else ""
    if found := re.fullmatch(r"(\d{1,5})x(\d{1,5})", geometry, re.ASCII):
        return int(found[1]), int(found[2])
    about = json.loads(_attribute(file, "about")) if "about" in given else {}
    sensor = about.get("sensor") if isinstance(about, dict) else None
    if not isinstance(sensor, dict) or not all(type(sensor.get(name)) is int for name in ("width", "height")):
        return None, None
    return sensor["width"], sensor["height"]


def _attribute(file: h5py.File, name: str) -> Any:
    """One number or text; anything else that a damaged type declares, such as a list, can crash HDF5."""
    stored = file.attrs.get_id(name)
    if stored.shape != () or not isinstance(stored.get_type(), SIMPLE):
        raise ValueError(f"the attribute {name} is no single number or text")
    value = file.attrs[name]
    return value.decode() if isinstance(value, bytes) else value


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
        if offset != file["t_offset"][()]:
            raise ValueError("t_offset is no whole number of microseconds")
    if t.dtype.kind not in "iu" or (len(t) and not 0 <= int(t.max()) + abs(offset) < 1 << 62):
        raise ValueError("events/t are no whole microseconds")
    t = t.astype(np.int64, copy=False)
    t += offset
    return assemble(request, t, x, y, p)


def _labels(request: Request, file: h5py.File) -> np.ndarray | None:
    """Which events are noise, as they are stored, if the file says it."""
    if "CD" in file or file.get(NOISE, getlink=True) is None:
        return None
    _declared_length(file, NOISE, request.max_events)
    return np.asarray(file[NOISE][:])


def _metavision(request: Request, file: h5py.File) -> np.ndarray:
    """The events of Metavision's layout."""
    _check_own(file, "CD")
    _check_own(file, "CD/events")
    data = file["CD/events"]
    if not isinstance(data, h5py.Dataset) or data.ndim != 1 or data.external or data.is_virtual:
        raise ValueError("CD/events is not a plain data set of 1 dimension")
    names = data.dtype.names or ()
    if not all(name in names and data.dtype[name].kind in "iu" for name in "txyp"):
        raise ValueError(f"CD/events holds {data.dtype}, not rows of x, y, p and t")
    request.check_count(len(data))
    check_declared(request.path, "CD/events", data.nbytes)
    if FILTER_ECF not in _filters(data):
        _check_chunks(data, "CD/events")
        rows = data[:]
        return assemble(request, rows["t"], rows["x"], rows["y"], rows["p"])
    if _filters(data) != [FILTER_ECF] or data.chunks[0] > MAX_CHUNK_EVENTS:
        raise ValueError("CD/events has another filter beside Metavision's, or larger chunks")
    parts = [_chunk(request, data, first) for first in range(0, len(data), data.chunks[0])]
    return np.concatenate([np.empty(0, EVENT), *parts])


def _chunk(request: Request, data: h5py.Dataset, first: int) -> np.ndarray:
    """The events of one chunk of Metavision's layout; its filter, which trusts its input, is not run."""
    stored = data.id.get_chunk_info_by_coord((first,)).size
    if stored > request.path.stat().st_size:
        raise ValueError(f"the chunk at event {first} declares {stored} bytes")
    unpacked, raw = data.id.read_direct_chunk((first,))
    events = np.empty(min(data.chunks[0], len(data) - first), EVENT)
    if unpacked:  # a writer without the filter
        rows = np.frombuffer(raw, data.dtype, len(events))
        return assemble(request, rows["t"], rows["x"], rows["y"], rows["p"])
    if not decode_ecf(np.frombuffer(raw, np.uint8), events):
        raise ValueError(f"the chunk at event {first} is damaged")
    return events


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
    _check_chunks(data, name)


def _check_heaps(path: Path) -> None:
    """Refuse a heap of texts with an object that is its own next one: HDF5 would read it for ever."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as raw:
        heap = raw.find(HEAP)
        while heap >= 0:
            place, end = heap + 16, min(len(raw), heap + int.from_bytes(raw[heap + 8 : heap + 16], "little"))
            while place + 16 <= end:
                number, size = struct.unpack_from("<H6xQ", raw, place)
                step = 16 + -(-size // 8) * 8 if number else size  # without a number it is free space
                if step == 0 or step >= 1 << 63:
                    raise ValueError(f"the heap at byte {heap} leads in a circle")
                place += step
            heap = raw.find(HEAP, heap + 1)


def _check_own(file: h5py.File, name: str) -> None:
    """Refuse a name that leads elsewhere, before it is followed: another file would be opened."""
    if not isinstance(file.get(name, getlink=True), h5py.HardLink):
        raise ValueError(f"{name} is missing or a link")


def _check_chunks(data: h5py.Dataset, name: str) -> None:
    """Refuse huge chunks, and filters that are unknown or are told another size of elements or chunks."""
    if data.chunks and int(np.prod(data.chunks, dtype=object)) * data.dtype.itemsize > MAX_CHUNK_BYTES:
        raise ValueError(f"{name} has chunks of more than {MAX_CHUNK_BYTES} bytes")
    pipeline, filters = data.id.get_create_plist(), _filters(data)
    for number, code in enumerate(filters):
        if code not in FILTERS:
            raise ValueError(f"{name} is packed with the filter {code}; write it again with blosc or gzip")
        sizes = (data.dtype.itemsize, data.dtype.itemsize * data.chunks[0]) if data.chunks else ()
        if code in BLOSC and pipeline.get_filter(number)[2][2:4] != sizes:
            raise ValueError(f"{name} describes its packing wrongly")
    if FLETCHER32 in filters[:-1]:  # what decompression leaves may be too short for it
        raise ValueError(f"{name} has its checksum within its compression; write it again without fletcher32")
    if FLETCHER32 in filters and data.id.chunk_iter(_too_short):
        raise ValueError(f"{name} has a chunk without its checksum")


def _too_short(chunk: Any) -> bool | None:
    """Whether a stored chunk has no room for its checksum, in front of which HDF5 would look for it."""
    return chunk.size < CHECKSUM_BYTES or None


def _filters(data: h5py.Dataset) -> list[int]:
    """Numbers of the filters that packed a data set."""
    pipeline = data.id.get_create_plist()
    return [pipeline.get_filter(number)[0] for number in range(pipeline.get_nfilters())]
