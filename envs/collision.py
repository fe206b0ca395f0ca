"""Distances that matter: swept collision of a disc, exact for any length; points kept apart."""

import math

import numba
import numpy as np


@numba.njit(cache=True, error_model="numpy")
def first_contact(segment: tuple, radius: float, half_width: float, discs: np.ndarray) -> float:
    """Smallest fraction of `segment` (ax, ay, bx, by) in contact with a wall or a disc, or inf."""
    ax, ay, bx, by = segment
    first = _wall_contact(ax, bx, half_width - radius)
    for i in range(len(discs)):
        x, y = discs[i, 0], discs[i, 1]
        first = min(first, _disc_contact((ax - x, ay - y), (bx - x, by - y), discs[i, 2] + radius))
    return first


@numba.njit(cache=True, error_model="numpy")
def _wall_contact(ax: float, bx: float, half: float) -> float:
    if abs(ax) >= half:
        return 0.0
    if abs(bx) < half:
        return math.inf
    return (math.copysign(half, bx) - ax) / (bx - ax)


@numba.njit(cache=True, error_model="numpy")
def _disc_contact(a: tuple, b: tuple, reach: float) -> float:
    """First contact of the segment a-b with the disc of radius `reach` around the origin."""
    start = math.hypot(a[0], a[1])
    if start <= reach:
        return 0.0
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = math.hypot(dx, dy)
    # Asked first, so that a segment never ends in what the next one would start in.
    last = 1.0 if math.hypot(b[0], b[1]) <= reach else math.inf
    if length == 0.0:
        return last
    along = -(a[0] * dx + a[1] * dy) / length
    miss = abs(a[0] * dy - a[1] * dx) / length
    if along <= 0.0 or miss > reach:
        return last
    # The smaller root as C / (larger root): the plain difference cancels just outside the disc.
    larger = along + math.sqrt((reach - miss) * (reach + miss))
    contact = (start - reach) * (start + reach) / (larger * length)
    return contact if contact <= 1.0 else last


@numba.njit(cache=True, error_model="numpy")
def keep_apart(tries: np.ndarray, min_gap_m: float, count: int) -> np.ndarray:
    """The first `count` points of `tries` that are `min_gap_m` from all points kept before."""
    kept = np.empty((count, 2))
    size = 0
    for i in range(len(tries)):
        if size == count:
            break
        apart = True
        for j in range(size):
            if math.hypot(tries[i, 0] - kept[j, 0], tries[i, 1] - kept[j, 1]) < min_gap_m:
                apart = False
                break
        if apart:
            kept[size] = tries[i]
            size += 1
    return kept[:size]
