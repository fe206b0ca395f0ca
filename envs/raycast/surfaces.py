"""Kernels that show a wall or a body in one strip: clip it to the gaps, paint it, close them.

A strip's gaps are what nothing nearer covers, each between two straight edges: rows
`gaps[0, k]` and `gaps[1, k]` are the left and the right end of the upper one, 2 and 3 of the
lower; 4 and 5 are from where to where in the strip it reaches, of 0 .. 1. What is shown is
clipped to gaps at both ends, so that it and the gaps always part the strip. Input is assumed valid.
"""

import math

import numpy as np

from envs.raycast import bodies as b
from envs.raycast import coverage as v
from envs.raycast import patterns as p
from envs.raycast.bodies import (
    CAP,
    END,
    ENTRY,
    FIRST,
    KIND,
    LAST,
    LEFT_END,
    LEVEL_LIGHT,
    LIGHT,
    MEAN_ROOT,
    RIGHT_END,
    SIDE,
    SLOPE,
    UNDER,
    WALL_AFTER,
    WALL_DEPTH,
    WALL_SIDE,
    WEIGHT,
)
from envs.raycast.coverage import EYE_X, EYE_Y, EYE_Z, FOCAL, HORIZON, inlined, kernel
from envs.scene import BOX, ELLIPSOID, POLE

SLIGHT = 0.02  # [rows] edges that cross by less are not cut there
GAUSS = 0.5 / math.sqrt(3.0)  # how far from the middle two points stand that stand for a length of 1
BROAD = 0.1  # [widths of a body] a strip wider than this is lit by two points


@kernel
def wall_depth(view: np.ndarray, side: float, u: float) -> float:
    """Depth at which slope `u` meets the wall at x = side * half width [m]; inf: never."""
    depth = (side * view[v.WALL_HALF] - view[EYE_X]) / (u * view[v.COS] - view[v.SIN])
    y = view[EYE_Y] + depth * (u * view[v.SIN] + view[v.COS])
    return depth if depth > b.NEAR and view[v.WALL_NEAR] <= y <= view[v.WALL_FAR] else math.inf


@inlined
def _ends(gaps: np.ndarray, k: int, hit: np.ndarray, edge: int) -> tuple[float, float]:
    """Rows of an edge of what is shown at both ends of gap `k`."""
    left, right = hit[edge], hit[edge + 1]
    return left + gaps[4, k] * (right - left), right + (1.0 - gaps[5, k]) * (left - right)


@inlined
def _clip(gaps: np.ndarray, k: int, hit: np.ndarray, edge: int) -> tuple[float, float]:
    """An edge of what is shown, moved into gap `k`."""
    left, right = v.beyond(_ends(gaps, k, hit, edge), (gaps[0, k], gaps[1, k]))
    left, right = v.beyond((-left, -right), (-gaps[2, k], -gaps[3, k]))
    return -left, -right


@inlined
def _cut_gaps(gaps: np.ndarray, hit: np.ndarray, count: int) -> int:
    """Cut the gaps where an edge of what is shown crosses one of theirs; their new number."""
    count = _cut_by(gaps, hit, count, CAP)
    count = _cut_by(gaps, hit, count, END)
    if hit[SIDE] > hit[CAP] or hit[SIDE + 1] > hit[CAP + 1]:
        count = _cut_by(gaps, hit, count, SIDE)
    if hit[END] > hit[UNDER] or hit[END + 1] > hit[UNDER + 1]:
        count = _cut_by(gaps, hit, count, UNDER)
    return count


@kernel
def _cut_by(gaps: np.ndarray, hit: np.ndarray, count: int, edge: int) -> int:
    """Cut the gaps where one edge crosses theirs, as long as less than half the room is used."""
    k = 0
    while k < count:
        for limit in (0, 2):
            left, right = _ends(gaps, k, hit, edge)
            one, other = left - gaps[limit, k], right - gaps[limit + 1, k]
            if one * other < 0.0 and min(abs(one), abs(other)) > SLIGHT and 2 * count < gaps.shape[1]:
                v.cut_gap(gaps, k, count, one / (one - other))
                count += 1
        k += 1
    return count


