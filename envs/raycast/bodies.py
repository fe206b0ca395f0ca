"""Kernels of one body in one image column: is it in view, between which depths, in which rows.

The camera only yaws, so a column is an upright plane through the eye, in which every body is
convex: a rectangle, an ellipse, or the piece of a hyperbola above a cone's base. Along slope
u = right / forward a point at depth d lies at d * u to the right; a point at height z shows in
row horizon + focal * (eye - z) / d. Input is assumed valid.
"""

import math

import numpy as np

from envs.raycast.coverage import (
    COS,
    EYE_X,
    EYE_Y,
    EYE_Z,
    FOCAL,
    HORIZON,
    SIN,
    SUN_FORWARD,
    SUN_RIGHT,
    inlined,
    kernel,
)
from envs.scene import BOX, CONE, ELLIPSOID, POLE

NEAR = 1e-9  # [m]; smallest depth, so that a division is always defined
FLAT = 1e-3  # an outline that bends less is integrated as a parabola
# Columns of the array of bodies: centre [m], bottom and top [m], half-axes [m], albedo, metres
# of texture per radian; and for those in view: place relative to the eye, right and forward of
# it, slopes of the left and right silhouette; of round ones: what the outline's arcs need, see
# `mean_root`; the slope at which `stand` has last looked, and what it found there.
KIND, X, Y, BOTTOM, TOP, RX, RY, ALBEDO, TURN = range(9)
DX, DY, RIGHT, FORWARD, LOW, HIGH, POWER, BEND, CREST, AT, ROWS, ROOT, COSINE = (*range(9, 20), 23, 24)
FIELDS = 25
# What a column shows of a body: rows where its upper level face, its side and its underside
# begin, and where it ends, each at the left and the right end of a strip, then in one column
# (SECTION); depths where the column enters and leaves its footprint.
CAP, SIDE, UNDER, END, SECTION, ENTRY, EXIT, COSINES = 0, 2, 4, 6, 8, 12, 13, 14
# What is known of a strip, beside the body: slopes of its ends;
# mean root of what is shown, luminance of its side and of its level face; the wall that comes
# next: which (+-1), its depth and that of the other one [m]; of the gap that is painted: slopes
# of its middle and of its ends, its weight [pixels].
FIRST, LAST, MEAN_ROOT, LIGHT, LEVEL_LIGHT, WALL_SIDE, WALL_DEPTH, WALL_AFTER = range(16, 24)
SLOPE, LEFT_END, RIGHT_END, WEIGHT, KNOWN = range(24, 29)
FARTHEST = 1e4  # [rows] an arc that bulges more is not seen
OUTSIDE = 1e7  # [rows] far outside of any image


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
        seen[count, LOW], seen[count, HIGH], seen[count, AT] = low, high, math.inf
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
    distance = math.sqrt(right * right + forward * forward)
    power = (distance - radius) * (distance + radius)
    seen[i, POWER], seen[i, BEND] = power, (forward / radius) ** 2 - 1.0
    seen[i, CREST] = power / (radius * radius) / seen[i, BEND]
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
    middle, half = seen[i, RIGHT] * u + seen[i, FORWARD], seen[i, RX] * root(seen, i, u)
    square = 1.0 / (1.0 + u * u)
    return (middle - half) * square, (middle + half) * square


@inlined
def root(seen: np.ndarray, i: int, u: float) -> float:
    """Half of the chord that slope `u` cuts from a circle, in radii, times sqrt(1 + u^2)."""
    beside = (seen[i, RIGHT] - seen[i, FORWARD] * u) / seen[i, RX]
    return math.sqrt(max(0.0, 1.0 + u * u - beside * beside))


