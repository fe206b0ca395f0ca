"""Kernels of the ray caster: an image as strips, and a strip from near to far.

Columns of pixels are cut at each silhouette. In a strip between two cuts all edges are taken
as straight; what is nearer is painted first, and what remains uncovered is kept as gaps
between edges. Input is assumed valid; `envs.raycast.renderer` checks it.
"""

import math

import numba
import numpy as np

from envs.raycast import bodies as b
from envs.raycast import coverage as v
from envs.raycast.bodies import FIRST, KIND, KNOWN, LAST, SLOPE, WALL_AFTER, WALL_DEPTH, WALL_SIDE, WEIGHT
from envs.raycast.coverage import EYE_X, EYE_Y, EYE_Z, FOCAL, HORIZON, inlined, kernel
from envs.raycast.patterns import texture_cell
from envs.raycast.surfaces import (
    enter_gap,
    show_body,
    show_walls,
    wall_depth,
)
from envs.scene import BOX, CONE, ELLIPSOID

TOGETHER = 1e-9  # [pixels] cuts nearer than this are one
ARC_PARTS = 3  # strips of equal height at either end of an ellipsoid's outline
MAX_CUTS = 2 + 2 * max(2, ARC_PARTS)  # of one body: its ends, and corners or arcs


@numba.njit(cache=True, error_model="numpy")
def render_area(
    scene: tuple, world: np.ndarray, pose: tuple, focal: float, image: np.ndarray, samples: int, cull: float
) -> None:
    """Fill `image` (H, W) with the mean luminance over the area of each pixel.

    Args:
        scene: Bodies (N, 9) and stacks of noise, as their kernels read them.
        world: (VIEW,) float64 as `envs.raycast.coverage` reads it; the frame's part is filled in here.
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
    positions, codes = np.empty(MAX_CUTS * most + 5), np.empty(MAX_CUTS * most + 5, np.int64)
    count = b.see_bodies(bodies, view, 0.5 * width / focal, cull, seen)
    size, total = _events(view, seen, count, width, positions, codes, order)
    rank = np.argsort(positions[:size])
    positions, codes = positions[:size][rank], codes[:size][rank]
    sheet = np.zeros((v.SHEET, max(height + v.PADDING, 2 * count + 32, KNOWN)))
    _sweep(view, seen, (order, total), (positions, codes), image, sheet, stacks)


@kernel
def _sweep(view, seen, begun: tuple, cuts: tuple, image: np.ndarray, sheet: np.ndarray, stacks):
    """Paint the strips between cuts from left to right, with the bodies that are there in each."""
    (order, total), (positions, codes) = begun, cuts
    hit, half, samples = sheet[v.HIT], 0.5 * image.shape[1], int(view[v.SAMPLES])
    known, event = 0, 0
    for cell in range(image.shape[1] * samples):
        left, edge = cell / samples, (cell + 1) / samples
        middle = (0.5 * (left + edge) - half) / view[FOCAL]
        while edge - left > TOGETHER:
            right = edge
            if event < len(codes) and positions[event] < edge - TOGETHER:
                right = positions[event]
            known = _settle(view, seen, order, known, total, (0.5 * (left + right) - half) / view[FOCAL])
            hit[FIRST], hit[LAST] = (left - half) / view[FOCAL], (right - half) / view[FOCAL]
            _paint_strip(view, seen, order, known, sheet, stacks)
            left = right
            while event < len(codes) and positions[event] <= left + TOGETHER:
                known, total = _pass(order, known, total, codes[event])
                event += 1
        texture_cell(view, stacks, sheet, middle)
        if (cell + 1) % samples == 0:
            v.develop(view, sheet, image, cell // samples)


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
        if seen[i, KIND] == CONE:
            size = _cone_cuts(view, seen, i, width, positions, codes, size)
        if seen[i, KIND] == ELLIPSOID:
            size = _arc_cuts(view, seen, i, width, positions, codes, size)
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
def _cone_cuts(view, seen, i: int, width: int, positions, codes, size: int) -> int:
    """Add the axis of a cone, and where its straight outlines meet the edge of its base."""
    right, forward, radius = seen[i, b.RIGHT], seen[i, b.FORWARD], seen[i, b.RX]
    square = right * right + forward * forward
    rise = seen[i, b.TOP] - view[EYE_Z]
    # Of the turn about the axis from the eye to the outline, the cosine over the distance.
    cosine = radius * radius * rise / ((seen[i, b.TOP] - seen[i, b.BOTTOM]) * max(square, b.NEAR))
    rest = radius * radius / max(square, b.NEAR) - cosine * cosine
    for k in range(-1, 2):
        sine = k * math.sqrt(max(0.0, rest))
        back = abs(k) * cosine
        ahead = forward - back * forward + sine * right
        positions[size], codes[size] = (right - back * right - sine * forward) / max(b.NEAR, ahead), -1
        positions[size] = 0.5 * width + view[FOCAL] * positions[size]
        size += ahead > 0.0 and rest > 0.0 and 0.0 < positions[size] < width
    return size


@kernel
def _arc_cuts(view, seen, i: int, width: int, positions, codes, size: int) -> int:
    """Add cuts where an ellipsoid's outline bends most: in the outermost cell at its left and right end.

    The outline rises there as a square root does, and so cuts divide its height evenly.
    """
    low, high = seen[i, b.LOW], seen[i, b.HIGH]
    reach = min(0.5 * (high - low), 1.0 / (view[v.SAMPLES] * view[FOCAL]))
    for k in range(1, ARC_PARTS + 1):
        bend = reach * (k / ARC_PARTS) ** 2
        for u in (low + bend, high - bend):
            positions[size], codes[size] = 0.5 * width + view[FOCAL] * u, -1
            size += 0.0 < positions[size] < width
    return size


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


@inlined
def _paint_strip(view, seen, order: np.ndarray, known: int, sheet: np.ndarray, stacks) -> None:
    """Paint one strip: bodies and walls from near to far, then the ground in the gaps."""
    gaps, hit = sheet[v.GAPS : v.HIT], sheet[v.HIT]
    u = 0.5 * (hit[FIRST] + hit[LAST])
    gaps[0, 0] = gaps[1, 0] = 0.0
    gaps[2, 0] = gaps[3, 0] = 2.0 * view[HORIZON]
    gaps[4, 0], gaps[5, 0] = 0.0, 1.0
    count = 1
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
        rise = view[HORIZON] - highest / max(b.NEAR, entry)
        if count == 0 or (count == 1 and gaps[2, 0] <= rise and gaps[3, 0] <= rise):
            return
        hit[b.MEAN_ROOT] = b.outline(seen, i, view, (hit[FIRST], hit[LAST]), hit)
        hit[b.ENTRY], hit[b.EXIT] = max(b.NEAR, entry), max(b.NEAR, leave)
        count = show_body(view, seen, i, sheet, stacks, count)
    count = show_walls(view, sheet, count, math.inf)
    if view[v.GROUND + v.CONTRAST] > 0.0:
        for k in range(count):
            enter_gap(view, gaps, k, hit)
            top, bottom = (gaps[0, k], gaps[1, k]), (gaps[2, k], gaps[3, k])
            v.cover_ground(view, sheet, top, bottom, hit[WEIGHT], hit[SLOPE])