@inlined
def enter_gap(view: np.ndarray, gaps: np.ndarray, k: int, hit: np.ndarray) -> None:
    """Note where gap `k` is, and its weight."""
    wide = hit[LAST] - hit[FIRST]
    hit[LEFT_END], hit[RIGHT_END] = hit[FIRST] + gaps[4, k] * wide, hit[FIRST] + gaps[5, k] * wide
    hit[SLOPE] = 0.5 * (hit[LEFT_END] + hit[RIGHT_END])
    hit[WEIGHT] = view[FOCAL] * (hit[RIGHT_END] - hit[LEFT_END])


@kernel
def _carve(view, sheet, count: int, k: int, standing: bool) -> int:
    """Take what is shown out of gap `k`; below what stands on the ground only the ground is left."""
    gaps, hit = sheet[v.GAPS : v.HIT], sheet[v.HIT]
    first, last = _clip(gaps, k, hit, CAP), _clip(gaps, k, hit, END)
    top, bottom = (gaps[0, k], gaps[1, k]), (gaps[2, k], gaps[3, k])
    below = v.is_open(last, bottom) and count < gaps.shape[1]
    if below and standing:
        if view[v.GROUND + v.CONTRAST] > 0.0:
            v.cover_ground(view, sheet, last, bottom, hit[WEIGHT], hit[SLOPE])
        below = False
    if v.is_open(top, first):
        gaps[2, k], gaps[3, k] = first
        if below:
            gaps[0, count], gaps[1, count] = last
            gaps[2, count], gaps[3, count] = bottom
            gaps[4, count], gaps[5, count] = gaps[4, k], gaps[5, k]
            return count + 1
        return count
    if below:
        gaps[0, k], gaps[1, k] = last
        return count
    for row in range(6):
        gaps[row, k] = gaps[row, count - 1]
    return count - 1


@kernel
def show_walls(view: np.ndarray, sheet: np.ndarray, count: int, limit: float) -> int:
    """Paint the walls nearer than `limit` [m] that are still to come into the gaps; their new number."""
    gaps, hit = sheet[v.GAPS : v.HIT], sheet[v.HIT]
    while hit[WALL_DEPTH] < limit:
        side = hit[WALL_SIDE]
        away = view[FOCAL] / (side * view[v.WALL_HALF] - view[EYE_X])
        for k in range(2):
            scale = max(0.0, away * (hit[FIRST + k] * view[v.COS] - view[v.SIN]))
            hit[CAP + k] = view[HORIZON] + scale * (view[EYE_Z] - view[v.WALL_TOP])
            hit[END + k] = view[HORIZON] + scale * view[EYE_Z]
        for k in range(2):
            hit[SIDE + k], hit[UNDER + k] = hit[CAP + k], hit[END + k]
        facing = view[v.LIT_EAST] if view[EYE_X] > side * view[v.WALL_HALF] else view[v.LIT_WEST]
        count = _cut_gaps(gaps, hit, count)
        for k in range(count - 1, -1, -1):
            top, bottom = _clip(gaps, k, hit, CAP), _clip(gaps, k, hit, END)
            if v.is_open(top, bottom):
                enter_gap(view, gaps, k, hit)
                v.fill(view, sheet, top, bottom, view[v.WALL_ALBEDO] * facing, hit[WEIGHT])
                if view[v.WALL + v.CONTRAST] > 0.0:
                    layer = v.RIGHT_SHOWN if side > 0.0 else v.LEFT_SHOWN
                    v.cover(sheet, layer, top, bottom, hit[WEIGHT], hit[SLOPE])
                count = _carve(view, sheet, count, k, True)
        hit[WALL_SIDE], hit[WALL_DEPTH], hit[WALL_AFTER] = -side, hit[WALL_AFTER], math.inf
    return count


