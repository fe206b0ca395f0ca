"""Kernels that decode the words of Prophesee's encodings EVT 2.0, EVT 2.1 and EVT 3.0.

Every kernel only counts if it is given no `events`; so it is called once with none, to learn
the number, and once with room for all. It gives the number of
events, the number of entries skipped because their time or row was not yet known, and the
index of the first word of a reserved type, or -1.
"""

import numba
import numpy as np

HIGH, LOW, TURNS, Y, X, P, ADVANCE = range(7)  # what an EVT 3.0 stream remembers


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
        if kind <= 1:
            mask = np.int64(masks[i]) if masks.size else np.int64(1)
            if base < 0:
                skipped += _bits(mask)
            else:
                t = base | (word >> 22 & 63)
                n = _emit(events, n, mask, t, word >> 11 & 2047, word & 2047, 2 * kind - 1)
        elif kind == 8:
            base = _time_base(word & 0xFFFFFFF, base)
        elif kind != 10 and kind < 14:  # neither a trigger nor a vendor's word
            return n, skipped, i
    return n, skipped, -1


@numba.njit(cache=True, error_model="numpy")
def decode_evt3(words: np.ndarray, events: np.ndarray) -> tuple[int, int, int]:
    """Decode EVT 3.0.

    The low part of the time counts as zero from a changed high part until the next low part.

    Args:
        words: uint16 (N,): type 4 bits, value 12 bits.
        events: EVENT array to fill.
    """
    n, skipped = 0, 0
    state = np.zeros(7, np.int64)
    state[HIGH], state[Y] = -1, -1
    for i in range(words.size):
        mask = _evt3_word(np.int64(words[i]) >> 12, np.int64(words[i]) & 0xFFF, state)
        if mask < 0:
            return n, skipped, i
        if mask and (state[HIGH] < 0 or state[Y] < 0 or state[P] == 0):
            skipped += _bits(mask)
        elif mask:
            t = state[TURNS] << 24 | state[HIGH] << 12 | state[LOW]
            n = _emit(events, n, mask, t, state[X], state[Y], state[P])
        state[X] += state[ADVANCE]
    return n, skipped, -1


@numba.njit(cache=True, error_model="numpy")
def _evt3_word(kind: int, value: int, state: np.ndarray) -> int:
    """Take one word into the state; the mask of its events from x on, or -1 for a reserved type."""
    state[ADVANCE] = 12 if kind == 4 else 8 if kind == 5 else 0
    mask = 0
    if kind == 2 or kind == 3:  # one event, or the first pixel of a vector
        state[X], state[P] = value & 2047, 2 * (value >> 11) - 1
        mask = 3 - kind
    elif kind == 4 or kind == 5:
        mask = value if kind == 4 else value & 255
    elif kind == 0:
        state[Y] = value & 2047
    else:
        mask = _evt3_clock(kind, value, state)
    return mask


@numba.njit(cache=True, error_model="numpy")
def _evt3_clock(kind: int, value: int, state: np.ndarray) -> int:
    """Take a word that is no address: the clock, a trigger, or a vendor's word (0); others: -1."""
    if kind == 6:
        state[LOW] = value
    elif kind == 8:
        if value < state[HIGH] - 2048:  # the 24-bit clock began again
            state[TURNS] += 1
        if value != state[HIGH]:
            state[HIGH], state[LOW] = value, 0
    elif kind != 7 and kind != 10 and kind < 14:
        return -1
    return 0
