"""Kernels for one body in one image column: whether it is in view, its depths and its rows.

The camera only yaws, so a column is an upright plane through the eye, in which every body is
convex: a rectangle, an ellipse, or the piece of a hyperbola above a cone's base. Along slope
u = right / forward a point at depth d lies at d * u to the right; a point at height z appears
in row horizon + focal * (eye - z) / d. Input is assumed valid.
"""

import math
from typing import NamedTuple

import numpy as np

from envs.compiled import inlined, kernel
from envs.raycast.records import Record
from envs.scene import BOX, CONE, ELLIPSOID, POLE

MIN_DEPTH = 1e-9  # [m]; so that a division is always defined
MIN_BEND = 1e-3  # an outline that bends less is integrated as a parabola
MAX_BULGE = 1e4  # [rows] an arc that bulges more is invisible
OUTSIDE = 1e7  # [rows] far outside of any image
SURELY = 1.0 + 1e-9  # factor on squared distances that exceeds all rounding errors
WIDE = 2.0  # [pixels] only curved bodies wider than this are tested for hiding other bodies


class Section(NamedTuple):
    """Rows of a body along one slope: where its level top, its side, its underside begin, and its end."""

    cap: float
    side: float
    under: float
    end: float


@kernel
def see_bodies(
    bodies: np.ndarray, frame: Record, low: float, high: float, cull: float, seen: np.ndarray
) -> int:
    """Find the bodies that are in view between two slopes.

    Args:
        bodies: (N,) BODY.
        frame: FRAME record.
        low: Slope of the left end of the view.
        high: Slope of the right end of the view.
        cull: Bodies farther away are left out [m].
        seen: (N,) BODY, whose first elements become the bodies in view.

    Returns:
        The number of bodies in view.
    """
    slack_low, slack_high = math.sqrt(1.0 + low * low), math.sqrt(1.0 + high * high)
    count = 0
    for i in range(len(bodies)):
        body = bodies[i]
        dx, dy = body.x - frame.eye_x, body.y - frame.eye_y
        if body.moves:
            late = frame.time - body.since
            dx, dy = dx + body.vx * late, dy + body.vy * late
        reach = body.rx if body.kind != BOX else math.hypot(body.rx, body.ry)
        right = dx * frame.cos + dy * frame.sin
        forward = dy * frame.cos - dx * frame.sin
        if forward + reach <= 0.0:
            continue
        if right > high * forward + slack_high * reach or right < low * forward - slack_low * reach:
            continue
        seen[count] = body
        body = seen[count]
        if body.moves:
            put_at(body, frame.time)
        body.dx, body.dy, body.right, body.forward, body.at = dx, dy, right, forward, math.inf
        if not _is_outside(body, frame.eye_z, cull):
            continue
        body.low, body.high = _silhouette(body, frame)
        count += body.low < high and body.high > low
    return count


@kernel
def drop_hidden(seen: np.ndarray, count: int, frame: Record) -> int:
    """Leave out bodies hidden behind a cone or an ellipsoid, which would only cut it into more strips.

    A body is convex, and so is its image. A body that hides four corners also hides everything between them.

    Args:
        seen: (N,) BODY, of which the first `count` are in view; the remaining bodies keep their order.
        count: Number of bodies in view.
        frame: FRAME record.

    Returns:
        The number of remaining bodies.
    """
    for k in range(count):
        one = seen[k]
        bends = one.kind == CONE or one.kind == ELLIPSOID
        if bends and frame.focal * (one.high - one.low) > WIDE and one.forward > one.rx:
            _mark_hidden(seen[:count], one, frame)
    kept = 0
    for i in range(count):
        if seen[i].low < seen[i].high:
            if kept < i:
                seen[kept] = seen[i]
            kept += 1
    return kept


@kernel
def _mark_hidden(seen: np.ndarray, one: Record, frame: Record) -> None:
    """Mark each body that `one` hides by setting its right silhouette to minus infinity."""
    for i in range(len(seen)):
        other = seen[i]
        if one.low < other.low < other.high < one.high and _hides(one, other, frame):
            other.high = -math.inf


