"""Kernels that show a wall or a body in one column: clip it to the gaps, paint it, close them.

A column's gaps are what nothing nearer covers: rows `gaps[k, 0]` .. `gaps[k, 1]`. `sheet` is
the canvas, the gaps, what is known of the column, and the stacks of noise. Input is assumed
valid.
"""

import math

import numpy as np

from envs import bodies as b
from envs import spans as v
from envs.bodies import CAP, END, ENTRY, KIND, SIDE, UNDER
from envs.obstacles import BOX, ELLIPSOID, POLE
from envs.spans import EYE_X, EYE_Y, EYE_Z, FOCAL, HORIZON, kernel

# What is known of a column, beside what `envs.bodies` says of a body in it: its slope, those of
# both ends of the part of the strip it stands for, its weight [pixels]; luminance of the side
# and of the level face of what is shown; the wall that comes next: which (+-1), its depth and
# that of the other one [m].
SLOPE, LEFT, RIGHT, WEIGHT, BESIDE, LIGHT, LEVEL_LIGHT, WALL_SIDE, WALL_DEPTH, WALL_AFTER = range(6, 16)
# By how many rows its upper and its lower edge slope from one end of that part to the other.
CAP_SPREAD, END_SPREAD = 16, 17
KNOWN = 18


@kernel
def wall_depth(view: np.ndarray, side: float, u: float) -> float:
    """Depth at which slope `u` meets the wall at x = side * half width [m]; inf: never."""
    depth = (side * view[v.WALL_HALF] - view[EYE_X]) / (u * view[v.COS] - view[v.SIN])
    y = view[EYE_Y] + depth * (u * view[v.SIN] + view[v.COS])
    return depth if depth > b.NEAR and view[v.WALL_NEAR] <= y <= view[v.WALL_FAR] else math.inf


@kernel
def _carve(view, sheet, count: int, k: int, standing: bool) -> int:
    """Take rows CAP .. END out of gap `k`; below what stands on the ground only the ground is left."""
    canvas, gaps, hit, _ = sheet
    top, bottom = gaps[k, 0], gaps[k, 1]
    if standing and hit[END] < bottom:
        if view[v.GROUND + v.CONTRAST] > 0.0:
            v.cover_ground(view, canvas, hit[END], bottom, hit[WEIGHT])
        bottom = hit[END]
    if top < hit[CAP]:
        below = gaps[k, 3]
        gaps[k, 1], gaps[k, 3] = hit[CAP], hit[CAP_SPREAD]
        if hit[END] < bottom:
            gaps[count, 0], gaps[count, 1] = hit[END], bottom
            gaps[count, 2], gaps[count, 3] = hit[END_SPREAD], below
            return count + 1
        return count
    if hit[END] < bottom:
        gaps[k, 0], gaps[k, 2] = hit[END], hit[END_SPREAD]
        return count
    for column in range(4):
        gaps[k, column] = gaps[count - 1, column]
    return count - 1


@kernel
def _spreads(gaps: np.ndarray, k: int, hit: np.ndarray) -> tuple[float, float]:
    """By how many rows the edges slope of what gap `k` shows between rows CAP and END."""
    above = hit[CAP_SPREAD] if hit[CAP] > gaps[k, 0] else gaps[k, 2]
    below = hit[END_SPREAD] if hit[END] < gaps[k, 1] else gaps[k, 3]
    return above, below


@kernel
def show_walls(view: np.ndarray, sheet: tuple, count: int, limit: float) -> int:
    """Paint the walls nearer than `limit` [m] that are still to come into the gaps; their new number."""
    canvas, gaps, hit, _ = sheet
    while hit[WALL_DEPTH] < limit:
        side, scale = hit[WALL_SIDE], view[FOCAL] / hit[WALL_DEPTH]
        hit[CAP] = view[HORIZON] + scale * (view[EYE_Z] - view[v.WALL_TOP])
        hit[END] = view[HORIZON] + scale * view[EYE_Z]
        hit[CAP_SPREAD] = hit[END_SPREAD] = 0.0
        facing = view[v.LIT_EAST] if view[EYE_X] > side * view[v.WALL_HALF] else view[v.LIT_WEST]
        for k in range(count - 1, -1, -1):
            top, bottom = max(gaps[k, 0], hit[CAP]), min(gaps[k, 1], hit[END])
            if top < bottom:
                spreads = _spreads(gaps, k, hit)
                light = view[v.WALL_ALBEDO] * facing
                v.fill_sloping(view, canvas, (top, bottom), spreads, light, hit[WEIGHT])
                if view[v.WALL + v.CONTRAST] > 0.0:
                    layer = v.RIGHT_SHOWN if side > 0.0 else v.LEFT_SHOWN
                    v.cover(canvas, layer, top, bottom, hit[WEIGHT])
                count = _carve(view, sheet, count, k, True)
        hit[WALL_SIDE], hit[WALL_DEPTH], hit[WALL_AFTER] = -side, hit[WALL_AFTER], math.inf
    return count