@kernel
def _lit_part(view: np.ndarray, seen: np.ndarray, i: int, hit: np.ndarray) -> float:
    """Mean cosine over a strip of which the sun lights one side, up to where its rays graze the pole."""
    length = math.sqrt(view[v.SUN_RIGHT] * view[v.SUN_RIGHT] + view[v.SUN_FORWARD] * view[v.SUN_FORWARD])
    right, forward = -view[v.SUN_FORWARD] / length, view[v.SUN_RIGHT] / length
    away = right * seen[i, b.RIGHT] + forward * seen[i, b.FORWARD]
    radius = -math.copysign(seen[i, b.RX], away)
    grazed = (seen[i, b.RIGHT] + radius * right) / max(b.NEAR, seen[i, b.FORWARD] + radius * forward)
    grazed = min(max(grazed, hit[FIRST]), hit[LAST])
    low, high = (hit[FIRST], grazed) if hit[b.COSINES] > 0.0 else (grazed, hit[LAST])
    arc = b.mean_root(seen, i, low, high, (b.root(seen, i, low), b.root(seen, i, high)))
    return b.cosine(seen, i, view, 0.5 * (low + high), arc) * (high - low) / (hit[LAST] - hit[FIRST])


@inlined
def _side_light(view: np.ndarray, seen: np.ndarray, i: int, hit: np.ndarray) -> float:
    """Mean luminance of a pole's or box's side over the strip."""
    middle = 0.5 * (hit[FIRST] + hit[LAST])
    if seen[i, KIND] == POLE:
        one, other = hit[b.COSINES], hit[b.COSINES + 1]
        if one < 0.0 or other < 0.0:
            cosine = _lit_part(view, seen, i, hit) if max(one, other) > 0.0 else 0.0
        else:
            cosine = b.cosine(seen, i, view, middle, hit[MEAN_ROOT])
        return seen[i, b.ALBEDO] * (view[v.AMBIENT] + view[v.DIFFUSE] * min(1.0, max(0.0, cosine)))
    along_x, along_y = middle * view[v.COS] - view[v.SIN], middle * view[v.SIN] + view[v.COS]
    near_x, near_y, _ = b.box_slab(seen, i, along_x, along_y)
    if near_x > near_y:
        return seen[i, b.ALBEDO] * (view[v.LIT_WEST] if along_x > 0.0 else view[v.LIT_EAST])
    return seen[i, b.ALBEDO] * (view[v.LIT_SOUTH] if along_y > 0.0 else view[v.LIT_NORTH])


@kernel
def _cut_for_body(view, seen, i: int, sheet: np.ndarray, count: int) -> int:
    """Cut the gaps where a body's edges cross theirs, and in two for a pattern that bends around it."""
    gaps, hit = sheet[v.GAPS : v.HIT], sheet[v.HIT]
    count = _cut_gaps(gaps, hit, count)
    broad = hit[LAST] - hit[FIRST] > BROAD * (seen[i, b.HIGH] - seen[i, b.LOW])
    if view[v.BODY + v.CONTRAST] > 0.0 and seen[i, KIND] != BOX and broad and 2 * count < gaps.shape[1]:
        for k in range(count):
            v.cut_gap(gaps, k, count + k, 0.5)
        count *= 2
    return count


@inlined
def _paint_faces(view, seen, i: int, sheet: np.ndarray, stacks: np.ndarray, edges: tuple) -> None:
    """Paint what lies between four edges: a body's level top, its side, its underside."""
    hit, (top, first, last, bottom) = sheet[v.HIT], edges
    if v.is_open(first, last):
        v.fill(view, sheet, first, last, hit[LIGHT], hit[WEIGHT])
        if seen[i, KIND] != POLE and seen[i, KIND] != BOX:
            _shade_rows(view, seen, i, sheet, stacks, (first, last))
    if v.is_open(top, first):
        v.fill(view, sheet, top, first, hit[LEVEL_LIGHT], hit[WEIGHT])
    if v.is_open(last, bottom):
        v.fill(view, sheet, last, bottom, hit[LEVEL_LIGHT], hit[WEIGHT])
    if view[v.BODY + v.CONTRAST] > 0.0:
        _texture_faces(view, seen, i, sheet, stacks, edges)


