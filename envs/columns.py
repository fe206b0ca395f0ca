"""Kernels of the ray caster: an image as strips, a strip as columns, a column from near to far.

Columns of pixels are cut at each silhouette; a strip between two cuts is the mean over one
or two columns inside it. In a column, what is nearer is painted first, and what remains
uncovered is kept as gaps between rows. Input is assumed valid; `envs.raycast` checks it.
"""

import math

import numba
import numpy as np

from envs import bodies as b
from envs import spans as v
from envs.bodies import KIND
from envs.obstacles import BOX, CONE, ELLIPSOID
from envs.spans import EYE_X, EYE_Y, EYE_Z, FOCAL, HORIZON, kernel
from envs.surfaces import (
    CAP_SPREAD,
    END_SPREAD,
    KNOWN,
    LEFT,
    RIGHT,
    SLOPE,
    WALL_AFTER,
    WALL_DEPTH,
    WALL_SIDE,
    WEIGHT,
    show_body,
    show_walls,
    wall_depth,
)

TOGETHER = 1e-9  # [pixels] cuts nearer than this are one
GAUSS = 0.5 - 0.5 / math.sqrt(3.0)  # where in a strip its first column stands; its second mirrors it
NARROW = 0.3  # [strips] narrower ones are one column


@numba.njit(cache=True, error_model="numpy")
def render_area(
    scene: tuple, world: np.ndarray, pose: tuple, focal: float, image: np.ndarray, samples: int, cull: float
) -> None:
    """Fill `image` (H, W) with the mean luminance over the area of each pixel.

    Args:
        scene: Bodies (N, 9) and stacks of noise, as their kernels read them.
        world: (VIEW,) float64 as `envs.spans` reads it; the frame's part is filled in here.
        pose: x, y, z [m], yaw [rad], time [s].
        focal: Focal length [pixels].
        image: Float32.
        samples: Strips per pixel.
        cull: Bodies farther than this are not drawn [m].
    """
    bodies, stacks = scene
    height, width = image.shape
    view, most = world.copy(), len(bodies)
    _look(view, pose, focal, height, samples)
    seen, order = np.empty((most, b.FIELDS)), np.empty(most, np.int64)
    positions, codes = np.empty(6 * most + 4), np.empty(6 * most + 4, np.int64)
    count = b.see_bodies(bodies, view, 0.5 * width / focal, cull, seen)
    size, total = _events(view, seen, count, width, positions, codes, order)
    rank = np.argsort(positions[:size])
    positions, codes = positions[:size][rank], codes[:size][rank]
    sheet = (np.zeros((v.LAYERS, height + 2)), np.empty((count + 6, 4)), np.empty(KNOWN), stacks)
    _sweep(view, seen, (order, total), (positions, codes), image, samples, sheet)


