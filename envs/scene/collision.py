"""Collision kernels: first contact of a swept disc, paths through a corridor, points at a minimum distance.

Bodies are level sections, rows (x, y, ux, uy, hx, hy, r) as `envs.scene.obstacles` describes them.
Kernels assume finite input; `envs.scene.scene` checks it.
"""

import math

import numba
import numpy as np

CELL_M = 0.1  # cell size of the lattice on which paths are searched
MARGIN = 1.0 + 1e-9  # factor on a size, so that rounding cannot make it too small


@numba.njit(cache=True, error_model="numpy")
def first_contact(segment: tuple, radius: float, half_width: float, sections: np.ndarray) -> float:
    """Return the smallest fraction of `segment` (ax, ay, bx, by) in contact with a wall or section, or inf.

    Args:
        segment: Way of the centre of a disc [m].
        radius: Radius of the disc [m].
        half_width: The walls are at x = +-half_width, endless [m].
        sections: (N, 7) float64.
    """
    ax, ay, bx, by = segment
    left, right, near, far = min(ax, bx), max(ax, bx), min(ay, by), max(ay, by)
    first = _wall_contact(ax, bx, half_width - radius)
    for i in range(len(sections)):
        x, y, hx, hy = sections[i, 0], sections[i, 1], sections[i, 4], sections[i, 5]
        reach = sections[i, 6] + radius
        size = (hx + hy + reach) * MARGIN
        if left - x > size or x - right > size or near - y > size or y - far > size:
            continue  # a quick test, because most sections are far away
        ux, uy = sections[i, 2], sections[i, 3]
        a = ((ax - x) * ux + (ay - y) * uy, (ay - y) * ux - (ax - x) * uy)
        b = ((bx - x) * ux + (by - y) * uy, (by - y) * ux - (bx - x) * uy)
        if hx == 0.0 and hy == 0.0:
            first = min(first, _disc_contact(a, b, reach))
        else:
            first = min(first, _box_contact(a, b, (hx, hy), reach))
    return first


@numba.njit(cache=True, error_model="numpy")
def first_moving_contact(segment: tuple, radius: float, moving: np.ndarray, shares: tuple) -> float:
    """Return the smallest fraction of `segment` in contact with a moving section, or inf.

    In the frame of the section, the way of the disc is straight too.

    Args:
        segment: As for `first_contact`.
        radius: Radius of the disc [m].
        moving: (N, 9) float64, sections at the start of the step and their displacements in it, x, y [m].
        shares: Fractions of the step that have passed at the start and at the end of the segment.
    """
    ax, ay, bx, by = segment
    begin, end = shares
    first = math.inf
    for i in range(len(moving)):
        dx, dy = moving[i, 7], moving[i, 8]
        seen = ax - begin * dx, ay - begin * dy, bx - end * dx, by - end * dy
        first = min(first, first_contact(seen, radius, math.inf, moving[i : i + 1, :7]))
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
    """Return the first contact of the segment a-b with the disc of radius `reach` around the origin."""
    start = math.hypot(a[0], a[1])
    if start <= reach:
        return 0.0
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = math.hypot(dx, dy)
    # Contact at the end counts, so that no segment ends where the next one would start in contact.
    last = 1.0 if math.hypot(b[0], b[1]) <= reach else math.inf
    if length == 0.0:
        return last
    along = -(a[0] * dx + a[1] * dy) / length
    miss = abs(a[0] * dy - a[1] * dx) / length
    if along <= 0.0 or miss > reach:
        return last
    # The smaller root as C / (larger root): the plain difference would cancel just outside the disc.
    larger = along + math.sqrt((reach - miss) * (reach + miss))
    contact = (start - reach) * (start + reach) / (larger * length)
    return contact if contact <= 1.0 else last


@numba.njit(cache=True, error_model="numpy")
def _box_contact(a: tuple, b: tuple, half: tuple, reach: float) -> float:
    """Return the first contact of a-b with the points within `reach` of the rectangle of half-sizes `half`.

    These points are two rectangles, one longer and one wider by `reach`, and a disc at each corner.
    """
    hx, hy = half
    if _distance(a, hx, hy) <= reach:
        return 0.0
    first = 1.0 if _distance(b, hx, hy) <= reach else math.inf
    first = min(first, _entry(a, b, hx + reach, hy), _entry(a, b, hx, hy + reach))
    for x in (-hx, hx):
        for y in (-hy, hy):
            first = min(first, _disc_contact((a[0] - x, a[1] - y), (b[0] - x, b[1] - y), reach))
    return first