@inlined
def show_body(view, seen: np.ndarray, i: int, sheet: np.ndarray, stacks: np.ndarray, count: int) -> int:
    """Paint what the strip knows of a body into the gaps; their new number."""
    gaps, hit = sheet[v.GAPS : v.HIT], sheet[v.HIT]
    curved = seen[i, KIND] != POLE and seen[i, KIND] != BOX
    hit[LIGHT] = 0.0 if curved else _side_light(view, seen, i, hit)
    lit = view[v.LIT_UP] if view[EYE_Z] > seen[i, b.TOP] else view[v.LIT_DOWN]
    hit[LEVEL_LIGHT] = seen[i, b.ALBEDO] * lit
    count = _cut_for_body(view, seen, i, sheet, count)
    for k in range(count - 1, -1, -1):
        top, bottom = _clip(gaps, k, hit, CAP), _clip(gaps, k, hit, END)
        if v.is_open(top, bottom):
            first, last = _clip(gaps, k, hit, SIDE), _clip(gaps, k, hit, UNDER)
            enter_gap(view, gaps, k, hit)
            _paint_faces(view, seen, i, sheet, stacks, (top, first, last, bottom))
            # Under the belly of an ellipsoid more than the ground can be seen.
            standing = seen[i, b.BOTTOM] <= b.NEAR and seen[i, KIND] != ELLIPSOID
            count = _carve(view, sheet, count, k, standing)
    return count


@kernel
def _texture_faces(view, seen, i: int, sheet: np.ndarray, stacks: np.ndarray, edges: tuple) -> None:
    """Add the pattern to a body's flat faces: between four edges, the level top, the side, the underside."""
    top, first, last, bottom = edges
    hit = sheet[v.HIT]
    ray = (
        0.5 * (hit[LEFT_END] + hit[RIGHT_END]),
        hit[RIGHT_END] - hit[LEFT_END],
        hit[WEIGHT] * hit[LEVEL_LIGHT],
    )
    if v.is_open(top, first):
        p.texture_level(view, stacks, sheet, top, first, seen[i, b.TOP], ray)
    if v.is_open(last, bottom):
        p.texture_level(view, stacks, sheet, last, bottom, seen[i, b.BOTTOM], ray)
    if not v.is_open(first, last):
        return
    if seen[i, KIND] == BOX:
        s, e = p.along_face(view, seen, i, hit)
        side = (s, e, hit[ENTRY], 0.0, hit[WEIGHT] * hit[LIGHT])
        p.texture_side(view, stacks, sheet, first, last, side)
    if seen[i, KIND] == POLE:
        s, e = p.around_pole(view, seen, i, hit)
        side = (s, e, hit[ENTRY], seen[i, b.Y], hit[WEIGHT] * hit[LIGHT])
        p.texture_side(view, stacks, sheet, first, last, side)


@inlined
def _cosine(view: np.ndarray, shape: tuple, ray: tuple, fall: float, span: tuple) -> float:
    """Cosine between the sun and a quadric, at least 0, where the ray of `fall` per depth meets it.

    `ray` is its slope, and right and forward of the body's axis [m].
    """
    u, right, forward = ray
    _, _, _, ratio, _, size = shape
    depth, up = p.meet(shape, fall, span)
    length = math.sqrt(max(1e-300, size + ratio * (ratio - 1.0) * up * up))
    east, north = depth * u - right, depth - forward
    towards = east * view[v.SUN_RIGHT] + north * view[v.SUN_FORWARD] + ratio * up * view[v.SUN_Z]
    return min(1.0, max(0.0, towards / length))