@kernel
def _side_light(view: np.ndarray, seen: np.ndarray, i: int, hit: np.ndarray) -> float:
    """Luminance of a pole's or box's side where the column meets it."""
    if seen[i, KIND] == POLE:
        right, forward = hit[ENTRY] * hit[SLOPE] - seen[i, b.RIGHT], hit[ENTRY] - seen[i, b.FORWARD]
        cosine = (right * view[v.SUN_RIGHT] + forward * view[v.SUN_FORWARD]) / seen[i, b.RX]
        return seen[i, b.ALBEDO] * (view[v.AMBIENT] + view[v.DIFFUSE] * min(1.0, max(0.0, cosine)))
    along_x, along_y = hit[SLOPE] * view[v.COS] - view[v.SIN], hit[SLOPE] * view[v.SIN] + view[v.COS]
    near_x, near_y, _ = b.box_slab(seen, i, along_x, along_y)
    if near_x > near_y:
        return seen[i, b.ALBEDO] * (view[v.LIT_WEST] if along_x > 0.0 else view[v.LIT_EAST])
    return seen[i, b.ALBEDO] * (view[v.LIT_SOUTH] if along_y > 0.0 else view[v.LIT_NORTH])


@kernel
def show_body(view: np.ndarray, seen: np.ndarray, i: int, sheet: tuple, count: int) -> int:
    """Paint what the column knows of a body into the gaps; their new number."""
    canvas, gaps, hit, _ = sheet
    curved = seen[i, KIND] != POLE and seen[i, KIND] != BOX
    if not curved:
        hit[LIGHT] = _side_light(view, seen, i, hit)
    lit = view[v.LIT_UP] if view[EYE_Z] > seen[i, b.TOP] else view[v.LIT_DOWN]
    hit[LEVEL_LIGHT] = seen[i, b.ALBEDO] * lit
    for k in range(count - 1, -1, -1):
        top, bottom = max(gaps[k, 0], hit[CAP]), min(gaps[k, 1], hit[END])
        if top < bottom:
            first, last = max(top, hit[SIDE]), min(bottom, hit[UNDER])
            above, below = _spreads(gaps, k, hit)
            spreads = (above if first == top else 0.0, below if last == bottom else 0.0)
            if curved:
                _paint_curved(view, seen, i, sheet, (first, last), spreads)
            else:
                v.fill_sloping(view, canvas, (first, last), spreads, hit[LIGHT], hit[WEIGHT])
            if top < hit[SIDE]:
                rows, spreads = (top, min(bottom, hit[SIDE])), (above, 0.0)
                v.fill_sloping(view, canvas, rows, spreads, hit[LEVEL_LIGHT], hit[WEIGHT])
            if hit[UNDER] < bottom:
                rows, spreads = (max(top, hit[UNDER]), bottom), (0.0, below)
                v.fill_sloping(view, canvas, rows, spreads, hit[LEVEL_LIGHT], hit[WEIGHT])
            if view[v.BODY + v.CONTRAST] > 0.0:
                _texture_faces(view, seen, i, sheet, top, bottom)
            # Under the belly of an ellipsoid more than the ground can be seen.
            standing = seen[i, b.BOTTOM] <= b.NEAR and seen[i, KIND] != ELLIPSOID
            count = _carve(view, sheet, count, k, standing)
    return count


@kernel
def _texture_faces(view, seen, i: int, sheet: tuple, top: float, bottom: float) -> None:
    """Add the pattern to what rows top .. bottom show of a body's flat faces, or of a pole's side."""
    canvas, _, hit, stacks = sheet
    ray = (0.5 * (hit[LEFT] + hit[RIGHT]), hit[RIGHT] - hit[LEFT], hit[WEIGHT] * hit[LEVEL_LIGHT])
    if top < hit[SIDE]:
        v.texture_level(view, stacks, canvas, top, min(bottom, hit[SIDE]), seen[i, b.TOP], ray)
    if hit[UNDER] < bottom:
        v.texture_level(view, stacks, canvas, max(top, hit[UNDER]), bottom, seen[i, b.BOTTOM], ray)
    first, last = max(top, hit[SIDE]), min(bottom, hit[UNDER])
    if first < last and seen[i, KIND] == BOX:
        s, e = _along_face(view, seen, i, hit)
        side = (s, e, hit[ENTRY], 0.0, hit[WEIGHT] * hit[LIGHT])
        v.texture_side(view, stacks, canvas, first, last, side)
    if first < last and seen[i, KIND] == POLE:
        s, e = _around(view, seen, i, hit)
        side = (s, e, hit[ENTRY], seen[i, b.Y], hit[WEIGHT] * hit[LIGHT])
        v.texture_side(view, stacks, canvas, first, last, side)