@kernel
def mean_root(seen: np.ndarray, i: int, left: float, right: float, roots: tuple) -> float:
    """Mean of `root` over the slopes left .. right, of whose ends `roots` are known.

    Over u, the root is the arc of an ellipse, root^2 = CREST - BEND * (u - its middle)^2: its
    area is that below the chord and the segment above, which the chord's length in the
    ellipse's own axes determines.
    """
    one, other = roots
    if not seen[i, BEND] > FLAT:  # beside the eye, where it is a hyperbola
        return (one + 4.0 * root(seen, i, 0.5 * (left + right)) + other) / 6.0
    wide = right - left
    square = 0.25 * (seen[i, BEND] * wide * wide + (other - one) * (other - one)) / seen[i, CREST]
    x = math.sqrt(square)
    if square < 0.04:  # of the series, what is left out is below 1e-6 of the segment
        segment = x * square * (2.0 / 3.0 + square * (0.2 + square * (3.0 / 28.0 + square * 5.0 / 72.0)))
    else:
        square = min(1.0, square)
        segment = math.asin(math.sqrt(square)) - math.sqrt(square * (1.0 - square))
    return 0.5 * (one + other) + segment * seen[i, CREST] / (math.sqrt(seen[i, BEND]) * max(wide, 1e-300))


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
def stand(seen: np.ndarray, i: int, view: np.ndarray, u: float, hit: np.ndarray) -> None:
    """Note in `seen` a body's rows and root along slope `u`, and the cosine of a pole towards the sun."""
    arc = 0.0 if seen[i, KIND] == BOX else root(seen, i, u)
    section(seen, i, view, u, arc, hit)
    for k in range(4):
        seen[i, ROWS + k] = hit[SECTION + k]
    seen[i, AT], seen[i, ROOT] = u, arc
    if seen[i, KIND] == POLE:
        seen[i, COSINE] = cosine(seen, i, view, u, arc)


@inlined
def cosine(seen: np.ndarray, i: int, view: np.ndarray, u: float, arc: float) -> float:
    """Cosine between the sun and a pole's side where slope `u`, whose root is `arc`, meets it."""
    entry = (seen[i, RIGHT] * u + seen[i, FORWARD] - seen[i, RX] * arc) / (1.0 + u * u)
    right, forward = entry * u - seen[i, RIGHT], entry - seen[i, FORWARD]
    return (right * view[SUN_RIGHT] + forward * view[SUN_FORWARD]) / seen[i, RX]


