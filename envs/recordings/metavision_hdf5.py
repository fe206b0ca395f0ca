"""Read the events of HDF5 files in Metavision's layout (`/CD/events`), with its ECF packing."""

from collections.abc import Iterator

import h5py
import numpy as np

from envs.events import EVENT
from envs.recordings.ecf import FILTER_ECF, MAX_CHUNK_EVENTS, decode_ecf
from envs.recordings.event_file import CUT_PACKETS, TRIGGER, Part, Request, assemble, check_declared
from envs.recordings.hdf5_checks import CUT_ERRORS, check_chunks, check_own, filters, is_cut, row_parts

EVENTS, TRIGGERS = "CD/events", "EXT_TRIGGER/events"


def metavision_parts(request: Request, file: h5py.File) -> Iterator[Part]:
    """Yield the events of an open file, chunk by chunk, with its triggers first.

    Raises:
        ValueError: The data set is no rows of x, y, p and t, has other filters, or a chunk is damaged.
    """
    data = _rows(file, EVENTS, "xypt")
    request.check_declared(len(data))
    check_declared(request.path, EVENTS, data.nbytes)
    triggers = _triggers(request, file)
    request.tally.skipped += len(triggers)
    if FILTER_ECF not in filters(data):
        check_chunks(data, EVENTS)
        for rows in row_parts(request, [data]):
            yield _assembled(request, data[rows])._replace(triggers=triggers)
            triggers = triggers[:0]
        return
    if filters(data) != [FILTER_ECF] or data.chunks[0] > MAX_CHUNK_EVENTS:
        raise ValueError(f"{EVENTS} has another filter beside Metavision's, or larger chunks")
    chunks = max(1, request.part_events // data.chunks[0])
    for first in range(0, len(data), chunks * data.chunks[0]):
        places = range(first, min(len(data), first + chunks * data.chunks[0]), data.chunks[0])
        some = [np.empty(0, EVENT), *_chunks(request, file, places)]
        yield Part(np.concatenate(some), None, triggers)
        triggers = triggers[:0]
        if request.tally.damage[CUT_PACKETS]:
            return


def _rows(file: h5py.File, name: str, fields: str | tuple[str, ...]) -> h5py.Dataset:
    """Return a data set of rows with some fields of whole numbers."""
    check_own(file, name.split("/")[0])
    check_own(file, name)
    data = file[name]
    if not isinstance(data, h5py.Dataset) or data.ndim != 1 or data.external or data.is_virtual:
        raise ValueError(f"{name} is not a plain data set of 1 dimension")
    names = data.dtype.names or ()
    if not all(field in names and data.dtype[field].kind in "iu" for field in fields):
        raise ValueError(
            f"{name} contains {data.dtype}, not rows of {', '.join(fields[:-1])} and {fields[-1]}"
        )
    return data


def _assembled(request: Request, rows: np.ndarray) -> Part:
    """Return rows as events."""
    return assemble(request, rows["t"], rows["x"], rows["y"], rows["p"])


def _triggers(request: Request, file: h5py.File) -> np.ndarray:
    """Return the external triggers, if the file has them unpacked or packed with a known filter."""
    try:
        data = _rows(file, TRIGGERS, ("t", "p", "id"))
        check_chunks(data, TRIGGERS)
        check_declared(request.path, TRIGGERS, data.nbytes)
        rows = data[:]
    except (KeyError, ValueError):
        return np.empty(0, TRIGGER)
    triggers = np.zeros(len(rows), TRIGGER)
    triggers["t"], triggers["channel"] = rows["t"], rows["id"]
    triggers["p"] = np.where(rows["p"] > 0, 1, -1)
    return triggers


def _chunks(request: Request, file: h5py.File, places: range) -> Iterator[np.ndarray]:
    """Yield the events of some chunks, up to the first that is missing in a file that was cut off."""
    for place in places:
        try:
            yield _chunk(request, file[EVENTS], place)
        except CUT_ERRORS:
            if not is_cut(file):
                raise
            request.tally.damage[CUT_PACKETS] += 1
            return


def _chunk(request: Request, data: h5py.Dataset, first: int) -> np.ndarray:
    """Return the events of one chunk; its filter, which trusts its input, is not run."""
    stored = data.id.get_chunk_info_by_coord((first,)).size
    if stored > request.path.stat().st_size:
        raise ValueError(f"the chunk at event {first} declares {stored} bytes")
    unpacked, raw = data.id.read_direct_chunk((first,))
    events = np.empty(min(data.chunks[0], len(data) - first), EVENT)
    if unpacked:  # a writer without the filter
        return _assembled(request, np.frombuffer(raw, data.dtype, len(events))).events
    if not decode_ecf(np.frombuffer(raw, np.uint8), events):
        raise ValueError(f"the chunk at event {first} is damaged")
    return events
