"""Kernels that paint a wall or a body into one strip: clip it to the gaps, paint it, close the gaps.

A strip's gaps are the parts that nothing nearer covers, each between two straight edges. A surface is
clipped to the gaps at both ends, so that painted areas and gaps always add up to the strip. Input is
assumed valid.
"""

import math

import numpy as np

from envs.compiled import inlined, kernel
from envs.raycast import coverage, curved, patterns
from envs.raycast.bodies import MIN_DEPTH, box_slab, cosine, mean_root, root
from envs.raycast.coverage import Layer, beyond, ends, is_open, put
from envs.raycast.records import Canvas, Ends, Record
from envs.scene import BOX, ELLIPSOID, POLE

MIN_CROSSING = 0.02  # [rows] edges that cross by less are not cut there
MAX_SHARE = 0.1  # [widths of a body] a strip of a textured pole wider than this is halved


@kernel
def wall_depth(frame: Record, side: float, u: float) -> float:
    """Return the depth at which slope `u` meets the wall at x = side * half width [m]; inf if never."""
    depth = (side * frame.wall_half - frame.eye_x) / (u * frame.cos - frame.sin)
    y = frame.eye_y + depth * (u * frame.sin + frame.cos)
    return depth if depth > MIN_DEPTH and frame.wall_near <= y <= frame.wall_far else math.inf


@inlined
def _in_gap(gap: Record, edge: Record) -> Ends:
    """Return the rows of a surface's edge at both ends of a gap."""
    left, right = edge.left, edge.right
    return Ends(left + gap.reach.left * (right - left), right + (1.0 - gap.reach.right) * (left - right))


@inlined
def _clip(gap: Record, edge: Record) -> Ends:
    """Return an edge of a surface, clipped to a gap."""
    left, right = beyond(_in_gap(gap, edge), ends(gap.top))
    left, right = beyond(Ends(-left, -right), Ends(-gap.bottom.left, -gap.bottom.right))
    return Ends(-left, -right)


@inlined
def _cut_gaps(gaps: np.ndarray, strip: Record, count: int) -> int:
    """Cut the gaps where an edge of the surface crosses an edge of a gap; return the new number of gaps."""
    count = _cut_by(gaps, strip.cap, count)
    count = _cut_by(gaps, strip.end, count)
    if strip.side.left > strip.cap.left or strip.side.right > strip.cap.right:
        count = _cut_by(gaps, strip.side, count)
    if strip.end.left > strip.under.left or strip.end.right > strip.under.right:
        count = _cut_by(gaps, strip.under, count)
    return count


@kernel
def _cut_by(gaps: np.ndarray, edge: Record, count: int) -> int:
    """Cut the gaps where an edge crosses their edges, as long as less than half the room is used."""
    k = 0
    while k < count:
        count = _cut_at(gaps, k, edge, gaps[k].top, count)
        count = _cut_at(gaps, k, edge, gaps[k].bottom, count)
        k += 1
    return count


@inlined
def _cut_at(gaps: np.ndarray, k: int, edge: Record, limit: Record, count: int) -> int:
    """Cut gap `k` where an edge crosses the gap's edge `limit`; return the new number of gaps."""
    left, right = _in_gap(gaps[k], edge)
    one, other = left - limit.left, right - limit.right
    if one * other < 0.0 and min(abs(one), abs(other)) > MIN_CROSSING and 2 * count < len(gaps):
        coverage.cut_gap(gaps, k, count, one / (one - other))
        return count + 1
    return count


@inlined
def enter_gap(frame: Record, strip: Record, gap: Record) -> None:
    """Store the slopes and the width of a gap in the strip."""
    first, wide = strip.slopes.left, strip.slopes.right - strip.slopes.left
    left, right = first + gap.reach.left * wide, first + gap.reach.right * wide
    put(strip.gap_slopes, Ends(left, right))
    strip.slope, strip.weight = 0.5 * (left + right), frame.focal * (right - left)


@inlined
def _is_same(one: Record, other: Record) -> bool:
    """Whether two edges have the same rows."""
    return one.left == other.left and one.right == other.right