@kernel
def _sweep(view, seen, begun: tuple, cuts: tuple, image: np.ndarray, samples: int, sheet: tuple) -> None:
    """Paint the strips between cuts from left to right, with the bodies that are there in each."""
    (order, total), (positions, codes) = begun, cuts
    half = 0.5 * image.shape[1]
    known, event = 0, 0
    for cell in range(image.shape[1] * samples):
        left, edge = cell / samples, (cell + 1) / samples
        middle = (0.5 * (left + edge) - half) / view[FOCAL]
        while edge - left > TOGETHER:
            right = edge
            if event < len(codes) and positions[event] < edge - TOGETHER:
                right = positions[event]
            known = _settle(view, seen, order, known, total, (0.5 * (left + right) - half) / view[FOCAL])
            _paint_strip(view, seen, order, known, (left - half, right - half), sheet)
            left = right
            while event < len(codes) and positions[event] <= left + TOGETHER:
                known, total = _pass(order, known, total, codes[event])
                event += 1
        v.texture_cell(view, sheet[3], sheet[0], middle)
        if (cell + 1) % samples == 0:
            v.develop(view, sheet[0], image, cell // samples)


@kernel
def _paint_strip(view, seen, order: np.ndarray, known: int, strip: tuple, sheet: tuple) -> None:
    """Paint a strip, from its left to its right around the image's middle [pixels], by one or two columns."""
    left, right = strip
    hit, wide, start = sheet[2], right - left, left
    columns = 1 if wide * view[v.SAMPLES] < NARROW else 2
    for k in range(columns):
        at = 0.5 if columns == 1 else (GAUSS if k == 0 else 1.0 - GAUSS)
        hit[WEIGHT] = wide / columns
        hit[SLOPE] = (left + at * wide) / view[FOCAL]
        hit[LEFT], hit[RIGHT] = start / view[FOCAL], (start + hit[WEIGHT]) / view[FOCAL]
        start += hit[WEIGHT]
        _column(view, seen, order, known, sheet)


@kernel
def _look(view: np.ndarray, pose: tuple, focal: float, height: int, samples: int) -> None:
    """Fill in what a frame adds to the numbers of the scene."""
    view[EYE_X], view[EYE_Y], view[EYE_Z], yaw, view[v.TIME] = pose
    cos, sin = math.cos(yaw), math.sin(yaw)
    view[v.COS], view[v.SIN] = cos, sin
    view[HORIZON], view[FOCAL], view[v.SAMPLES] = 0.5 * height, focal, samples
    view[v.SUN_RIGHT] = view[v.SUN_X] * cos + view[v.SUN_Y] * sin
    view[v.SUN_FORWARD] = view[v.SUN_Y] * cos - view[v.SUN_X] * sin


@kernel
def _events(view, seen, count, width, positions, codes, order) -> tuple:
    """Collect the cuts inside the image [pixels]; their codes: 2 i, body i begins; 2 i + 1, it ends; -1.

    Returns:
        The number of cuts, and that of bodies already begun at the left edge, in `order`.
    """
    size = total = 0
    centre, focal = 0.5 * width, view[FOCAL]
    for i in range(count):
        low, high = centre + focal * seen[i, b.LOW], centre + focal * seen[i, b.HIGH]
        if low <= 0.0:
            order[total] = i
            total += 1
        else:
            positions[size], codes[size] = low, 2 * i
            size += 1
        positions[size], codes[size] = high, 2 * i + 1
        size += high < width
        if seen[i, KIND] == CONE and seen[i, b.FORWARD] > 0.0:
            positions[size], codes[size] = centre + focal * seen[i, b.RIGHT] / seen[i, b.FORWARD], -1
            size += 0.0 < positions[size] < width
        if seen[i, KIND] == BOX:
            size = _corner_cuts(view, seen, i, width, positions, codes, size)
    for k in range(4):
        dx = (view[v.WALL_HALF] if k < 2 else -view[v.WALL_HALF]) - view[EYE_X]
        dy = (view[v.WALL_NEAR] if k % 2 else view[v.WALL_FAR]) - view[EYE_Y]
        forward = dy * view[v.COS] - dx * view[v.SIN]
        right = dx * view[v.COS] + dy * view[v.SIN]
        positions[size], codes[size] = centre + focal * right / forward, -1
        size += forward > 0.0 and 0.0 < positions[size] < width
    return size, total


@kernel
def _corner_cuts(view, seen, i: int, width: int, positions, codes, size: int) -> int:
    """Add the corners of a box at which what it shows changes: the nearest; all, from above or below."""
    level = view[EYE_Z] > seen[i, b.TOP] or view[EYE_Z] < seen[i, b.BOTTOM]
    nearest, least = 0, math.inf
    for k in range(4):
        right, forward = b.corner(seen, i, view, k)
        if right * right + forward * forward < least:
            nearest, least = k, right * right + forward * forward
    for k in range(4):
        right, forward = b.corner(seen, i, view, k)
        if forward > 0.0 and (level or k == nearest):
            positions[size], codes[size] = 0.5 * width + view[FOCAL] * right / forward, -1
            size += 0.0 < positions[size] < width
    return size


@kernel
def _pass(order: np.ndarray, known: int, total: int, code: int) -> tuple:
    """Begin or end a body: `order` holds `total` of them, of which the first `known` are sorted."""
    if code < 0:
        return known, total
    i = code // 2
    if code % 2 == 0:
        order[total] = i
        return known, total + 1
    for k in range(total):
        if order[k] == i:
            for j in range(k, total - 1):
                order[j] = order[j + 1]
            return known - (k < known), total - 1
    return known, total


@kernel
def _settle(view: np.ndarray, seen: np.ndarray, order: np.ndarray, known: int, total: int, u: float) -> int:
    """Sort the newly begun bodies in among the others by what hides what along `u`; all are known then.

    Bodies are convex and do not overlap, so that this order holds as long as both are there.
    """
    for k in range(known, total):
        new = order[k]
        j = k
        while j > 0 and b.before(seen, new, order[j - 1], view, u):
            order[j] = order[j - 1]
            j -= 1
        order[j] = new
    return total


@kernel
def _outline(view, seen, i: int, span: tuple, hit: np.ndarray) -> None:
    """Fill `hit` with the rows of a body as the part of the strip shows them that the column stands for.

    A slanting outline is taken as a line between both ends of the part, at the mean height of
    the outline (Simpson's rule): exact for a cone.
    """
    hit[CAP_SPREAD] = hit[END_SPREAD] = 0.0
    if seen[i, KIND] != CONE and seen[i, KIND] != ELLIPSOID:
        b.section(seen, i, view, hit[SLOPE], span, hit)
        return
    cap = end = 0.0
    for k in range(3):
        u = hit[LEFT] + 0.5 * k * (hit[RIGHT] - hit[LEFT])
        b.section(seen, i, view, u, b.depths(seen, i, view, u), hit)
        share = 4.0 / 6.0 if k == 1 else 1.0 / 6.0
        cap, end = cap + share * hit[b.CAP], end + share * hit[b.END]
        sign = k - 1.0
        hit[CAP_SPREAD] += sign * hit[b.CAP]
        hit[END_SPREAD] += sign * hit[b.END]
    b.section(seen, i, view, hit[SLOPE], span, hit)
    hit[CAP_SPREAD], hit[END_SPREAD] = abs(hit[CAP_SPREAD]), abs(hit[END_SPREAD])
    level = hit[b.CAP] < hit[b.SIDE] or hit[b.UNDER] < hit[b.END]
    if not level:
        hit[b.CAP], hit[b.END] = cap, max(cap, end)
        hit[b.SIDE], hit[b.UNDER] = hit[b.CAP], hit[b.END]
        # Edges that cross would paint less than nothing.
        both, tall = 0.5 * (hit[CAP_SPREAD] + hit[END_SPREAD]), hit[b.END] - hit[b.CAP]
        if both > tall:
            hit[CAP_SPREAD], hit[END_SPREAD] = hit[CAP_SPREAD] * tall / both, hit[END_SPREAD] * tall / both
    else:
        hit[CAP_SPREAD] = hit[END_SPREAD] = 0.0


@kernel
def _column(view, seen, order: np.ndarray, known: int, sheet: tuple) -> None:
    """Paint one column: bodies and walls from near to far, then the ground in the gaps."""
    canvas, gaps, hit, _ = sheet
    u = hit[SLOPE]
    gaps[0, 0], gaps[0, 1], count = 0.0, 2.0 * view[HORIZON], 1
    gaps[0, 2] = gaps[0, 3] = 0.0
    east, west = wall_depth(view, 1.0, u), wall_depth(view, -1.0, u)
    hit[WALL_SIDE] = 1.0 if east < west else -1.0
    hit[WALL_DEPTH], hit[WALL_AFTER] = min(east, west), max(east, west)
    highest = max(0.0, view[v.TALLEST] - view[EYE_Z]) * view[FOCAL]
    for k in range(known):
        i = order[k]
        entry, leave = b.depths(seen, i, view, u)
        if leave <= max(0.0, entry):
            continue
        count = show_walls(view, sheet, count, entry)
        # Nothing behind can rise above this row, and below the gap is only ground.
        if count == 0 or (count == 1 and entry > 0.0 and gaps[0, 1] <= view[HORIZON] - highest / entry):
            return
        _outline(view, seen, i, (entry, leave), hit)
        count = show_body(view, seen, i, sheet, count)
    count = show_walls(view, sheet, count, math.inf)
    if view[v.GROUND + v.CONTRAST] > 0.0:
        for k in range(count):
            v.cover_ground(view, canvas, gaps[k, 0], gaps[k, 1], hit[WEIGHT])
