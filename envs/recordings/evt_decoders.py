"""Decode the words of Prophesee's DAT and of its encodings EVT 2.0, EVT 2.1 and EVT 3.0, in kernels.

An EVT decoder is called once for each part: it continues from its state, and fills arrays of events and
triggers until one of them is full or the words end.

A high part of the time is stray if it lies more than a second from the previous time and one of the next few
is near the previous time again: a flipped bit, not a gap. It is skipped; otherwise it would move every later
event by a wrap of the clock.
"""

from enum import IntEnum

import numba
import numpy as np

FIRST_VENDOR_TYPE = 14  # words of this type and above are the vendor's own, in all encodings
COLUMNS = 1 << 11  # columns that an 11-bit address can represent
FAR_US = 1_000_000  # limit of disorder among events
LOOK_AHEAD = 16  # number of high parts


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


class State(IntEnum):
    """Indices of a decoder's state, int64: its position, the current values, and its counts."""

    WORD = 0  # index of the next word
    BASE = 1  # high part of the time [us]; -1: not known yet
    LOW = 2  # low part of the time [us]
    X = 3
    Y = 4  # -1: not known yet
    P = 5  # 0: not known yet
    SKIPPED = 6  # events before the first time, row or polarity; triggers; padding
    STRAYS = 7  # stray high parts of the time
    RESERVED = 8  # words of types that the encoding does not have
    BEYOND = 9  # events beyond the last column


PADDING = 9  # type of the words with which a camera pads its packets (data sheet of the IMX636)
# One bit for each type that EVT 3.0 does not have.
RESERVED_EVT3 = sum(1 << kind for kind in range(FIRST_VENDOR_TYPE) if kind not in {*Evt3, PADDING})


def new_state() -> np.ndarray:
    """Return the initial state of a decoder."""
    state = np.zeros(len(State), np.int64)
    state[State.BASE] = state[State.Y] = -1
    return state


@numba.njit(cache=True, error_model="numpy")
def _bits(mask: int) -> int:
    """Return how many of the lowest 32 bits are set."""
    mask -= mask >> 1 & 0x55555555
    mask = (mask & 0x33333333) + (mask >> 2 & 0x33333333)
    return ((mask + (mask >> 4) & 0x0F0F0F0F) * 0x01010101 & 0xFFFFFFFF) >> 24


@numba.njit(cache=True, error_model="numpy")
def _emit(events: np.ndarray, n: int, mask: int, t: int, x: int, y: int, p: int) -> int:
    """Write one event for each bit of the mask, at x + bit; return the number of events after it."""
    while mask:
        event = events[n]
        event.t, event.x, event.y, event.p = t, x + _bits((mask & -mask) - 1), y, p
        n += 1
        mask &= mask - 1
    return n


@numba.njit(cache=True, error_model="numpy")
def _inside(mask: int, x: int) -> int:
    """Return the bits of a mask that lie within the last column."""
    if x > COLUMNS - 32:
        mask &= (1 << max(COLUMNS - x, 0)) - 1
    return mask


@numba.njit(cache=True, error_model="numpy")
def _trigger(triggers: np.ndarray, k: int, t: int, channel: int, is_rising: int) -> int:
    """Write one trigger; return the number of triggers after it."""
    trigger = triggers[k]
    trigger.t, trigger.channel, trigger.p = t, channel, 2 * is_rising - 1
    return k + 1


@numba.njit(cache=True, error_model="numpy")
def _time_base(value: int, base: int, low_bits: int, high_bits: int) -> int:
    """Return the time of a new high part [us]; a fall by more than half its range is a wrap of the clock."""
    bits = low_bits + high_bits
    if base < 0:
        return value << low_bits
    if value < (base >> low_bits & (1 << high_bits) - 1) - (1 << high_bits - 1):
        base += 1 << bits
    return (base >> bits << bits) | value << low_bits


@numba.njit(cache=True, error_model="numpy")
def _is_far(value: int, base: int, low_bits: int, high_bits: int) -> bool:
    """Whether a high part lies more than a second from the previous time."""
    return abs(_time_base(value, base, low_bits, high_bits) - base) > FAR_US


@numba.njit(cache=True, error_model="numpy")
def _is_stray(words: np.ndarray, place: int, base: int, low_bits: int, high_bits: int) -> bool:
    """Whether a high part far from the previous time is stray; the first one, if the next two are earlier."""
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
    """Return the time of the high part in a word [us], or -1 if it is stray."""
    later = _time_base(np.int64(words[place]) & (1 << high_bits) - 1, base, low_bits, high_bits)
    if abs(later - base) > FAR_US and _is_stray(words, place, base, low_bits, high_bits):
        return -1
    return later