@kernel
def _carve(canvas: Canvas, count: int, k: int, first: Ends, last: Ends, standing: bool) -> int:
    """Remove a painted surface, from edge `first` to `last`, from gap `k`; return the new number of gaps.

    Below a surface that is `standing` on the ground only ground is visible, so that part of the gap closes.
    """
    frame, strip, gaps = canvas.frame, canvas.strip, canvas.gaps
    gap = gaps[k]
    top, bottom = ends(gap.top), ends(gap.bottom)
    below = is_open(last, bottom) and count < len(gaps)
    if below and standing:
        if frame.ground_texture.contrast > 0.0:
            coverage.cover_ground(frame, canvas.accumulators, last, bottom, strip.weight, strip.slope)
        below = False
    if is_open(top, first):
        if below:
            gaps[count] = gap
            put(gaps[count].top, last)
        put(gap.bottom, first)
        return count + below
    if below:
        put(gap.top, last)
        return count
    gaps[k] = gaps[count - 1]
    return count - 1


@inlined
def _outline_wall(frame: Record, strip: Record) -> None:
    """Store the rows of the next wall in the strip."""
    away = frame.focal / (strip.wall_side * frame.wall_half - frame.eye_x)
    left = max(0.0, away * (strip.slopes.left * frame.cos - frame.sin))
    right = max(0.0, away * (strip.slopes.right * frame.cos - frame.sin))
    over_top, horizon = frame.eye_z - frame.wall_top, frame.horizon
    top = Ends(horizon + left * over_top, horizon + right * over_top)
    foot = Ends(horizon + left * frame.eye_z, horizon + right * frame.eye_z)
    put(strip.cap, top)
    put(strip.side, top)
    put(strip.under, foot)
    put(strip.end, foot)


@kernel
def show_walls(canvas: Canvas, count: int, limit: float) -> int:
    """Paint the remaining walls nearer than `limit` [m] into the gaps; return the new number of gaps."""
    frame, strip, gaps, accumulators = canvas.frame, canvas.strip, canvas.gaps, canvas.accumulators
    while strip.wall_depth < limit:
        side = strip.wall_side
        _outline_wall(frame, strip)
        facing = frame.lit_east if frame.eye_x > side * frame.wall_half else frame.lit_west
        count = _cut_gaps(gaps, strip, count)
        for k in range(count - 1, -1, -1):
            top, bottom = _clip(gaps[k], strip.cap), _clip(gaps[k], strip.end)
            if is_open(top, bottom):
                enter_gap(frame, strip, gaps[k])
                coverage.fill(frame, accumulators, top, bottom, frame.wall_albedo * facing, strip.weight)
                if frame.wall_texture.contrast > 0.0:
                    layer = Layer.RIGHT_WALL if side > 0.0 else Layer.LEFT_WALL
                    coverage.cover(accumulators[layer : layer + 3], top, bottom, strip.weight, strip.slope)
                count = _carve(canvas, count, k, top, bottom, True)
        strip.wall_side, strip.wall_depth, strip.wall_after = -side, strip.wall_after, math.inf
    return count


@kernel
def _lit_part(frame: Record, body: Record, strip: Record) -> float:
    """Return the mean cosine over a strip of a pole that is lit only up to where the sun's rays graze it."""
    length = math.sqrt(frame.sun_right * frame.sun_right + frame.sun_forward * frame.sun_forward)
    right, forward = -frame.sun_forward / length, frame.sun_right / length
    away = right * body.right + forward * body.forward
    radius = -math.copysign(body.rx, away)
    grazed = (body.right + radius * right) / max(MIN_DEPTH, body.forward + radius * forward)
    first, last = strip.slopes.left, strip.slopes.right
    grazed = min(max(grazed, first), last)
    low, high = (first, grazed) if strip.cosine.left > 0.0 else (grazed, last)
    arc = mean_root(body, low, high, root(body, low), root(body, high))
    return cosine(body, frame, 0.5 * (low + high), arc) * (high - low) / (last - first)


@inlined
def _side_light(frame: Record, body: Record, strip: Record) -> float:
    """Return the mean luminance of the side of a pole or box over the strip."""
    middle = 0.5 * (strip.slopes.left + strip.slopes.right)
    if body.kind == POLE:
        one, other = strip.cosine.left, strip.cosine.right
        if one < 0.0 or other < 0.0:
            towards = _lit_part(frame, body, strip) if max(one, other) > 0.0 else 0.0
        else:
            towards = cosine(body, frame, middle, strip.mean_root)
        return body.albedo * (frame.ambient + frame.diffuse * min(1.0, max(0.0, towards)))
    along_x, along_y = middle * frame.cos - frame.sin, middle * frame.sin + frame.cos
    near_x, near_y, _ = box_slab(body, along_x, along_y)
    if near_x > near_y:
        return body.albedo * (frame.lit_west if along_x > 0.0 else frame.lit_east)
    return body.albedo * (frame.lit_south if along_y > 0.0 else frame.lit_north)


