"""Kernels of one body in one image column: is it in view, between which depths, in which rows.

The camera only yaws, so a column is an upright plane through the eye, in which every body is
convex: a rectangle, an ellipse, or the piece of a hyperbola above a cone's base. Along slope
u = right / forward a point at depth d lies at d * u to the right; a point at height z shows in
row horizon + focal * (eye - z) / d. Input is assumed valid.
"""

import math

import numpy as np

from envs.obstacles import BOX, CONE, ELLIPSOID
from envs.spans import COS, EYE_X, EYE_Y, EYE_Z, FOCAL, HORIZON, SIN, kernel

NEAR = 1e-9  # [m]; smallest depth, so that a division is always defined
# Columns of the array of bodies: centre [m], bottom and top [m], half-axes [m], albedo, metres
# of texture per radian; and for those in view: place relative to the eye, right and forward of
# it, slopes of the left and right silhouette.
KIND, X, Y, BOTTOM, TOP, RX, RY, ALBEDO, TURN = range(9)
DX, DY, RIGHT, FORWARD, LOW, HIGH = range(9, 15)
FIELDS = 15
# What a column shows of a body: rows where its upper level face, its side and its underside
# begin, and where it ends; depths where the column enters and leaves its footprint.
CAP, SIDE, UNDER, END, ENTRY, EXIT = range(6)


@kernel
def see_bodies(bodies: np.ndarray, view: np.ndarray, limit: float, cull: float, seen: np.ndarray) -> int:
    """Fill `seen` (N, FIELDS) with the bodies within `cull` [m] that slopes in +-`limit` show; how many."""
    slack = math.sqrt(1.0 + limit * limit)
    count = 0
    for i in range(len(bodies)):
        dx, dy = bodies[i, X] - view[EYE_X], bodies[i, Y] - view[EYE_Y]
        reach = bodies[i, RX] if bodies[i, KIND] != BOX else math.hypot(bodies[i, RX], bodies[i, RY])
        right = dx * view[COS] + dy * view[SIN]
        forward = dy * view[COS] - dx * view[SIN]
        if forward + reach <= 0.0 or abs(right) > limit * forward + slack * reach:
            continue
        for k in range(DX):
            seen[count, k] = bodies[i, k]
        seen[count, DX], seen[count, DY] = dx, dy
        seen[count, RIGHT], seen[count, FORWARD] = right, forward
        if not _outside(seen, count, view[EYE_Z], cull):
            continue
        box = seen[count, KIND] == BOX
        low, high = _box_edges(seen, count, view) if box else _round_edges(seen, count)
        seen[count, LOW], seen[count, HIGH] = low, high
        count += low < limit and high > -limit
    return count


@kernel
def _outside(seen: np.ndarray, i: int, eye_z: float, cull: float) -> bool:
    """Whether the eye is outside the body, which is invisible from within, and at most `cull` away."""
    distance = 0.0
    if seen[i, KIND] == BOX:
        beside_x = max(0.0, abs(seen[i, DX]) - seen[i, RX])
        beside = math.hypot(beside_x, max(0.0, abs(seen[i, DY]) - seen[i, RY]))
    else:
        distance = math.hypot(seen[i, RIGHT], seen[i, FORWARD])
        beside = max(0.0, distance - seen[i, RX])
    above = max(0.0, eye_z - seen[i, TOP], seen[i, BOTTOM] - eye_z)
    if beside > 0.0 or above > 0.0:
        return cull == math.inf or math.hypot(beside, above) <= cull
    if seen[i, KIND] == CONE:
        return distance > seen[i, RX] * (seen[i, TOP] - eye_z) / (seen[i, TOP] - seen[i, BOTTOM])
    if seen[i, KIND] == ELLIPSOID:
        half = 0.5 * (seen[i, TOP] - seen[i, BOTTOM])
        return (distance / seen[i, RX]) ** 2 + ((eye_z - seen[i, BOTTOM]) / half - 1.0) ** 2 > 1.0
    return False