@numba.njit(cache=True, error_model="numpy")
def decode_evt2(
    words: np.ndarray, masks: np.ndarray, state: np.ndarray, events: np.ndarray, triggers: np.ndarray
) -> tuple[int, int]:
    """Decode EVT 2.0, or EVT 2.1 from the upper halves of its words and their masks.

    Args:
        words: uint32 (N,): type 4 bits, low time 6 bits, x 11 bits, y 11 bits.
        masks: uint32 (N,): which of the 32 pixels from x on have an event; empty for EVT 2.0.
        state: From `new_state`; updated in place.
        events: EVENT array of at least 32 events to fill.
        triggers: TRIGGER array to fill.

    Returns:
        Numbers of events and of triggers.
    """
    n, k, i, base = 0, 0, state[State.WORD], state[State.BASE]
    while i < words.size and n <= events.size - 32 and k < triggers.size:
        word = np.int64(words[i])
        kind = word >> 28
        if kind == Evt2.OFF or kind == Evt2.ON:
            mask, x = np.int64(masks[i]) if masks.size else np.int64(1), word >> 11 & 2047
            if base < 0:
                state[State.SKIPPED] += _bits(mask)
            else:
                inside = _inside(mask, x)
                state[State.BEYOND] += _bits(mask) - _bits(inside)
                n = _emit(events, n, inside, base | (word >> 22 & 63), x, word & 2047, 2 * kind - 1)
        elif kind == Evt2.TIME_HIGH:
            later = _next_base(words, i, base, 6, 28)
            state[State.STRAYS] += later < 0
            base = base if later < 0 else later
        elif kind == Evt2.TRIGGER:
            state[State.SKIPPED] += 1
            if base >= 0:
                k = _trigger(triggers, k, base | (word >> 22 & 63), word >> 8 & 31, word & 1)
        elif kind < FIRST_VENDOR_TYPE:
            state[State.RESERVED] += 1
        i += 1
    state[State.WORD], state[State.BASE] = i, base
    return n, k


@numba.njit(cache=True, error_model="numpy")
def decode_evt3(  # noqa: C901  a branch for each type of word
    words: np.ndarray, state: np.ndarray, events: np.ndarray, triggers: np.ndarray
) -> tuple[int, int]:
    """Decode EVT 3.0.

    After a changed high part the low part of the time is zero until the next low part.

    Args:
        words: uint16 (N,): type 4 bits, value 12 bits.
        state: From `new_state`; updated in place.
        events: EVENT array of at least 12 events to fill.
        triggers: TRIGGER array to fill.

    Returns:
        Numbers of events and of triggers.
    """
    n, k, i, base, low = 0, 0, state[State.WORD], state[State.BASE], state[State.LOW]
    x, y, p = state[State.X], state[State.Y], state[State.P]
    while i < words.size and n <= events.size - 12 and k < triggers.size:
        kind, value = np.int64(words[i]) >> 12, np.int64(words[i]) & 0xFFF
        i += 1
        if kind == Evt3.EVENT or kind == Evt3.VECTOR_BASE:
            x, p = value & 2047, 2 * (value >> 11) - 1
            if kind == Evt3.VECTOR_BASE:
                continue
        elif kind == Evt3.ROW:
            y = value & 2047
        elif kind == Evt3.TIME_LOW:
            low = value
        elif kind == Evt3.TIME_HIGH:
            later = _next_base(words, i - 1, base, 12, 12)
            state[State.STRAYS] += later < 0
            low = low if later < 0 or later == base else np.int64(0)
            base = base if later < 0 else later
        elif kind == Evt3.TRIGGER:
            state[State.SKIPPED] += 1
            if base >= 0:
                k = _trigger(triggers, k, base | low, value >> 8, value & 1)
        elif kind == PADDING:
            state[State.SKIPPED] += 1
        elif RESERVED_EVT3 >> kind & 1:
            state[State.RESERVED] += 1
        mask = _mask(kind, value)
        if mask:
            if base < 0 or y < 0 or p == 0:
                state[State.SKIPPED] += _bits(mask)
            else:
                inside = _inside(mask, x)
                state[State.BEYOND] += _bits(mask) - _bits(inside)
                n = _emit(events, n, inside, base | low, x, y, p)
        if kind == Evt3.VECTOR_12 or kind == Evt3.VECTOR_8:
            x += 12 if kind == Evt3.VECTOR_12 else 8
    state[State.WORD], state[State.BASE], state[State.LOW] = i, base, low
    state[State.X], state[State.Y], state[State.P] = x, y, p
    return n, k


@numba.njit(cache=True, error_model="numpy")
def _mask(kind: int, value: int) -> int:
    """Return the mask of the pixels from x on for which an EVT 3.0 word has an event."""
    if kind == Evt3.VECTOR_12:
        return value
    return value & 255 if kind == Evt3.VECTOR_8 else int(kind == Evt3.EVENT)


@numba.njit(cache=True, error_model="numpy")
def decode_dat(words: np.ndarray, last_us: int, events: np.ndarray) -> None:
    """Decode DAT; unwrap its 32-bit clock as in `clocks.unwrap`.

    Args:
        words: Shape (N,), fields t and data, uint32: x 14 bits, y 14 bits, polarity 1 bit.
        last_us: The previous time [us]; -1: none.
        events: EVENT array (N,) to fill.
    """
    t, full, half = np.int64(last_us), np.int64(1) << 32, np.int64(1) << 31
    for i in range(events.size):
        value = np.int64(words[i].t)
        if t < 0:
            t = value
        else:
            t += ((value - t + half) & (full - 1)) - half
            t += full if t < 0 else 0
        data, event = words[i].data, events[i]
        event.t, event.x, event.y = t, data & 0x3FFF, data >> 14 & 0x3FFF
        event.p = 2 * np.int8(data >> 28 & 1) - 1