@inlined
def _is_curved(body: Record) -> bool:
    """Whether a body's side is curved along a column, so that each row has its own luminance."""
    return body.kind != POLE and body.kind != BOX


@kernel
def _cut_for_body(canvas: Canvas, body: Record, count: int) -> int:
    """Cut the gaps where a body's edges cross their edges, and in two for a pattern around a wide pole."""
    gaps, strip = canvas.gaps, canvas.strip
    count = _cut_gaps(gaps, strip, count)
    broad = strip.slopes.right - strip.slopes.left > MAX_SHARE * (body.high - body.low)
    textured = canvas.frame.body_texture.contrast > 0.0
    if textured and body.kind == POLE and broad and 2 * count < len(gaps):
        for k in range(count):
            coverage.cut_gap(gaps, k, count + k, 0.5)
        count *= 2
    return count


@inlined
def _paint_faces(canvas: Canvas, body: Record, top: Ends, first: Ends, last: Ends, bottom: Ends) -> None:
    """Paint the areas between four edges: a body's level top, its side, its underside."""
    frame, strip, accumulators = canvas.frame, canvas.strip, canvas.accumulators
    if is_open(first, last):
        coverage.fill(frame, accumulators, first, last, strip.light, strip.weight)
        if _is_curved(body):
            curved.shade_rows(canvas, body, first, last)
    if is_open(top, first):
        coverage.fill(frame, accumulators, top, first, strip.level_light, strip.weight)
    if is_open(last, bottom):
        coverage.fill(frame, accumulators, last, bottom, strip.level_light, strip.weight)
    if frame.body_texture.contrast > 0.0:
        _texture_faces(canvas, body, top, first, last, bottom)


@inlined
def _light_gap(frame: Record, body: Record, strip: Record, mean: float) -> None:
    """Store a pole's luminance in the gap and its tilt; `mean` is the luminance over the whole strip."""
    first, last = strip.slopes.left, strip.slopes.right
    left = body.albedo * (frame.ambient + frame.diffuse * max(0.0, strip.cosine.left))
    right = body.albedo * (frame.ambient + frame.diffuse * max(0.0, strip.cosine.right))
    per_slope = (right - left) / max(MIN_DEPTH, last - first)
    here = left + per_slope * (strip.slope - first)
    strip.tilt = per_slope / here if here > 0.0 else 0.0
    strip.light = mean * here / (0.5 * (left + right)) if here > 0.0 else mean


@inlined
def show_body(canvas: Canvas, body: Record, count: int) -> int:
    """Paint a body, whose rows are in the strip, into the gaps; return the new number of gaps."""
    frame, strip, gaps = canvas.frame, canvas.strip, canvas.gaps
    strip.light = 0.0 if _is_curved(body) else _side_light(frame, body, strip)
    strip.level_light = body.albedo * (frame.lit_up if frame.eye_z > body.top else frame.lit_down)
    count = _cut_for_body(canvas, body, count)
    mean_light, varies = strip.light, frame.body_texture.contrast > 0.0 and body.kind == POLE
    for k in range(count - 1, -1, -1):
        top, bottom = _clip(gaps[k], strip.cap), _clip(gaps[k], strip.end)
        if is_open(top, bottom):
            first = top if _is_same(strip.side, strip.cap) else _clip(gaps[k], strip.side)
            last = bottom if _is_same(strip.under, strip.end) else _clip(gaps[k], strip.under)
            enter_gap(frame, strip, gaps[k])
            if varies:
                _light_gap(frame, body, strip, mean_light)
            _paint_faces(canvas, body, top, first, last, bottom)
            # Under the belly of an ellipsoid more than the ground is visible.
            standing = body.bottom <= MIN_DEPTH and body.kind != ELLIPSOID
            count = _carve(canvas, count, k, top, bottom, standing)
    return count


@kernel
def _texture_faces(canvas: Canvas, body: Record, top: Ends, first: Ends, last: Ends, bottom: Ends) -> None:
    """Add the pattern to a body's flat faces: between four edges, the level top, the side, the underside."""
    if is_open(top, first):
        patterns.texture_level(canvas, top, first, body.top)
    if is_open(last, bottom):
        patterns.texture_level(canvas, last, bottom, body.bottom)
    if is_open(first, last) and not _is_curved(body):
        patterns.texture_side(canvas, body, first, last)
