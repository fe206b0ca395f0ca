"""The packing of events in HDF5 files of Prophesee's tools (ECF), one chunk at a time.

Their library (github.com/prophesee-ai/hdf5_ecf, Apache 2.0) is the format's description. It trusts
its input; here every length is checked, and the filter itself never runs.
"""

import numba
import numpy as np

FILTER_ECF = 0x8ECF
MAX_CHUNK_EVENTS = 65535
HEADER_BYTES = 12  # number of events and two marks of the packing, then the first time


@numba.njit(cache=True, error_model="numpy")
def decode_ecf(raw: np.ndarray, events: np.ndarray) -> bool:
    """Decode one chunk.

    Args:
        raw: uint8, the stored chunk: times, then y, x and p, or y and (x, p), or (y, x, p) together.
        events: EVENT array of as many events as the chunk should have.

    Returns:
        Whether it has that many, and all of it is there.
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
    """Return a little-endian number of so many bytes."""
    value = np.int64(0)
    for i in range(size):
        value |= np.int64(raw[place + i]) << 8 * i
    return int(value)


@numba.njit(cache=True, error_model="numpy")
def _length(raw: np.ndarray, place: int, count: int, longest: int) -> tuple[int, int]:
    """Read how many events a word stands for, in two more bytes if they are many, and the next place."""
    if count < longest:
        return count, place
    if place + 2 > raw.size:
        return MAX_CHUNK_EVENTS + 1, place
    return _number(raw, place, 2), place + 2


@numba.njit(cache=True, error_model="numpy")
def _times(raw: np.ndarray, events: np.ndarray) -> int:
    """Bytes of a step in time and how many events share it; where they end, or -1."""
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
    """Words of y (two bytes) or p (one) and how many events share it; where they end, or -1."""
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
    """Words of x and which of the five pixels after it have an event too; where they end, or -1."""
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
    """Three words for each four events, of 24 bits (y, x, p) or 12 (x, p); where they end, or -1."""
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
        for i in range(first, min(first + 4, events.size)):
            if i == first:
                value = high >> shift
            elif i == first + 1:
                value = (high & (1 << shift) - 1) | middle >> 2 * shift << shift
            elif i == first + 2:
                value = (middle & (1 << 2 * shift) - 1) | low >> 3 * shift << 2 * shift
            else:
                value = low & mask
            events[i].x, events[i].p = value >> 1 & 2047, 2 * (value & 1) - 1
            if bits == 24:
                events[i].y = value >> 12 & 2047
    return place
