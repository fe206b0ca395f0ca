"""Unwrap the clock counters of cameras."""

import numba
import numpy as np


@numba.njit(cache=True, error_model="numpy")
def unwrap(counter: np.ndarray, bits: int, last_us: int) -> np.ndarray:
    """Return times [us] from a counter of a few bits that wraps to zero.

    A step backwards of at least half the counter's range is a wrap, and so is a step that would lead
    to a negative time; a smaller step backwards is disorder. Gaps of half the range or more across a
    wrap cannot be recognised.

    Args:
        counter: Shape (N,), unsigned integers below 2**bits.
        bits: Width of the counter.
        last_us: The previous time [us]; -1: none.

    Returns:
        int64 (N,); without a previous time, it starts with the first value of the counter.
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