@kernel
def _round_edges(seen: np.ndarray, i: int) -> tuple[float, float]:
    """Slopes of both tangents to a circle; +-inf where one points backwards or the eye is inside."""
    right, forward, radius = seen[i, RIGHT], seen[i, FORWARD], seen[i, RX]
    distance = math.hypot(right, forward)
    power = (distance - radius) * (distance + radius)
    if power <= 0.0:
        return -math.inf, math.inf
    tangent = math.sqrt(power)
    left_forward = forward * tangent + right * radius
    right_forward = forward * tangent - right * radius
    if left_forward <= 0.0 and right_forward <= 0.0:
        return math.inf, -math.inf
    low = (right * tangent - forward * radius) / left_forward if left_forward > 0.0 else -math.inf
    high = (right * tangent + forward * radius) / right_forward if right_forward > 0.0 else math.inf
    return low, high


@kernel
def corner(seen: np.ndarray, i: int, view: np.ndarray, k: int) -> tuple[float, float]:
    """Right and forward of the k-th corner of a box's footprint, in order around it [m]."""
    dx = seen[i, DX] + (seen[i, RX] if k == 1 or k == 2 else -seen[i, RX])
    dy = seen[i, DY] + (seen[i, RY] if k == 2 or k == 3 else -seen[i, RY])
    return dx * view[COS] + dy * view[SIN], dy * view[COS] - dx * view[SIN]


@kernel
def _box_edges(seen: np.ndarray, i: int, view: np.ndarray) -> tuple[float, float]:
    """Slopes of the left and right silhouette of a rectangle; +-inf as for a circle."""
    if abs(seen[i, DX]) <= seen[i, RX] and abs(seen[i, DY]) <= seen[i, RY]:
        return -math.inf, math.inf
    low, high = math.inf, -math.inf
    right, forward = corner(seen, i, view, 3)
    for k in range(4):
        before, behind = right, forward
        right, forward = corner(seen, i, view, k)
        if forward > 0.0:
            low, high = min(low, right / forward), max(high, right / forward)
        if (forward > 0.0) != (behind > 0.0):
            # The side crosses the plane through the eye: there it is seen at any slope.
            crossing = (before * forward - behind * right) / (forward - behind)
            low, high = (low, math.inf) if crossing > 0.0 else (-math.inf, high)
    return low, high


@kernel
def box_slab(seen: np.ndarray, i: int, along_x: float, along_y: float) -> tuple[float, float, float]:
    """Depths where a ray enters a box's footprint along x and along y, and where it leaves."""
    one_x = 1.0 / (along_x if along_x != 0.0 else 1e-300)
    one_y = 1.0 / (along_y if along_y != 0.0 else 1e-300)
    near_x, far_x = (seen[i, DX] - seen[i, RX]) * one_x, (seen[i, DX] + seen[i, RX]) * one_x
    near_y, far_y = (seen[i, DY] - seen[i, RY]) * one_y, (seen[i, DY] + seen[i, RY]) * one_y
    return min(near_x, far_x), min(near_y, far_y), min(max(near_x, far_x), max(near_y, far_y))


@kernel
def depths(seen: np.ndarray, i: int, view: np.ndarray, u: float) -> tuple[float, float]:
    """Where slope `u` enters and leaves the footprint [m]; the entry is <= 0 from within."""
    if seen[i, KIND] == BOX:
        along_x, along_y = u * view[COS] - view[SIN], u * view[SIN] + view[COS]
        near_x, near_y, far = box_slab(seen, i, along_x, along_y)
        return max(near_x, near_y), far
    square = 1.0 / (1.0 + u * u)
    middle = (seen[i, RIGHT] * u + seen[i, FORWARD]) * square
    beside = seen[i, RIGHT] - seen[i, FORWARD] * u
    half = math.sqrt(max(0.0, (seen[i, RX] * seen[i, RX] - beside * beside * square) * square))
    return middle - half, middle + half


