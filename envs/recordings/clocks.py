"""Unwrap the counters by which cameras tell the time."""

import numba
import numpy as np


@numba.njit(cache=True, error_model="numpy")
def unwrap(counter: np.ndarray, bits: int, last_us: int) -> np.ndarray:
    """Return times [us] from a counter of a few bits that starts again at zero.

    A step of at least half the counter's range backwards is a wrap, and so is a step that would lead
    before 0; a smaller step backwards is disorder. So after a wrap, gaps of half the range or more
    cannot be told.

    Args:
        counter: Shape (N,), unsigned integers below 2**bits.
        bits: Width of the counter.
        last_us: The time before the first [us]; -1: none.

    Returns:
        int64 (N,); without a time before, it begins with the first value of the counter.
    """
    t_us = np.empty(counter.size, np.int64)
    full, half, t = np.int64(1) << bits, np.int64(1) << (bits - 1), np.int64(last_us)
    for i in range(counter.size):
        value = np.int64(counter[i])
        if t < 0:
            t = value
        else:
            t += ((value - t + half) & (full - 1)) - half
            if t < 0:
                t += full
        t_us[i] = t
    return t_us