@numba.njit(cache=True, error_model="numpy")
def _distance(point: tuple, hx: float, hy: float) -> float:
    """Return the distance of a point from a rectangle around the origin; 0 inside."""
    return math.hypot(max(abs(point[0]) - hx, 0.0), max(abs(point[1]) - hy, 0.0))


@numba.njit(cache=True, error_model="numpy")
def _entry(a: tuple, b: tuple, hx: float, hy: float) -> float:
    """Return where the segment a-b enters a rectangle around the origin, as a fraction, or inf."""
    enters, leaves = 0.0, 1.0
    for start, end, half in ((a[0], b[0], hx), (a[1], b[1], hy)):
        way = end - start
        if way == 0.0:
            if abs(start) > half:
                return math.inf
        else:
            near = -math.copysign(half, way)
            enters = max(enters, (near - start) / way)
            leaves = min(leaves, (-near - start) / way)
    return enters if enters <= leaves else math.inf


@numba.njit(cache=True, error_model="numpy")
def ways_to_goal(
    sections: np.ndarray, radius: float, half_width: float, length: float, columns: int
) -> np.ndarray:
    """Find the places from which a vehicle that flies ahead or 45 degrees to a side reaches the goal line.

    A place of the lattice is open if it is at least `radius` plus one cell away from everything. It leads to
    the goal if it is open and if a place one cell ahead (straight, left or right) leads to the goal. One cell
    is enough for a vehicle that starts up to half a cell to the side of a place and flies parallel to the
    path: it is never more than sqrt(10) / 4 = 0.79 cells from the nearest place of that path. So True is a
    proof; False may mean a gap that is a few cells too narrow.

    Args:
        sections: (N, 7) float64.
        radius: Radius of the vehicle [m].
        half_width: The walls are at x = +-half_width [m].
        length: The goal line is at y = length [m].
        columns: Columns of the lattice on either side of x = 0.

    Returns:
        bool (rows, 2 * columns + 3); element [j, columns + 1 + i] is at x = i * CELL_M, y = j * CELL_M. The
        outermost columns are never open.
    """
    reach = radius + CELL_M
    rows = math.ceil(length / CELL_M) + 1
    leads = np.ones((rows, 2 * columns + 3), np.bool_)
    for k in range(len(sections)):
        _close(leads, sections[k], reach, columns + 1)
    for i in range(leads.shape[1]):
        if abs(i - columns - 1) * CELL_M >= half_width - reach:
            leads[:, i] = False
    leads[:, 0] = leads[:, -1] = False
    for j in range(rows - 2, -1, -1):
        here, ahead = leads[j], leads[j + 1]
        for i in range(1, len(here) - 1):
            here[i] &= ahead[i - 1] | ahead[i] | ahead[i + 1]
    return leads


@numba.njit(cache=True, error_model="numpy")
def _close(places: np.ndarray, section: np.ndarray, reach: float, middle: int) -> None:
    """Mark as False the places within `reach` of a section; column `middle` is x = 0."""
    x, y, ux, uy, hx, hy = section[:6]
    size = section[6] + reach
    wide, deep = abs(ux) * hx + abs(uy) * hy + size, abs(uy) * hx + abs(ux) * hy + size
    rows, columns = places.shape
    # Clip as floats: a distant section may exceed the integer range in cells.
    first_j, last_j = max((y - deep) / CELL_M, 0.0), min((y + deep) / CELL_M, rows - 1.0)
    first_i = max((x - wide) / CELL_M, float(-middle))
    last_i = min((x + wide) / CELL_M, float(columns - 1 - middle))
    for j in range(math.ceil(first_j), math.floor(last_j) + 1):
        dy = j * CELL_M - y
        for i in range(math.ceil(first_i), math.floor(last_i) + 1):
            dx = i * CELL_M - x
            across = max(abs(dy * ux - dx * uy) - hy, 0.0)
            along = max(abs(dx * ux + dy * uy) - hx, 0.0)
            if along * along + across * across <= size * size:
                places[j, middle + i] = False


@numba.njit(cache=True, error_model="numpy")
def keep_apart(tries: np.ndarray, min_gap_m: float, count: int) -> np.ndarray:
    """Return the first `count` points of `tries` at least `min_gap_m` from all points chosen before."""
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
