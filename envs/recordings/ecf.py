"""Read the events of HDF5 files in Metavision's layout (`/CD/events`), with its ECF packing.

Source: Prophesee's library (github.com/prophesee-ai/hdf5_ecf, Apache 2.0). That filter trusts its
input, so it never runs here; this decoder checks every length.
"""

from collections.abc import Iterator

import h5py
import numba
import numpy as np

from envs.events import EVENT
from envs.recordings.event_file import CUT_PACKETS, TRIGGER, Part, Request, assemble, check_declared
from envs.recordings.hdf5_checks import CUT_ERRORS, check_chunks, filters, is_cut, plain, row_parts

EVENTS, TRIGGERS = "CD/events", "EXT_TRIGGER/events"
FILTER_ECF = 0x8ECF
MAX_CHUNK_EVENTS = 65535
HEADER_BYTES = 12  # number of events and two flags of the packing, then the first time


def metavision_parts(request: Request, file: h5py.File) -> Iterator[Part]:
    """Yield the events of an open file, chunk by chunk, with its triggers first.

    Raises:
        ValueError: The data set has no rows of x, y, p and t, has other filters, or a chunk is damaged.
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
    """Return a data set whose rows have these fields as integers; else raise ValueError."""
    data = plain(file, name, 1)
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
    """Return the external triggers; none if the file has none or packs them with an unknown filter."""
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
    """Yield the events of some chunks, up to the first missing one of a truncated file."""
    for place in places:
        try:
            yield _chunk(request, file[EVENTS], place)
        except CUT_ERRORS:
            if not is_cut(file):
                raise
            request.tally.damage[CUT_PACKETS] += 1
            return


def _chunk(request: Request, data: h5py.Dataset, first: int) -> np.ndarray:
    """Return the events of one chunk, without running its HDF5 filter, which trusts its input."""
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


@numba.njit(cache=True, error_model="numpy")
def decode_ecf(raw: np.ndarray, events: np.ndarray) -> bool:
    """Decode one chunk.

    Args:
        raw: uint8, the stored chunk: times, then y, x and p, or y and (x, p), or (y, x, p) together.
        events: EVENT array to fill, with as many events as the chunk should have.

    Returns:
        Whether the chunk has that many events and is complete.
    """
    if raw.size < HEADER_BYTES:
        return False
    info = _number(raw, 0, 4)
    if info >> 2 != events.size:
        return False
    place = _times(raw, events)
    if info & 2:
        return _packed(raw, place, 24, events) >= 0
    place = _runs(raw, place, 2, events)
    if info & 1:
        return _packed(raw, place, 12, events) >= 0
    return _runs(raw, _columns(raw, place, events), 1, events) >= 0


@numba.njit(cache=True, error_model="numpy")
def _number(raw: np.ndarray, place: int, size: int) -> int:
    """Return a little-endian number of `size` bytes."""
    value = np.int64(0)
    for i in range(size):
        value |= np.int64(raw[place + i]) << 8 * i
    return int(value)


@numba.njit(cache=True, error_model="numpy")
def _length(raw: np.ndarray, place: int, count: int, longest: int) -> tuple[int, int]:
    """Return the number of events of a word, which may take two more bytes, and the next position."""
    if count < longest:
        return count, place
    if place + 2 > raw.size:
        return MAX_CHUNK_EVENTS + 1, place
    return _number(raw, place, 2), place + 2


@numba.njit(cache=True, error_model="numpy")
def _times(raw: np.ndarray, events: np.ndarray) -> int:
    """Decode bytes of a time step and its number of events; return the position after them, or -1."""
    t, n, place = _number(raw, 4, 8), 0, HEADER_BYTES
    step, shift = np.int64(0), 0
    while n < events.size:
        if place >= raw.size:
            return -1
        kind, count = np.int64(raw[place]) >> 4, np.int64(raw[place]) & 15
        place += 1
        if kind == 15:  # four bits of a long step, the lowest first
            if shift >= 64:
                return -1
            step |= count << shift
            shift += 4
            continue
        t += step + kind
        step, shift = np.int64(0), 0
        count, place = _length(raw, place, count, 15)
        if n + count > events.size:
            return -1
        for i in range(n, n + count):
            events[i].t = t
        n += count
    return place


@numba.njit(cache=True, error_model="numpy")
def _runs(raw: np.ndarray, place: int, size: int, events: np.ndarray) -> int:
    """Decode words of y (two bytes) or p (one) and its number of events; return the end position, or -1."""
    n, count_bits = 0, 5 if size == 2 else 7
    longest = (1 << count_bits) - 1
    while place >= 0 and n < events.size:
        if place + size > raw.size:
            return -1
        word = _number(raw, place, size)
        place += size
        count, place = _length(raw, place, word & longest, longest)
        if n + count > events.size:
            return -1
        for i in range(n, n + count):
            if size == 2:
                events[i].y = word >> count_bits
            else:
                events[i].p = 2 * (word >> count_bits) - 1
        n += count
    return place


@numba.njit(cache=True, error_model="numpy")
def _columns(raw: np.ndarray, place: int, events: np.ndarray) -> int:
    """Decode words of x and a mask of the five pixels after it; return the position after them, or -1."""
    n = 0
    while place >= 0 and n < events.size:
        if place + 2 > raw.size:
            return -1
        word = _number(raw, place, 2)
        place += 2
        for i in range(6):  # the writer may mark pixels after the last event
            if n < events.size and (i == 0 or word >> (5 - i) & 1):
                events[n].x = (word >> 5) + i
                n += 1
    return place


@numba.njit(cache=True, error_model="numpy")
def _packed(raw: np.ndarray, place: int, bits: int, events: np.ndarray) -> int:
    """Decode three words per four events of 24 bits (y, x, p) or 12 (x, p); return their end, or -1."""
    size = bits // 6
    shift = 8 * size - bits
    mask = (1 << bits) - 1
    for first in range(0, events.size, 4):
        if place < 0 or place + 3 * size > raw.size:
            return -1
        high = _number(raw, place, size)
        middle = _number(raw, place + size, size)
        low = _number(raw, place + 2 * size, size)
        place += 3 * size
        values = (
            high >> shift,
            (high & (1 << shift) - 1) | middle >> 2 * shift << shift,
            (middle & (1 << 2 * shift) - 1) | low >> 3 * shift << 2 * shift,
            low & mask,
        )
        for i in range(first, min(first + 4, events.size)):
            value = values[i - first]
            events[i].x, events[i].p = value >> 1 & 2047, 2 * (value & 1) - 1
            if bits == 24:
                events[i].y = value >> 12 & 2047
    return place