@kernel
def before(seen: np.ndarray, one: int, other: int, view: np.ndarray, u: float) -> bool:
    """Whether `one` may hide `other` along `u`: it is nearer; in height, if one is above the other."""
    entry, leave = depths(seen, one, view, u)
    entry_other, leave_other = depths(seen, other, view, u)
    common = min(leave, leave_other) - max(entry, entry_other)
    if common > 1e-9 * abs(max(leave, leave_other)):
        z = view[EYE_Z]
        away = max(0.0, seen[one, BOTTOM] - z, z - seen[one, TOP])
        away_other = max(0.0, seen[other, BOTTOM] - z, z - seen[other, TOP])
        if away != away_other:
            return away < away_other
    return entry < entry_other


@kernel
def section(seen: np.ndarray, i: int, view: np.ndarray, u: float, span: tuple, hit: np.ndarray) -> None:
    """Fill `hit` with the rows of the body along slope `u`, and the depths of its `span`."""
    hit[ENTRY], hit[EXIT] = max(NEAR, span[0]), max(NEAR, span[1])
    if seen[i, KIND] == ELLIPSOID:
        _ellipsoid_rows(seen, i, view, u, hit)
        return
    horizon, focal = view[HORIZON], view[FOCAL]
    over_top, over_bottom = view[EYE_Z] - seen[i, TOP], view[EYE_Z] - seen[i, BOTTOM]
    hit[UNDER] = hit[END] = horizon + focal * over_bottom / hit[ENTRY]
    if over_bottom < 0.0:
        hit[END] = horizon + focal * over_bottom / hit[EXIT]
    if seen[i, KIND] == CONE:
        hit[SIDE] = hit[CAP] = min(hit[UNDER], horizon + focal * _cone_top(seen, i, view, u, hit))
        return
    hit[SIDE] = hit[CAP] = horizon + focal * over_top / hit[ENTRY]
    if over_top > 0.0:
        hit[CAP] = horizon + focal * over_top / hit[EXIT]


@kernel
def _cone_top(seen: np.ndarray, i: int, view: np.ndarray, u: float, hit: np.ndarray) -> float:
    """Fall per depth where a cone begins: its tangent, else the far edge of its base, else inf (unseen)."""
    steep = seen[i, RX] / (seen[i, TOP] - seen[i, BOTTOM])
    rise = seen[i, TOP] - view[EYE_Z]
    over_bottom = view[EYE_Z] - seen[i, BOTTOM]
    away = math.sqrt(seen[i, RIGHT] * seen[i, RIGHT] + seen[i, FORWARD] * seen[i, FORWARD])
    outside = (away - steep * rise) * (away + steep * rise)
    if outside > 0.0:
        middle, beside = seen[i, RIGHT] * u + seen[i, FORWARD], seen[i, RIGHT] - seen[i, FORWARD] * u
        fall = (math.sqrt(outside) * abs(beside) - middle * rise * steep) / (steep * away * away)
        touch = (middle + steep * steep * rise * fall) / (1.0 + u * u - (steep * fall) ** 2)
        if touch > 0.0 and view[EYE_Z] - fall * touch >= seen[i, BOTTOM]:
            return fall
    return over_bottom / hit[EXIT] if over_bottom > 0.0 else math.inf


@kernel
def _ellipsoid_rows(seen: np.ndarray, i: int, view: np.ndarray, u: float, hit: np.ndarray) -> None:
    """Both tangents to an ellipse; only one where the eye is over or under it.

    In units of the half-axes: the fall per depth m touches where
    away * m^2 - 2 * middle * over * m + rest = 0.
    """
    half = 0.5 * (seen[i, TOP] - seen[i, BOTTOM])
    over = (view[EYE_Z] - seen[i, BOTTOM]) / half - 1.0
    right, forward = seen[i, RIGHT] / seen[i, RX], seen[i, FORWARD] / seen[i, RX]
    middle, beside = right * u + forward, right - forward * u
    square = 1.0 + u * u
    away = right * right + forward * forward - 1.0
    outside = max(0.0, away + over * over)
    rest = square * outside - middle * middle
    root = math.sqrt(outside * max(0.0, square - beside * beside))
    ahead = middle * abs(over)
    near = rest / (ahead + root) if middle > 0.0 else (ahead - root) / min(-1e-300, away)
    if middle > 0.0 and not ahead + root > 1e-9:  # at the tangent to the equator, level with it
        near = 0.0
    far = (ahead + root) / away if away > 0.0 else math.inf
    if over < 0.0:
        near, far = -far, -near
    scale = view[FOCAL] * half / seen[i, RX]
    hit[CAP] = hit[SIDE] = view[HORIZON] + scale * near
    hit[UNDER] = hit[END] = view[HORIZON] + scale * far
    if seen[i, BOTTOM] < 0.0:
        touch = (middle + over * near) * seen[i, RX] / (square + near * near)
        buried = view[EYE_Z] - near * half / seen[i, RX] * touch < 0.0
        _bury(seen, i, view, u, buried, hit)