@kernel
def _shade_rows(view, seen, i: int, sheet: np.ndarray, stacks: np.ndarray, edges: tuple) -> None:
    """Light a cone's side or an ellipsoid between two edges, row by row."""
    hit = sheet[v.HIT]
    top, bottom = edges
    wide = hit[RIGHT_END] - hit[LEFT_END]
    broad = wide > BROAD * (seen[i, b.HIGH] - seen[i, b.LOW])
    u, second = hit[SLOPE] - broad * GAUSS * wide, hit[SLOPE] + GAUSS * wide
    shape, other, span = p.quadric(seen, i, view, u), p.quadric(seen, i, view, second), (0.0, math.inf)
    ray = (u, seen[i, b.RIGHT], seen[i, b.FORWARD])
    ambient = hit[WEIGHT] * seen[i, b.ALBEDO] * view[v.AMBIENT]
    diffuse = hit[WEIGHT] * seen[i, b.ALBEDO] * view[v.DIFFUSE]
    textured = view[v.BODY + v.CONTRAST] > 0.0
    left = right = middle = shape
    if textured:
        left, right = p.quadric(seen, i, view, hit[LEFT_END]), p.quadric(seen, i, view, hit[RIGHT_END])
        middle = p.quadric(seen, i, view, hit[SLOPE])
    high, low = min(top[0], top[1]), max(bottom[0], bottom[1])
    per_row, whole, rest = 1.0 / view[FOCAL], max(top[0], top[1]), min(bottom[0], bottom[1])
    for row in range(int(high), math.ceil(low)):
        start, end = max(high, row), min(low, row + 1.0)
        fall = (0.5 * (start + end) - view[HORIZON]) * per_row
        if row >= whole and row + 1 <= rest:
            share, cosine = 1.0, _cosine(view, shape, ray, fall, span)
            if broad:
                cosine = 0.5 * (_cosine(view, other, (second, *ray[1:]), fall, span) + cosine)
        else:
            share = v.share_below(row, top[0], top[1]) - v.share_below(row, bottom[0], bottom[1])
            cosine = _cut_row(view, seen, i, hit, edges, (start, end))
        light = ambient + diffuse * cosine
        if textured:
            rows = start, max(start, end)
            light *= 1.0 + p.curved_pattern(view, seen, i, hit, (left, right, middle), rows, stacks)
        sheet[v.PAINT, row] += share * light


@kernel
def _cut_row(view, seen, i: int, hit: np.ndarray, edges: tuple, rows: tuple) -> float:
    """Cosine between the sun and what the edges leave of a row of a curved body.

    Luminance changes fastest next to the outline: four points of what is left, at each of
    two slopes the quarters of the rows between the edges.
    """
    (top, bottom), (start, end) = edges, rows
    left, right = v.left_of_row(edges, start, end)
    total = tall = 0.0
    for k in range(2):
        x = left + (0.5 + (2 * k - 1) * GAUSS) * (right - left)
        u = hit[LEFT_END] + x * (hit[RIGHT_END] - hit[LEFT_END])
        upper = max(start, top[0] + x * (top[1] - top[0]))
        lower = max(upper, min(end, bottom[0] + x * (bottom[1] - bottom[0])))
        shape, ray = p.quadric(seen, i, view, u), (u, seen[i, b.RIGHT], seen[i, b.FORWARD])
        span = b.depths(seen, i, view, u)
        span = (max(b.NEAR, span[0]), max(b.NEAR, span[1]))
        for j in range(2):
            fall = (upper + (0.5 + (2 * j - 1) * GAUSS) * (lower - upper) - view[HORIZON]) / view[FOCAL]
            total += 0.5 * (lower - upper) * _cosine(view, shape, ray, fall, span)
        tall += lower - upper
    return total / max(tall, 1e-9)
