"""Kernels that decode the words of Prophesee's encodings EVT 2.0, EVT 2.1 and EVT 3.0.

Call a decoder once with empty `events` to count, and once with room for all of them. It returns
the number of events, the number of events skipped because their time or row was not yet known,
and the index of the first word of a reserved type, or -1.
"""

from enum import IntEnum

import numba
import numpy as np

FIRST_VENDOR_TYPE = 14  # words of this type and above are the vendor's own, in all encodings


class Evt2(IntEnum):
    """Types of EVT 2.0 and EVT 2.1 words (docs.prophesee.ai)."""

    OFF = 0
    ON = 1
    TIME_HIGH = 8
    TRIGGER = 10


class Evt3(IntEnum):
    """Types of EVT 3.0 words (docs.prophesee.ai)."""

    ROW = 0
    EVENT = 2
    VECTOR_BASE = 3
    VECTOR_12 = 4
    VECTOR_8 = 5
    TIME_LOW = 6
    CONTINUED_4 = 7
    TIME_HIGH = 8
    TRIGGER = 10


@numba.njit(cache=True, error_model="numpy")
def _bits(mask: int) -> int:
    """How many of the lowest 32 bits are set."""
    mask -= mask >> 1 & 0x55555555
    mask = (mask & 0x33333333) + (mask >> 2 & 0x33333333)
    return ((mask + (mask >> 4) & 0x0F0F0F0F) * 0x01010101 & 0xFFFFFFFF) >> 24


@numba.njit(cache=True, error_model="numpy")
def _emit(events: np.ndarray, n: int, mask: int, t: int, x: int, y: int, p: int) -> int:
    """One event for each bit of the mask, at x + bit; the number of events after it."""
    if n >= events.size:
        return n + _bits(mask)
    while mask:
        if mask & 1:
            event = events[n]
            event.t, event.x, event.y, event.p = t, x, y, p
            n += 1
        x += 1
        mask >>= 1
    return n


@numba.njit(cache=True, error_model="numpy")
def _time_base(value: int, base: int) -> int:
    """The time of a new high part [us]; the 34-bit clock began again if it fell by half its range."""
    if base < 0:
        return value << 6
    if value < (base >> 6 & 0xFFFFFFF) - (1 << 27):
        base += 1 << 34
    return (base >> 34 << 34) | value << 6


@numba.njit(cache=True, error_model="numpy")
def decode_evt2(words: np.ndarray, masks: np.ndarray, events: np.ndarray) -> tuple[int, int, int]:
    """Decode EVT 2.0, or EVT 2.1 from the upper halves of its words and their masks.

    Args:
        words: uint32 (N,): type 4 bits, low time 6 bits, x 11 bits, y 11 bits.
        masks: uint32 (N,): which of the 32 pixels from x on have an event; empty for EVT 2.0.
        events: EVENT array to fill.
    """
    n, skipped, base = 0, 0, np.int64(-1)
    for i in range(words.size):
        word = np.int64(words[i])
        kind = word >> 28
        if kind == Evt2.OFF or kind == Evt2.ON:
            mask = np.int64(masks[i]) if masks.size else np.int64(1)
            if base < 0:
                skipped += _bits(mask)
            else:
                t = base | (word >> 22 & 63)
                n = _emit(events, n, mask, t, word >> 11 & 2047, word & 2047, 2 * kind - 1)
        elif kind == Evt2.TIME_HIGH:
            base = _time_base(word & 0xFFFFFFF, base)
        elif kind != Evt2.TRIGGER and kind < FIRST_VENDOR_TYPE:
            return n, skipped, i
    return n, skipped, -1


class Stream(IntEnum):
    """Places in the memory of an EVT 3.0 stream."""

    HIGH = 0  # upper and lower 12 bits of the clock
    LOW = 1
    TURNS = 2  # how often the 24-bit clock began again
    Y = 3
    X = 4
    P = 5


STREAM_SIZE = len(Stream)


@numba.njit(cache=True, error_model="numpy")
def decode_evt3(words: np.ndarray, events: np.ndarray) -> tuple[int, int, int]:
    """Decode EVT 3.0.

    The low part of the time counts as zero from a changed high part until the next low part.

    Args:
        words: uint16 (N,): type 4 bits, value 12 bits.
        events: EVENT array to fill.
    """
    n, skipped = 0, 0
    stream = np.zeros(STREAM_SIZE, np.int64)
    stream[Stream.HIGH], stream[Stream.Y] = -1, -1
    for i in range(words.size):
        kind, value = np.int64(words[i]) >> 12, np.int64(words[i]) & 0xFFF
        mask, advance = 0, 0
        if kind == Evt3.VECTOR_12:
            mask, advance = int(value), 12
        elif kind == Evt3.VECTOR_8:
            mask, advance = int(value & 255), 8
        elif kind == Evt3.EVENT or kind == Evt3.VECTOR_BASE:
            stream[Stream.X], stream[Stream.P] = value & 2047, 2 * (value >> 11) - 1
            mask = 1 if kind == Evt3.EVENT else 0
        elif not _take_row_or_time(kind, value, stream):
            return n, skipped, i
        if mask:
            n, skipped = _emit_vector(events, n, skipped, mask, stream)
        stream[Stream.X] += advance
    return n, skipped, -1


@numba.njit(cache=True, error_model="numpy")
def _emit_vector(events: np.ndarray, n: int, skipped: int, mask: int, stream: np.ndarray) -> tuple[int, int]:
    """Events of a mask, or skipped ones where time, row or polarity are not yet known."""
    if stream[Stream.HIGH] < 0 or stream[Stream.Y] < 0 or stream[Stream.P] == 0:
        return n, skipped + _bits(mask)
    t = stream[Stream.TURNS] << 24 | stream[Stream.HIGH] << 12 | stream[Stream.LOW]
    return _emit(events, n, mask, t, stream[Stream.X], stream[Stream.Y], stream[Stream.P]), skipped


@numba.njit(cache=True, error_model="numpy")
def _take_row_or_time(kind: int, value: int, stream: np.ndarray) -> bool:
    """Take a word that makes no event into the stream's memory; False for a reserved type."""
    if kind == Evt3.ROW:
        stream[Stream.Y] = value & 2047
    elif kind == Evt3.TIME_LOW:
        stream[Stream.LOW] = value
    elif kind == Evt3.TIME_HIGH:
        if value < stream[Stream.HIGH] - 2048:  # the 24-bit clock began again
            stream[Stream.TURNS] += 1
        if value != stream[Stream.HIGH]:
            stream[Stream.HIGH], stream[Stream.LOW] = value, 0
    else:
        return kind == Evt3.CONTINUED_4 or kind == Evt3.TRIGGER or kind >= FIRST_VENDOR_TYPE
    return True