@kernel
def _hides(one: Record, other: Record, frame: Record) -> bool:
    """Whether body `one` hides body `other`, whose silhouettes lie within those of `one`."""
    near = other.forward - math.hypot(other.rx, other.ry)
    if near <= MIN_DEPTH or not is_before(one, other, frame, 0.5 * (other.low + other.high)):
        return False
    over, high = frame.eye_z - other.top, 2.0 * frame.horizon
    top = frame.horizon + frame.focal * over / (near if over < 0.0 else other.forward + other.rx + other.ry)
    bottom = frame.horizon + frame.focal * max(0.0, frame.eye_z - other.bottom) / near
    for u in (other.low, other.high):
        rows = section(one, frame, u, root(one, u))
        if rows.cap > max(0.0, top) or rows.end < min(high, bottom):
            return False
    return True


@kernel
def put_at(body: Record, time: float) -> None:
    """Move a body that moves to its place at a time [s]."""
    late = time - body.since
    body.x, body.y, body.since = body.x + body.vx * late, body.y + body.vy * late, time
    body.bottom, body.top = body.bottom + body.vz * late, body.top + body.vz * late


@kernel
def silhouette_of(body: Record, frame: Record) -> tuple[float, float]:
    """Return the slopes of the left and right silhouette of a body, in view or not.

    A slope is +-inf under the same conditions as for `_round_silhouette`. The function stores the body's
    position relative to the eye in the body.
    """
    if body.moves:
        put_at(body, frame.time)
    body.dx, body.dy = body.x - frame.eye_x, body.y - frame.eye_y
    body.right = body.dx * frame.cos + body.dy * frame.sin
    body.forward = body.dy * frame.cos - body.dx * frame.sin
    return _silhouette(body, frame)


@inlined
def _silhouette(body: Record, frame: Record) -> tuple[float, float]:
    return _box_silhouette(body, frame) if body.kind == BOX else _round_silhouette(body)


@kernel
def _is_outside(body: Record, eye_z: float, cull: float) -> bool:
    """Whether the eye is outside the body (which is invisible from inside) and at most `cull` [m] away."""
    distance, above = 0.0, max(0.0, eye_z - body.top, body.bottom - eye_z)
    if body.kind != BOX and above == 0.0:  # in most cases the squares decide without roots
        square, reach = body.right * body.right + body.forward * body.forward, cull + body.rx
        if square > SURELY * body.rx * body.rx and SURELY * square < reach * reach:
            return True
    if body.kind == BOX:
        beside_x = max(0.0, abs(body.dx) - body.rx)
        beside = math.hypot(beside_x, max(0.0, abs(body.dy) - body.ry))
    else:
        distance = math.hypot(body.right, body.forward)
        beside = max(0.0, distance - body.rx)
    if beside > 0.0 or above > 0.0:
        return cull == math.inf or math.hypot(beside, above) <= cull
    if body.kind == CONE:
        return distance > body.rx * (body.top - eye_z) / (body.top - body.bottom)
    if body.kind == ELLIPSOID:
        half = 0.5 * (body.top - body.bottom)
        return (distance / body.rx) ** 2 + ((eye_z - body.bottom) / half - 1.0) ** 2 > 1.0
    return False


@kernel
def _round_silhouette(body: Record) -> tuple[float, float]:
    """Return the slopes of both tangents to a circle; +-inf if one points backwards or the eye is inside."""
    right, forward, radius = body.right, body.forward, body.rx
    distance = math.sqrt(right * right + forward * forward)
    power = (distance - radius) * (distance + radius)
    body.power, body.bend = power, (forward / radius) ** 2 - 1.0
    body.crest = power / (radius * radius) / body.bend
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
def corner(body: Record, frame: Record, k: int) -> tuple[float, float]:
    """Return right and forward of the k-th corner of a box's footprint [m]; corners go around the box."""
    dx = body.dx + (body.rx if k == 1 or k == 2 else -body.rx)
    dy = body.dy + (body.ry if k == 2 or k == 3 else -body.ry)
    return dx * frame.cos + dy * frame.sin, dy * frame.cos - dx * frame.sin


