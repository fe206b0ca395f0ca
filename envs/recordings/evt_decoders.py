"""Kernels that decode the words of Prophesee's DAT and of its encodings EVT 2.0, EVT 2.1 and EVT 3.0.

Call a decoder of EVT once with empty `events` to count, and once with room for all of them. It returns
the number of events, the number of events skipped because their time or row was not yet known, the number
of stray high parts of the time (EVT 3.0: of the second call), and the index of the first word of a
reserved type or beyond the last column, or -1.

A high part of the time is stray if it lies more than a second from the time before it and one of the next
few is near that time again: a flipped bit, not a gap. It is passed over; taken for the time, it would move
every later event by a turn of the clock.
"""

from enum import IntEnum

import numba
import numpy as np

FIRST_VENDOR_TYPE = 14  # words of this type and above are the vendor's own, in all encodings
COLUMNS = 1 << 11  # that an address of 11 bits tells apart; a vector may not reach beyond them
FAR_US = 1_000_000  # as far as events may be out of order
LOOK_AHEAD = 16  # high parts


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


# One bit for each type that EVT 3.0 does not have.
RESERVED_EVT3 = sum(1 << kind for kind in range(FIRST_VENDOR_TYPE) if kind not in set(Evt3))


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
        event = events[n]
        event.t, event.x, event.y, event.p = t, x + _bits((mask & -mask) - 1), y, p
        n += 1
        mask &= mask - 1
    return n


@numba.njit(cache=True, error_model="numpy")
def _time_base(value: int, base: int, low_bits: int, high_bits: int) -> int:
    """The time of a new high part [us]; the clock began again if that fell by more than half its range."""
    bits = low_bits + high_bits
    if base < 0:
        return value << low_bits
    if value < (base >> low_bits & (1 << high_bits) - 1) - (1 << high_bits - 1):
        base += 1 << bits
    return (base >> bits << bits) | value << low_bits


@numba.njit(cache=True, error_model="numpy")
def _is_far(value: int, base: int, low_bits: int, high_bits: int) -> bool:
    """Whether a high part lies more than a second from the time before it."""
    return abs(_time_base(value, base, low_bits, high_bits) - base) > FAR_US


@numba.njit(cache=True, error_model="numpy")
def _is_stray(words: np.ndarray, place: int, base: int, low_bits: int, high_bits: int) -> bool:
    """Whether a high part far from the time before it is stray; the first one if the next two are earlier."""
    value, seen = np.int64(words[place]) & (1 << high_bits) - 1, 0
    for i in range(place + 1, words.size):
        word = np.int64(words[i])
        if word >> high_bits != Evt2.TIME_HIGH:  # the same type in EVT 3.0
            continue
        later = word & (1 << high_bits) - 1
        seen += 1
        if base < 0:
            if later >= value or not _is_far(later, value << low_bits, low_bits, high_bits):
                return False
            if seen == 2:
                return True
        elif not _is_far(later, base, low_bits, high_bits):
            return True
        elif seen == LOOK_AHEAD:
            return False
    return base < 0 and seen > 0


@numba.njit(cache=True, error_model="numpy")
def _next_base(words: np.ndarray, place: int, base: int, low_bits: int, high_bits: int) -> int:
    """The time of the high part in a word [us], or -1 if it is stray."""
    later = _time_base(np.int64(words[place]) & (1 << high_bits) - 1, base, low_bits, high_bits)
    if abs(later - base) > FAR_US and _is_stray(words, place, base, low_bits, high_bits):
        return -1
    return later


@numba.njit(cache=True, error_model="numpy")
def _first_beyond(words: np.ndarray, masks: np.ndarray) -> int:
    """Index of the first word of EVT 2.1 that reaches beyond the last column, or -1."""
    for i in range(masks.size):
        kind, x = np.int64(words[i]) >> 28, np.int64(words[i]) >> 11 & 2047
        is_event = kind == Evt2.OFF or kind == Evt2.ON
        if is_event and x > COLUMNS - 32 and np.int64(masks[i]) >> (COLUMNS - x):
            return i
    return -1


@numba.njit(cache=True, error_model="numpy")
def decode_evt2(words: np.ndarray, masks: np.ndarray, events: np.ndarray) -> tuple[int, int, int, int]:
    """Decode EVT 2.0, or EVT 2.1 from the upper halves of its words and their masks.

    Args:
        words: uint32 (N,): type 4 bits, low time 6 bits, x 11 bits, y 11 bits.
        masks: uint32 (N,): which of the 32 pixels from x on have an event; empty for EVT 2.0.
        events: EVENT array to fill.
    """
    beyond = _first_beyond(words, masks)
    if beyond >= 0:
        return 0, 0, 0, beyond
    n, skipped, strays, base = 0, 0, 0, np.int64(-1)
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
            later = _next_base(words, i, base, 6, 28)
            strays += later < 0
            base = base if later < 0 else later
        elif kind != Evt2.TRIGGER and kind < FIRST_VENDOR_TYPE:
            return n, skipped, strays, i
    return n, skipped, strays, -1