@kernel
def _bury(seen: np.ndarray, i: int, view: np.ndarray, u: float, buried: bool, hit: np.ndarray) -> None:
    """Take the rows of an ellipsoid below the ground away; `buried`: its upper tangent touches there."""
    half = 0.5 * (seen[i, TOP] - seen[i, BOTTOM])
    level = 1.0 + seen[i, BOTTOM] / half  # of the middle above the ground, in half-heights
    square = 1.0 / (1.0 + u * u)
    beside = seen[i, RIGHT] - seen[i, FORWARD] * u
    rest = seen[i, RX] * seen[i, RX] * (1.0 - level * level) - beside * beside * square
    if rest <= 0.0:
        hit[END] = hit[END] if level > 0.0 else hit[CAP]
    else:
        middle, part = (seen[i, RIGHT] * u + seen[i, FORWARD]) * square, math.sqrt(rest * square)
        drop = view[FOCAL] * view[EYE_Z]
        hit[END] = min(hit[END], view[HORIZON] + drop / max(NEAR, middle - part))
        if buried:
            hit[CAP] = hit[SIDE] = view[HORIZON] + drop / max(NEAR, middle + part)
    hit[UNDER] = hit[END]


@kernel
def meet(seen: np.ndarray, i: int, view: np.ndarray, u: float, fall: float, hit: np.ndarray) -> tuple:
    """Where the ray of slope `u` and `fall` per depth meets a cone's side or an ellipsoid.

    Returns:
        Right, forward and up of the point from the middle of the body's axis [m], and the
        outward normal's right, forward and up, of length 1.
    """
    half, radius, z = 0.5 * (seen[i, TOP] - seen[i, BOTTOM]), seen[i, RX], view[EYE_Z]
    middle = seen[i, RIGHT] * u + seen[i, FORWARD]
    away = seen[i, RIGHT] * seen[i, RIGHT] + seen[i, FORWARD] * seen[i, FORWARD]
    if seen[i, KIND] == CONE:
        steep, rise = 0.5 * radius / half, seen[i, TOP] - z
        a = 1.0 + u * u - (steep * fall) ** 2
        b = middle + steep * steep * rise * fall
        c = away - (steep * rise) ** 2
    else:
        ratio, over = (radius / half) ** 2, z - seen[i, BOTTOM] - half
        a = 1.0 + u * u + ratio * fall * fall
        b = middle + ratio * over * fall
        c = away + ratio * over * over - radius * radius
    root = math.sqrt(max(0.0, b * b - a * c))
    # Seen from inside the cone's continuation above its apex, the second crossing is the side.
    depth = c / (b + root) if c > 0.0 else (b - root) / (a if a != 0.0 else -1e-300)
    depth = min(max(depth, hit[ENTRY]), hit[EXIT])
    right, forward = depth * u - seen[i, RIGHT], depth - seen[i, FORWARD]
    up = z - fall * depth - seen[i, BOTTOM] - half
    n_up = 0.5 * math.sqrt(right * right + forward * forward) * radius / half
    if seen[i, KIND] == ELLIPSOID:
        n_up = up * (radius / half) ** 2
    length = 1.0 / math.sqrt(max(1e-300, right * right + forward * forward + n_up * n_up))
    return right, forward, up, right * length, forward * length, n_up * length