@kernel
def _box_silhouette(body: Record, frame: Record) -> tuple[float, float]:
    """Return the slopes of the left and right silhouette of a rectangle; +-inf as in `_round_silhouette`."""
    if abs(body.dx) <= body.rx and abs(body.dy) <= body.ry:
        return -math.inf, math.inf
    low, high = math.inf, -math.inf
    right, forward = corner(body, frame, 3)
    for k in range(4):
        before, behind = right, forward
        right, forward = corner(body, frame, k)
        if forward > 0.0:
            low, high = min(low, right / forward), max(high, right / forward)
        if (forward > 0.0) != (behind > 0.0):
            # The side crosses the plane through the eye, where slopes become infinite.
            crossing = (before * forward - behind * right) / (forward - behind)
            low, high = (low, math.inf) if crossing > 0.0 else (-math.inf, high)
    return low, high


@kernel
def box_slab(body: Record, along_x: float, along_y: float) -> tuple[float, float, float]:
    """Return the depths where a ray enters a box's footprint along x and along y, and where it leaves."""
    one_x = 1.0 / (along_x if along_x != 0.0 else 1e-300)
    one_y = 1.0 / (along_y if along_y != 0.0 else 1e-300)
    near_x, far_x = (body.dx - body.rx) * one_x, (body.dx + body.rx) * one_x
    near_y, far_y = (body.dy - body.ry) * one_y, (body.dy + body.ry) * one_y
    return min(near_x, far_x), min(near_y, far_y), min(max(near_x, far_x), max(near_y, far_y))


@kernel
def depths(body: Record, frame: Record, u: float) -> tuple[float, float]:
    """Return the depths where slope `u` enters (<= 0 from within) and leaves the footprint [m]."""
    if body.kind == BOX:
        along_x, along_y = u * frame.cos - frame.sin, u * frame.sin + frame.cos
        near_x, near_y, far = box_slab(body, along_x, along_y)
        return max(near_x, near_y), far
    middle, half = body.right * u + body.forward, body.rx * root(body, u)
    square = 1.0 / (1.0 + u * u)
    return (middle - half) * square, (middle + half) * square


@inlined
def root(body: Record, u: float) -> float:
    """Return half of the chord that slope `u` cuts from the body's circle, in radii, times sqrt(1 + u^2)."""
    beside = (body.right - body.forward * u) / body.rx
    return math.sqrt(max(0.0, 1.0 + u * u - beside * beside))


@kernel
def mean_root(body: Record, left: float, right: float, one: float, other: float) -> float:
    """Return the mean of `root` over the slopes left .. right, at whose ends it is `one` and `other`.

    As a function of u, the root is the arc of an ellipse, root^2 = crest - bend * (u - its middle)^2. The
    area below the arc is the area below the chord plus the segment above, which follows from the chord's
    length in the ellipse's own axes.
    """
    if not body.bend > MIN_BEND:  # a body beside the eye, for which the arc is a hyperbola
        return (one + 4.0 * root(body, 0.5 * (left + right)) + other) / 6.0
    wide = right - left
    square = 0.25 * (body.bend * wide * wide + (other - one) * (other - one)) / body.crest
    x = math.sqrt(square)
    if square < 0.04:  # the omitted terms of the series are below 1e-6 of the segment
        segment = x * square * (2.0 / 3.0 + square * (0.2 + square * (3.0 / 28.0 + square * 5.0 / 72.0)))
    else:
        square = min(1.0, square)
        segment = math.asin(math.sqrt(square)) - math.sqrt(square * (1.0 - square))
    return 0.5 * (one + other) + segment * body.crest / (math.sqrt(body.bend) * max(wide, 1e-300))