@numba.njit(cache=True, error_model="numpy")
def decode_evt3(words: np.ndarray, events: np.ndarray) -> tuple[int, int, int, int]:
    """Decode EVT 3.0.

    The low part of the time counts as zero from a changed high part until the next low part.

    Args:
        words: uint16 (N,): type 4 bits, value 12 bits.
        events: EVENT array to fill, empty or of exactly the counted size.
    """
    start = _first_known(words)
    if events.size:
        strays, beyond = _fill_evt3(words, start, events)
        return events.size, 0, strays, beyond
    skipped, bad_before = _count_evt3(words[:start])
    n, bad_after = _count_evt3(words[start:])
    return n, skipped, 0, _first_reserved(words) if bad_before or bad_after else -1


@numba.njit(cache=True, error_model="numpy")
def _first_known(words: np.ndarray) -> int:
    """Index of the word from which on time, row and polarity are known; N if they never are."""
    time, row, polarity = False, False, False
    for i in range(words.size):
        kind = np.int64(words[i]) >> 12
        time |= kind == Evt3.TIME_HIGH and not _is_stray(words, i, -1, 12, 12)
        row |= kind == Evt3.ROW
        polarity |= kind == Evt3.EVENT or kind == Evt3.VECTOR_BASE
        if time and row and polarity:
            return i
    return words.size


@numba.njit(cache=True, error_model="numpy")
def _first_reserved(words: np.ndarray) -> int:
    """Index of the first word of a type that EVT 3.0 does not have, or -1."""
    for i in range(words.size):
        if RESERVED_EVT3 >> (np.int64(words[i]) >> 12) & 1:
            return i
    return -1


@numba.njit(cache=True, error_model="numpy")
def _mask(kind: int, value: int) -> int:
    """Which of the pixels from x on have an event by an EVT 3.0 word."""
    if kind == Evt3.VECTOR_12:
        return value
    return value & 255 if kind == Evt3.VECTOR_8 else int(kind == Evt3.EVENT)


@numba.njit(cache=True, error_model="numpy")
def _count_evt3(words: np.ndarray) -> tuple[int, bool]:
    """Number of events, and whether a type is reserved; no branches, so several words go at once."""
    n, reserved = 0, np.int64(0)
    for i in range(words.size):
        word = np.int64(words[i])
        n += _bits(_mask(word >> 12, word & 0xFFF))
        reserved |= RESERVED_EVT3 >> (word >> 12)
    return n, reserved & 1 == 1


@numba.njit(cache=True, error_model="numpy")
def _fill_evt3(words: np.ndarray, start: int, events: np.ndarray) -> tuple[int, int]:
    """Write the events of the words from `start` on; the words before it only say where and when.

    Returns:
        Number of stray high parts of the time, and the index of a vector beyond the last column or -1.
    """
    n, i, strays, beyond, base = 0, 0, 0, -1, np.int64(-1)
    x = y = p = low = np.int64(0)
    while n < events.size and beyond < 0:
        kind, value = np.int64(words[i]) >> 12, np.int64(words[i]) & 0xFFF
        if kind == Evt3.EVENT or kind == Evt3.VECTOR_BASE:
            x, p = value & 2047, 2 * (value >> 11) - 1
            if kind == Evt3.EVENT:
                n = _emit(events, n, 1, base | low, x, y, p) if i >= start else n
        elif kind == Evt3.ROW:
            y = value & 2047
        elif kind == Evt3.VECTOR_12 or kind == Evt3.VECTOR_8:
            mask = _mask(kind, value)
            beyond = i if x > COLUMNS - 12 and mask >> max(COLUMNS - x, 0) else -1
            n = _emit(events, n, mask, base | low, x, y, p) if i >= start else n
            x += 12 if kind == Evt3.VECTOR_12 else 8
        elif kind == Evt3.TIME_LOW:
            low = value
        elif kind == Evt3.TIME_HIGH:
            later = _next_base(words, i, base, 12, 12)
            strays += later < 0
            low = low if later < 0 or later == base else np.int64(0)
            base = base if later < 0 else later
        i += 1
    return strays, beyond


@numba.njit(cache=True, error_model="numpy")
def decode_dat(words: np.ndarray, events: np.ndarray) -> None:
    """Decode DAT, whose clock of 32 bits is unwrapped as by `unwrap`.

    Args:
        words: Shape (N,), fields t and data, uint32: x 14 bits, y 14 bits, polarity 1 bit.
        events: EVENT array (N,) to fill.
    """
    t, half = np.int64(0), 1 << 31
    for i in range(events.size):
        step = np.int64(words[i].t) - t
        t += (step + half & 2 * half - 1) - half if i else step
        t += 2 * half if t < 0 else 0
        data, event = words[i].data, events[i]
        event.t, event.x, event.y = t, data & 0x3FFF, data >> 14 & 0x3FFF
        event.p = 2 * np.int8(data >> 28 & 1) - 1