@inlined
def outline(seen: np.ndarray, i: int, view: np.ndarray, strip: tuple, hit: np.ndarray) -> float:
    """Fill `hit` with the rows of a body at both ends of a strip of slopes; the mean of its root.

    Edges are taken as straight. Where they are arcs, they are shifted to the mean of the arc:
    rows depend on the root linearly.
    """
    left, right = strip
    if seen[i, AT] != left:
        stand(seen, i, view, left, hit)
    one, lit = seen[i, ROOT], seen[i, COSINE]
    for k in range(4):
        hit[2 * k] = seen[i, ROWS + k]
    stand(seen, i, view, right, hit)
    for k in range(4):
        hit[2 * k + 1] = seen[i, ROWS + k]
    hit[COSINES], hit[COSINES + 1] = lit, seen[i, COSINE]
    if seen[i, KIND] == BOX:
        return 0.0
    arc = mean_root(seen, i, left, right, (one, seen[i, ROOT]))
    section(seen, i, view, 0.5 * (left + right), arc, hit)
    for k in range(0, 8, 2):
        bulge = hit[SECTION + k // 2] - 0.5 * (hit[k] + hit[k + 1])
        if abs(bulge) < FARTHEST:
            hit[k], hit[k + 1] = hit[k] + bulge, hit[k + 1] + bulge
        if k > 0:
            hit[k], hit[k + 1] = max(hit[k], hit[k - 2]), max(hit[k + 1], hit[k - 1])
    return arc


@kernel
def section(seen: np.ndarray, i: int, view: np.ndarray, u: float, arc: float, hit: np.ndarray) -> None:
    """Fill `hit` from SECTION on with the rows of the body along slope `u`, of which `arc` is the root."""
    if seen[i, KIND] == ELLIPSOID:
        _ellipsoid_rows(seen, i, view, u, arc, hit)
        return
    if seen[i, KIND] == BOX:
        entry, leave = depths(seen, i, view, u)
        near, far = 1.0 / max(NEAR, entry), 1.0 / max(NEAR, leave)
    else:
        middle, half = seen[i, RIGHT] * u + seen[i, FORWARD], seen[i, RX] * arc
        near = min(1.0 / NEAR, max(0.0, middle + half) / max(1e-300, seen[i, POWER]))
        far = min(1.0 / NEAR, (1.0 + u * u) / max(NEAR, middle + half))
    horizon, focal = view[HORIZON], view[FOCAL]
    over_top, over_bottom = view[EYE_Z] - seen[i, TOP], view[EYE_Z] - seen[i, BOTTOM]
    under = end = horizon + focal * over_bottom * near
    if over_bottom < 0.0:
        end = horizon + focal * over_bottom * far
    if seen[i, KIND] == CONE:
        side = cap = min(under, horizon + focal * _cone_top(seen, i, view, u, far))
    else:
        side = cap = horizon + focal * over_top * near
        if over_top > 0.0:
            cap = horizon + focal * over_top * far
    _note(hit, cap, side, under, end)


@inlined
def _note(hit: np.ndarray, cap: float, side: float, under: float, end: float) -> None:
    """Write the rows of a section, each a number of moderate size."""
    hit[SECTION], hit[SECTION + 1] = min(max(cap, -OUTSIDE), OUTSIDE), min(max(side, -OUTSIDE), OUTSIDE)
    hit[SECTION + 2], hit[SECTION + 3] = min(max(under, -OUTSIDE), OUTSIDE), min(max(end, -OUTSIDE), OUTSIDE)


@kernel
def _cone_top(seen: np.ndarray, i: int, view: np.ndarray, u: float, far: float) -> float:
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
    return over_bottom * far if over_bottom > 0.0 else math.inf


@kernel
def _ellipsoid_rows(seen: np.ndarray, i: int, view: np.ndarray, u: float, arc: float, hit) -> None:
    """Both tangents to an ellipse; only one where the eye is over or under it.

    In units of the half-axes: the fall per depth m touches where
    away * m^2 - 2 * middle * over * m + rest = 0.
    """
    half = 0.5 * (seen[i, TOP] - seen[i, BOTTOM])
    over = (view[EYE_Z] - seen[i, BOTTOM]) / half - 1.0
    right, forward = seen[i, RIGHT] / seen[i, RX], seen[i, FORWARD] / seen[i, RX]
    middle, square = right * u + forward, 1.0 + u * u
    away = right * right + forward * forward - 1.0
    outside = max(0.0, away + over * over)
    rest, root = square * outside - middle * middle, math.sqrt(outside) * arc
    ahead = middle * abs(over)
    if away > 1e-3:
        near = (ahead - root) / away
    else:  # the same, exact also where the eye is over or under the equator
        near = rest / (ahead + root) if middle > 0.0 else (ahead - root) / min(-1e-300, away)
        if middle > 0.0 and not ahead + root > 1e-9:  # at the tangent to the equator, level with it
            near = 0.0
    far = (ahead + root) / away if away > 0.0 else math.inf
    if over < 0.0:
        near, far = -far, -near
    scale = view[FOCAL] * half / seen[i, RX]
    upper, lower = view[HORIZON] + scale * near, view[HORIZON] + scale * far
    if seen[i, BOTTOM] < 0.0:
        touch = (middle + over * near) * seen[i, RX] / (square + near * near)
        buried = view[EYE_Z] - near * half / seen[i, RX] * touch < 0.0
        upper, lower = _bury(seen, i, view, u, buried, (upper, lower))
    _note(hit, upper, upper, lower, lower)


@kernel
def _bury(seen: np.ndarray, i: int, view: np.ndarray, u: float, buried: bool, rows: tuple) -> tuple:
    """The rows of an ellipsoid above the ground; `buried`: its upper tangent touches below."""
    upper, lower = rows
    half = 0.5 * (seen[i, TOP] - seen[i, BOTTOM])
    level = 1.0 + seen[i, BOTTOM] / half  # of the middle above the ground, in half-heights
    square = 1.0 / (1.0 + u * u)
    beside = seen[i, RIGHT] - seen[i, FORWARD] * u
    rest = seen[i, RX] * seen[i, RX] * (1.0 - level * level) - beside * beside * square
    if rest <= 0.0:
        return upper, lower if level > 0.0 else upper
    middle, part = (seen[i, RIGHT] * u + seen[i, FORWARD]) * square, math.sqrt(rest * square)
    drop = view[FOCAL] * view[EYE_Z]
    lower = min(lower, view[HORIZON] + drop / max(NEAR, middle - part))
    if buried:
        upper = view[HORIZON] + drop / max(NEAR, middle + part)
    return upper, lower