@kernel
def is_before(one: Record, other: Record, frame: Record, u: float) -> bool:
    """Whether `one` may hide `other` along slope `u`: it is nearer (in height, if their depths overlap)."""
    entry, leave = depths(one, frame, u)
    entry_other, leave_other = depths(other, frame, u)
    common = min(leave, leave_other) - max(entry, entry_other)
    if common > 1e-9 * abs(max(leave, leave_other)):
        z = frame.eye_z
        away = max(0.0, one.bottom - z, z - one.top)
        away_other = max(0.0, other.bottom - z, z - other.top)
        if away != away_other:
            return away < away_other
    return entry < entry_other


@kernel
def _look_along(body: Record, frame: Record, u: float) -> None:
    """Store in the body its rows and root along slope `u`, and for a pole the cosine to the sun."""
    arc = 0.0 if body.kind == BOX else root(body, u)
    body.cap, body.side, body.under, body.end = section(body, frame, u, arc)
    body.at, body.root = u, arc
    if body.kind == POLE:
        body.cosine = cosine(body, frame, u, arc)


@inlined
def cosine(body: Record, frame: Record, u: float, arc: float) -> float:
    """Return the cosine between the sun and a pole's side at slope `u`, where the root is `arc`."""
    entry = (body.right * u + body.forward - body.rx * arc) / (1.0 + u * u)
    right, forward = entry * u - body.right, entry - body.forward
    return (right * frame.sun_right + forward * frame.sun_forward) / body.rx


@inlined
def outline(body: Record, frame: Record, strip: Record) -> float:
    """Store the body's rows at both ends of the strip; return the mean of its root.

    Edges are taken as straight. An arc is shifted to its mean row, which follows from the mean root
    because rows are linear in the root.
    """
    left, right = strip.slopes.left, strip.slopes.right
    if body.at != left:
        _look_along(body, frame, left)
    one, strip.cosine.left = body.root, body.cosine
    strip.cap.left, strip.side.left = body.cap, body.side
    strip.under.left, strip.end.left = body.under, body.end
    _look_along(body, frame, right)
    strip.cosine.right = body.cosine
    strip.cap.right, strip.side.right = body.cap, body.side
    strip.under.right, strip.end.right = body.under, body.end
    if body.kind == BOX:
        return 0.0
    arc = mean_root(body, left, right, one, body.root)
    middle = section(body, frame, 0.5 * (left + right), arc)
    _bulge(strip.cap, middle.cap)
    _bulge(strip.side, middle.side)
    _keep_below(strip.side, strip.cap)
    _bulge(strip.under, middle.under)
    _keep_below(strip.under, strip.side)
    _bulge(strip.end, middle.end)
    _keep_below(strip.end, strip.under)
    return arc


@inlined
def _bulge(edge: Record, middle: float) -> None:
    """Shift an edge so that its mean is the row `middle`."""
    bulge = middle - 0.5 * (edge.left + edge.right)
    if abs(bulge) < MAX_BULGE:
        edge.left, edge.right = edge.left + bulge, edge.right + bulge


@inlined
def _keep_below(edge: Record, limit: Record) -> None:
    """Move both ends of an edge down to a limit where they are above the limit."""
    edge.left, edge.right = max(edge.left, limit.left), max(edge.right, limit.right)


@kernel
def section(body: Record, frame: Record, u: float, arc: float) -> Section:
    """Return the body's rows along slope `u`, where the root is `arc`, limited to +-`OUTSIDE`."""
    if body.kind == ELLIPSOID:
        return _ellipsoid_section(body, frame, u, arc)
    if body.kind == BOX:
        entry, leave = depths(body, frame, u)
        near, far = 1.0 / max(MIN_DEPTH, entry), 1.0 / max(MIN_DEPTH, leave)
    else:
        middle, half = body.right * u + body.forward, body.rx * arc
        near = min(1.0 / MIN_DEPTH, max(0.0, middle + half) / max(1e-300, body.power))
        far = min(1.0 / MIN_DEPTH, (1.0 + u * u) / max(MIN_DEPTH, middle + half))
    horizon, focal = frame.horizon, frame.focal
    over_top, over_bottom = frame.eye_z - body.top, frame.eye_z - body.bottom
    under = end = horizon + focal * over_bottom * near
    if over_bottom < 0.0:
        end = horizon + focal * over_bottom * far
    if body.kind == CONE:
        side = cap = min(under, horizon + focal * _cone_top(body, frame, u, far))
    else:
        side = cap = horizon + focal * over_top * near
        if over_top > 0.0:
            cap = horizon + focal * over_top * far
    return Section(_moderate(cap), _moderate(side), _moderate(under), _moderate(end))