@kernel
def _along_face(view: np.ndarray, seen: np.ndarray, i: int, hit: np.ndarray) -> tuple[float, float]:
    """World y (x) where both ends of the strip meet the face of a box that looks along x (y) [m]."""
    cos, sin = view[v.COS], view[v.SIN]
    along_x, along_y = hit[SLOPE] * cos - sin, hit[SLOPE] * sin + cos
    near_x, near_y, _ = b.box_slab(seen, i, along_x, along_y)
    if near_x > near_y:
        away = seen[i, b.DX] - math.copysign(seen[i, b.RX], along_x)
        one = away / (hit[LEFT] * cos - sin) * (hit[LEFT] * sin + cos)
        other = away / (hit[RIGHT] * cos - sin) * (hit[RIGHT] * sin + cos)
        return view[EYE_Y] + one, view[EYE_Y] + other
    away = seen[i, b.DY] - math.copysign(seen[i, b.RY], along_y)
    one = away / (hit[LEFT] * sin + cos) * (hit[LEFT] * cos - sin)
    other = away / (hit[RIGHT] * sin + cos) * (hit[RIGHT] * cos - sin)
    return view[EYE_X] + one, view[EYE_X] + other


@kernel
def _around(view: np.ndarray, seen: np.ndarray, i: int, hit: np.ndarray) -> tuple[float, float]:
    """Surface coordinate s [m] where both ends of the strip meet a pole."""
    entry, _ = b.depths(seen, i, view, hit[LEFT])
    one = math.atan2(entry - seen[i, b.FORWARD], entry * hit[LEFT] - seen[i, b.RIGHT])
    entry, _ = b.depths(seen, i, view, hit[RIGHT])
    other = math.atan2(entry - seen[i, b.FORWARD], entry * hit[RIGHT] - seen[i, b.RIGHT])
    return _metres(view, seen, i, one, other)


@kernel
def _metres(view: np.ndarray, seen: np.ndarray, i: int, one: float, other: float) -> tuple[float, float]:
    """Surface coordinates s of two azimuths in the camera's frame, by the shorter way between them."""
    turn = other - one
    turn -= 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
    start = seen[i, b.X] + seen[i, b.TURN] * (one + math.atan2(view[v.SIN], view[v.COS]))
    return start, start + seen[i, b.TURN] * turn


@kernel
def _paint_curved(view, seen, i: int, sheet: tuple, rows: tuple, spreads: tuple) -> None:
    """Paint a cone's side or an ellipsoid row by row, each by the middles of a few parts."""
    (canvas, _, hit, stacks), (top, bottom) = sheet, rows
    if top >= bottom:
        return
    v.fill_sloping(view, canvas, rows, spreads, 0.0, hit[WEIGHT])
    textured = view[v.BODY + v.CONTRAST] > 0.0
    row = max(0, math.floor(top - 0.5 * spreads[0]))
    end = min(bottom + 0.5 * spreads[1], canvas.shape[1] - 2.0)
    while row < end:
        share = v.share_below(row, top, spreads[0]) - v.share_below(row, bottom, spreads[1])
        low = min(max(top, row), bottom)
        high = max(min(bottom, row + 1.0), low)
        # Luminance changes fastest next to the outline, which a row that is cut contains.
        parts = 1 if high - low == 1.0 else 2
        part, cosines = (high - low) / parts, 0.0
        for k in range(parts):
            fall = (low + (k + 0.5) * part - view[HORIZON]) / view[FOCAL]
            _, _, _, right, forward, up = b.meet(seen, i, view, hit[SLOPE], fall, hit)
            cosine = right * view[v.SUN_RIGHT] + forward * view[v.SUN_FORWARD] + up * view[v.SUN_Z]
            cosines += min(1.0, max(0.0, cosine))
        light = seen[i, b.ALBEDO] * (view[v.AMBIENT] + view[v.DIFFUSE] * cosines / parts)
        if textured:
            light *= 1.0 + _curved_pattern(view, seen, i, hit, low, high, stacks)
        canvas[v.PAINT, row] += hit[WEIGHT] * share * light
        row += 1


@kernel
def _curved_pattern(view, seen, i, hit, low, high, stacks) -> float:
    """Contrast times the pattern's mean over rows low .. high of a cone's side or an ellipsoid."""
    fall = (0.5 * (low + high) - view[HORIZON]) / view[FOCAL]
    tall = 0.5 * (high - low) / view[FOCAL]
    u = 0.5 * (hit[LEFT] + hit[RIGHT])
    right, forward, left_z, _, _, _ = b.meet(seen, i, view, hit[LEFT], fall, hit)
    one = math.atan2(forward, right)
    right, forward, right_z, _, _, _ = b.meet(seen, i, view, hit[RIGHT], fall, hit)
    left_s, right_s = _metres(view, seen, i, one, math.atan2(forward, right))
    right, forward, upper_z, _, _, _ = b.meet(seen, i, view, u, fall - tall, hit)
    one = math.atan2(forward, right)
    right, forward, lower_z, _, _, _ = b.meet(seen, i, view, u, fall + tall, hit)
    upper_s, lower_s = _metres(view, seen, i, one, math.atan2(forward, right))
    s = 0.5 * (left_s + right_s)
    z = 0.5 * (seen[i, b.BOTTOM] + seen[i, b.TOP]) + 0.5 * (upper_z + lower_z)
    axes = (right_s - left_s, right_z - left_z, lower_s - upper_s, lower_z - upper_z)
    return v.pattern(view, stacks, v.BODY, s, seen[i, b.Y] + z, axes, int(v.LOOKUPS * view[v.SAMPLES]))