@inlined
def _moderate(row: float) -> float:
    return min(max(row, -OUTSIDE), OUTSIDE)


@kernel
def _cone_top(body: Record, frame: Record, u: float, far: float) -> float:
    """Return the fall per depth at a cone's upper edge: its tangent, its base's far edge, or inf (hidden)."""
    steep = body.rx / (body.top - body.bottom)
    rise = body.top - frame.eye_z
    over_bottom = frame.eye_z - body.bottom
    away = math.sqrt(body.right * body.right + body.forward * body.forward)
    outside = (away - steep * rise) * (away + steep * rise)
    if outside > 0.0:
        middle, beside = body.right * u + body.forward, body.right - body.forward * u
        fall = (math.sqrt(outside) * abs(beside) - middle * rise * steep) / (steep * away * away)
        touch = (middle + steep * steep * rise * fall) / (1.0 + u * u - (steep * fall) ** 2)
        if touch > 0.0 and frame.eye_z - fall * touch >= body.bottom:
            return fall
    return over_bottom * far if over_bottom > 0.0 else math.inf


@kernel
def _ellipsoid_section(body: Record, frame: Record, u: float, arc: float) -> Section:
    """Return the rows of both tangents to an ellipse; of one tangent if the eye is over or under it.

    In units of the half-axes, a ray of fall per depth m is a tangent if
    away * m^2 - 2 * middle * over * m + rest = 0.
    """
    half = 0.5 * (body.top - body.bottom)
    over = (frame.eye_z - body.bottom) / half - 1.0
    right, forward = body.right / body.rx, body.forward / body.rx
    middle, square = right * u + forward, 1.0 + u * u
    away = right * right + forward * forward - 1.0
    outside = max(0.0, away + over * over)
    rest, root = square * outside - middle * middle, math.sqrt(outside) * arc
    ahead = middle * abs(over)
    if away > 1e-3:
        near = (ahead - root) / away
    else:  # the same root, exact also if the eye is over or under the equator
        near = rest / (ahead + root) if middle > 0.0 else (ahead - root) / min(-1e-300, away)
        if middle > 0.0 and not ahead + root > 1e-9:  # at the tangent to the equator, level with it
            near = 0.0
    far = (ahead + root) / away if away > 0.0 else math.inf
    if over < 0.0:
        near, far = -far, -near
    scale = frame.focal * half / body.rx
    upper, lower = frame.horizon + scale * near, frame.horizon + scale * far
    if body.bottom < 0.0:
        touch = (middle + over * near) * body.rx / (square + near * near)
        buried = frame.eye_z - near * half / body.rx * touch < 0.0
        upper, lower = _above_ground(body, frame, u, buried, upper, lower)
    upper, lower = _moderate(upper), _moderate(lower)
    return Section(upper, upper, lower, lower)


@kernel
def _above_ground(
    body: Record, frame: Record, u: float, buried: bool, upper: float, lower: float
) -> tuple[float, float]:
    """Return the rows of an ellipsoid's part above ground; `buried`: the upper tangent touches below it."""
    half = 0.5 * (body.top - body.bottom)
    level = 1.0 + body.bottom / half  # of the middle above the ground, in half-heights
    square = 1.0 / (1.0 + u * u)
    beside = body.right - body.forward * u
    rest = body.rx * body.rx * (1.0 - level * level) - beside * beside * square
    if rest <= 0.0:
        return upper, lower if level > 0.0 else upper
    middle, part = (body.right * u + body.forward) * square, math.sqrt(rest * square)
    drop = frame.focal * frame.eye_z
    lower = min(lower, frame.horizon + drop / max(MIN_DEPTH, middle - part))
    if buried:
        upper = frame.horizon + drop / max(MIN_DEPTH, middle + part)
    return upper, lower
