"""Kernels that average patterns over the part of a surface that is visible in one row of a strip.

This part is approximated by a parallelogram of the surface, on level faces by several. Over a parallelogram
noise, stripes and rings are averaged exactly, a checker exactly if the sides are along s and q. Input is
assumed valid.
"""

import math
from typing import NamedTuple

import numpy as np

from envs.compiled import inlined, kernel
from envs.raycast.bodies import MIN_DEPTH, box_slab, depths
from envs.raycast.coverage import Layer, share_below
from envs.raycast.noise import Footprint, is_tabulated, mean_noise, mix_ground
from envs.raycast.records import Canvas, Ends, Record
from envs.scene import BOX
from envs.scene.textures import NOISE, RINGS, STRIPES, TILE_PERIODS

MIN_WIDTH = 1e-6  # [periods] a footprint below this counts as a point
MIN_SIDE = 1e-4  # [periods] a side below this is left out if the other side is longer
MIN_ROW = 1e-6  # [pixels] smallest distance of a row from the horizon
MAX_EDGES = 8  # edges of a pattern at which a row is cut, at most
MIN_SHOWN = 1e-9  # [pixels] weight below which a surface is not textured


class Rows(NamedTuple):
    """Range of image rows over which a pattern is averaged."""

    first: float
    last: float


class Upright(NamedTuple):
    """Part of an upright surface that is visible in a strip [m].

    Attributes:
        s: Surface coordinate of the middle.
        along: Length along s.
        swing: Mean of the pattern along s, for checker and stripes; dimensionless.
        q: The other surface coordinate, at the height of the eye.
        depth: Mean depth from the eye.
        lean: Depth of the right end minus depth of the left end.
    """

    s: float
    along: float
    swing: float
    q: float
    depth: float
    lean: float


@kernel
def _wave(middle: float, wide: float) -> float:
    """Return the mean of a square wave of period 1, +1 first, over an interval [periods]; exact."""
    if wide < MIN_WIDTH:
        return 1.0 if middle - np.floor(middle) < 0.5 else -1.0
    start, end = middle - 0.5 * wide, middle + 0.5 * wide
    start, end = start - np.floor(start), end - np.floor(end)
    return min(1.0, max(-1.0, (min(end, 1.0 - end) - min(start, 1.0 - start)) / wide))


@inlined
def _bow(x: float) -> float:
    """Return a second integral of the square wave, of period 1."""
    half = 2.0 * x - np.floor(2.0 * x)
    sign = 1.0 if np.floor(2.0 * x) % 2.0 == 0.0 else -1.0
    return 0.125 * sign * half * (half - 1.0)


@kernel
def _wave_between(middle: float, one: float, other: float) -> float:
    """Return the mean of the square wave over a parallelogram of sides `one` and `other` [periods]; exact."""
    one, other = abs(one), abs(other)
    if min(one, other) < MIN_SIDE:
        return _wave(middle, max(one, other))
    far, near = 0.5 * (one + other), 0.5 * (one - other)
    bend = _bow(middle + far) - _bow(middle + near) - _bow(middle - near) + _bow(middle - far)
    return min(1.0, max(-1.0, bend / (one * other)))


@inlined
def _scaled(sides: Footprint, scale: float) -> Footprint:
    """Return a footprint multiplied by `scale`."""
    return Footprint(sides.one_s * scale, sides.one_q * scale, sides.other_s * scale, sides.other_q * scale)


@kernel
def mean_pattern(canvas: Canvas, look: Record, s: float, q: float, sides: Footprint) -> float:
    """Return contrast times the mean of a texture over the parallelogram around (s, q) [m].

    Exact for noise, stripes and rings. A checker is averaged along s and q separately, which is exact if the
    footprint is a rectangle along s and q, or if it has no edge along one of them.
    """
    time, scale = canvas.frame.time, look.frequency
    s = (s - look.speed_s * time) * scale
    q = (q - look.speed_q * time) * scale
    mean = look.contrast
    if look.pattern == NOISE:
        tiles = 1.0 / TILE_PERIODS
        sides = _scaled(sides, tiles * scale)
        waves = canvas.noise.waves[look.noise]
        return mean * mean_noise(waves, canvas.mixing.terms, tiles * s, tiles * q, sides)
    sides = _scaled(sides, scale)
    if look.pattern != RINGS:
        mean *= _wave_between(s, sides.one_s, sides.other_s)
    if look.pattern != STRIPES:
        mean *= _wave_between(q, sides.one_q, sides.other_q)
    return mean


@kernel
def _level_row(canvas: Canvas, look: Record, rows: Rows, height: float, u: float, wide: float) -> float:
    """Return contrast times the mean of a texture of a level face at `height` [m] over some rows.

    `u` and `wide` are the slope of the strip's middle and its width in slopes. Rows are cut at the edges of
    the pattern along q, if there are at most `MAX_EDGES`.
    """
    frame = canvas.frame
    drop = frame.focal * (frame.eye_z - height)
    side = math.copysign(1.0, drop)  # 1 if the face appears below the horizon, -1 above
    low = side * max(MIN_ROW, side * (rows.first - frame.horizon))
    high = side * max(MIN_ROW, side * (rows.last - frame.horizon))
    steps = 2.0 * look.frequency * (u * frame.sin + frame.cos)  # edges of the pattern per depth
    begun = 2.0 * look.frequency * (frame.eye_y - look.speed_q * frame.time)
    one, other = begun + steps * drop / low, begun + steps * drop / high
    first, last = math.ceil(min(one, other)), math.ceil(max(one, other))
    if look.pattern == NOISE or look.pattern == STRIPES or not 0 < last - first <= MAX_EDGES:
        return _level_part(canvas, look, drop, low, high, u, wide)
    total, row = 0.0, low
    for k in range(last - first):
        edge = last - 1 - k if one > other else first + k
        cut = min(max(drop * steps / (edge - begun), min(low, high)), max(low, high))
        total += (cut - row) * _level_part(canvas, look, drop, row, cut, u, wide)
        row = cut
    total += (high - row) * _level_part(canvas, look, drop, row, high, u, wide)
    return total / (high - low)


@kernel
def _level_part(
    canvas: Canvas, look: Record, drop: float, low: float, high: float, u: float, wide: float
) -> float:
    """Average between two rows relative to the horizon, in several parts if they show many periods."""
    frame = canvas.frame
    along_s, along_q = u * frame.cos - frame.sin, u * frame.sin + frame.cos
    long = abs(drop / low - drop / high) * look.frequency
    if look.pattern == NOISE:
        parts = 2 + int(min(14.0, 4.0 * long))
    else:
        parts = 1 + int(min(15.0, 8.0 * abs(along_s) * long))
    part, total, first = (high - low) / parts, 0.0, drop / low
    for j in range(parts):
        last = drop / (low + (j + 1) * part)
        depth, long = 0.5 * (first + last), last - first
        across = depth * wide
        sides = Footprint(across * frame.cos, across * frame.sin, long * along_s, long * along_q)
        s, q = frame.eye_x + depth * along_s, frame.eye_y + depth * along_q
        total += mean_pattern(canvas, look, s, q, sides)
        first = last
    return total / parts


@inlined
def _rows_between(row: int, top: Ends, bottom: Ends) -> Rows:
    """Return the range of rows of the part of a pixel row between the middles of two edges."""
    high, low = 0.5 * (top.left + top.right), 0.5 * (bottom.left + bottom.right)
    start, end = min(max(high, row), low), max(min(low, row + 1.0), high)
    return Rows(start, max(start, end))


@kernel
def texture_level(canvas: Canvas, top: Ends, bottom: Ends, height: float) -> None:
    """Add the pattern of a body's level face at `height` [m] between two edges."""
    frame, strip = canvas.frame, canvas.strip
    wide = strip.gap_slopes.right - strip.gap_slopes.left
    weight = strip.weight * strip.level_light
    for row in range(int(min(top.left, top.right)), int(max(bottom.left, bottom.right)) + 1):
        share = share_below(row, top) - share_below(row, bottom)
        if share > 0.0:
            rows = _rows_between(row, top, bottom)
            mean = _level_row(canvas, frame.body_texture, rows, height, strip.slope, wide)
            canvas.accumulators[Layer.PAINT, row] += weight * share * mean


@kernel
def texture_side(canvas: Canvas, body: Record, top: Ends, bottom: Ends) -> None:
    """Add the pattern of the side of a box or a pole between two edges."""
    frame, strip, look = canvas.frame, canvas.strip, canvas.frame.body_texture
    side = _along_face(frame, body, strip) if body.kind == BOX else _around_pole(frame, body, strip)
    weight, beyond = strip.weight * strip.light, int(max(bottom.left, bottom.right)) + 1
    whole, rest = math.ceil(max(top.left, top.right)), int(min(bottom.left, bottom.right))
    if look.pattern == NOISE or rest <= whole:
        whole = rest = beyond
    for row in range(int(min(top.left, top.right)), beyond):
        share = share_below(row, top) - share_below(row, bottom)
        if share > 0.0 and not whole <= row < rest:
            mean = _upright_row(canvas, look, side, _rows_between(row, top, bottom))
            canvas.accumulators[Layer.PAINT, row] += weight * share * mean
    _add_upright_rows(canvas, look, side, whole, rest, weight)


@kernel
def _upright_row(canvas: Canvas, look: Record, side: Upright, rows: Rows) -> float:
    """Return contrast times the mean of a texture of an upright surface over some rows."""
    frame, scale = canvas.frame, look.frequency
    below = 0.5 * (rows.first + rows.last) - frame.horizon
    tall = (rows.last - rows.first) * side.depth / frame.focal
    lean, q = below * side.lean / frame.focal, side.q - below * side.depth / frame.focal
    if look.pattern == NOISE:
        return mean_pattern(canvas, look, side.s, q, Footprint(side.along, -lean, 0.0, tall))
    mean = look.contrast
    if look.pattern != RINGS:
        mean *= side.swing
    if look.pattern != STRIPES:
        mean *= _wave_between((q - look.speed_q * frame.time) * scale, lean * scale, tall * scale)
    return mean


@kernel
def _add_upright_rows(
    canvas: Canvas, look: Record, side: Upright, first: int, last: int, weight: float
) -> None:
    """Add `weight` times the pattern of an upright surface to rows that show nothing else; not for noise.

    It replaces `_upright_row` for each row by a loop without branches. If the surface leans, the pattern is
    averaged over an interval of the same variance as the parallelogram.
    """
    frame, paint, scale = canvas.frame, canvas.accumulators[Layer.PAINT], look.frequency
    weight *= look.contrast
    if look.pattern != RINGS:
        weight *= side.swing
    if look.pattern == STRIPES:
        for row in range(first, last):
            paint[row] += weight
        return
    middle, per_row = (side.q - look.speed_q * frame.time) * scale, side.depth / frame.focal * scale
    lean = side.lean / frame.focal * scale
    for row in range(first, last):
        below = row + 0.5 - frame.horizon
        wide = max(MIN_WIDTH, math.sqrt(per_row * per_row + lean * lean * below * below))
        start = middle - below * per_row - 0.5 * wide
        end = start + wide
        start, end = start - np.floor(start), end - np.floor(end)
        mean = (min(end, 1.0 - end) - min(start, 1.0 - start)) / wide
        paint[row] += weight * min(1.0, max(-1.0, mean))


@inlined
def _swing(frame: Record, look: Record, s: float, along: float) -> float:
    """Return the mean of the square wave along s over a length around it [m]."""
    return _wave((s - look.speed_s * frame.time) * look.frequency, abs(along) * look.frequency)


@kernel
def _swing_around(frame: Record, body: Record, strip: Record, s: float, along: float) -> float:
    """Average the square wave around a pole, weighted by its light, cut at the edges if they are few."""
    look, left, right = frame.body_texture, strip.gap_slopes.left, strip.gap_slopes.right
    ahead = 2.0 * look.frequency
    begun = (s - 0.5 * along - look.speed_s * frame.time) * ahead
    ended = begun + along * ahead
    # Edges inside, without one at the left end. Around a pole s increases from left to right.
    first, count = math.floor(begun) + 1, max(0, math.ceil(ended) - math.floor(begun) - 1)
    if count > MAX_EDGES or not right > left:
        return _swing(frame, look, s, along)
    sign = 1.0 if math.floor(begun) % 2.0 == 0.0 else -1.0
    start = math.atan2(frame.sin, frame.cos) + body.x / body.turn
    u, total, middle = left, 0.0, strip.slope
    for k in range(count + 1):
        cut = right
        if k < count:
            azimuth = ((first + k) / ahead + look.speed_s * frame.time) / body.turn - start
            beside, forward = body.rx * math.cos(azimuth), body.forward + body.rx * math.sin(azimuth)
            cut = min(max((body.right + beside) / max(MIN_DEPTH, forward), u), right)
        total += sign * (cut - u) * (1.0 + strip.tilt * (0.5 * (u + cut) - middle))
        u, sign = cut, -sign
    return total / (right - left)


@kernel
def texture_cell(canvas: Canvas, u: float) -> None:
    """Add the patterns of ground and walls visible in the cell at slope `u`, except noise on the ground."""
    frame = canvas.frame
    whole = 1.0 / frame.samples
    if frame.ground_texture.contrast > 0.0 and frame.ground_texture.pattern != NOISE:
        _texture_ground(canvas, u, whole)
    if frame.wall_texture.contrast > 0.0:
        _texture_wall(canvas, Layer.RIGHT_WALL, u, whole)
        _texture_wall(canvas, Layer.LEFT_WALL, u, whole)


@kernel
def texture_column(canvas: Canvas, u: float, column: int) -> None:
    """Add noise to the ground visible in a column of pixels around slope `u`."""
    frame = canvas.frame
    if frame.ground_texture.contrast > 0.0 and frame.ground_texture.pattern == NOISE:
        if is_tabulated(canvas.noise, frame):
            mix_ground(canvas.noise, canvas.mixing, column)
        _texture_ground(canvas, u, 1.0)


@kernel
def _texture_ground(canvas: Canvas, u: float, whole: float) -> None:
    """Add the pattern of the ground visible in a width of `whole` pixels around slope `u`."""
    frame, look, paint = canvas.frame, canvas.frame.ground_texture, canvas.accumulators[Layer.PAINT]
    layers = canvas.accumulators[Layer.GROUND : Layer.GROUND + 3]
    mixed = look.pattern == NOISE and is_tabulated(canvas.noise, frame)
    share = across = 0.0
    for row in range(int(frame.horizon), int(2.0 * frame.horizon)):
        share += layers[0, row]
        across += layers[2, row]
        if mixed and share > 1.0 - MIN_SHOWN:
            paint[row] += frame.floor * look.contrast * canvas.mixing.means[row]
        elif share > MIN_SHOWN:
            rows, middle, wide = _part(frame, row, (share, layers[1, row], across), u, whole)
            paint[row] += share * frame.floor * _level_row(canvas, look, rows, 0.0, middle, wide)
    layers[:] = 0.0


@kernel
def _texture_wall(canvas: Canvas, layer: Layer, u: float, whole: float) -> None:
    """Add the pattern of a wall visible in a width of `whole` pixels around slope `u`."""
    frame, look, paint = canvas.frame, canvas.frame.wall_texture, canvas.accumulators[Layer.PAINT]
    layers = canvas.accumulators[layer : layer + 3]
    side = 1.0 if layer == Layer.RIGHT_WALL else -1.0
    base = frame.wall_albedo * (frame.lit_east if side * frame.wall_half < frame.eye_x else frame.lit_west)
    share = across = 0.0
    first = last = -1  # range of rows that show nothing else
    for row in range(int(2.0 * frame.horizon)):
        share += layers[0, row]
        across += layers[2, row]
        if look.pattern != NOISE and share > whole - MIN_SHOWN and (last == row or last < 0):
            first, last = row if last < 0 else first, row + 1
        elif share > MIN_SHOWN:
            rows, middle, wide = _part(frame, row, (share, layers[1, row], across), u, whole)
            mean = _upright_row(canvas, look, _wall(frame, side, middle, wide), rows)
            paint[row] += share * base * mean
    if last > first:
        shown = _wall(frame, side, u, whole / frame.focal)
        _add_upright_rows(canvas, look, shown, first, last, whole * base)
    layers[:] = 0.0


@inlined
def _part(
    frame: Record, row: int, shown: tuple[float, float, float], u: float, whole: float
) -> tuple[Rows, float, float]:
    """Return the visible part of a row as a rectangle of the same area: rows, slope of its middle, width.

    `shown` is the visible share of the row and its first moments down and across.
    """
    share, down, across = shown
    down /= share
    tall = 1.0 - 2.0 * abs(down)
    low = row + 0.5 + down - 0.5 * tall
    # If nothing hides a part of the row, take all of it, because the sums have rounding errors.
    part, wide = min(1.0, share / max(whole * tall, MIN_SHOWN)), whole / frame.focal
    if part > 1.0 - MIN_SHOWN:
        return Rows(low, low + tall), u, wide
    return Rows(low, low + tall), min(max(across / share, u - 0.5 * wide), u + 0.5 * wide), part * wide


@inlined
def _wall(frame: Record, side: float, u: float, wide: float) -> Upright:
    """Return the part of the wall at x = side * half width that is visible in slopes `wide` around `u`."""
    away = side * frame.wall_half - frame.eye_x
    left, right = u - 0.5 * wide, u + 0.5 * wide
    one = away / (left * frame.cos - frame.sin)
    other = away / (right * frame.cos - frame.sin)
    # A cell may reach past the slope that is parallel to the wall.
    one, other = min(abs(one), 1e9), min(abs(other), 1e9)
    lean = other - one
    one, other = one * (left * frame.sin + frame.cos), other * (right * frame.sin + frame.cos)
    depth, s = away / (u * frame.cos - frame.sin), frame.eye_y + 0.5 * (one + other)
    swing = _swing(frame, frame.wall_texture, s, other - one)
    return Upright(s, other - one, swing, frame.eye_z, depth, lean)


@kernel
def _along_face(frame: Record, body: Record, strip: Record) -> Upright:
    """Return the part of a box's face visible in the gap; s is y if the face's normal is along x, else x."""
    cos, sin, left, right = frame.cos, frame.sin, strip.gap_slopes.left, strip.gap_slopes.right
    along_x, along_y = strip.slope * cos - sin, strip.slope * sin + cos
    near_x, near_y, _ = box_slab(body, along_x, along_y)
    if near_x > near_y:
        away = body.dx - math.copysign(body.rx, along_x)
        one = away / (left * cos - sin) * (left * sin + cos)
        other = away / (right * cos - sin) * (right * sin + cos)
        start = frame.eye_y
    else:
        away = body.dy - math.copysign(body.ry, along_y)
        one = away / (left * sin + cos) * (left * cos - sin)
        other = away / (right * sin + cos) * (right * cos - sin)
        start = frame.eye_x
    s = start + 0.5 * (one + other)
    swing = _swing(frame, frame.body_texture, s, other - one)
    return Upright(s, other - one, swing, frame.eye_z, strip.entry, 0.0)


@kernel
def _around_pole(frame: Record, body: Record, strip: Record) -> Upright:
    """Return the part of a pole's side visible in the gap."""
    left, right = strip.gap_slopes.left, strip.gap_slopes.right
    near, _ = depths(body, frame, left)
    middle, _ = depths(body, frame, strip.slope)
    far, _ = depths(body, frame, right)
    depth = max(MIN_DEPTH, (near + 4.0 * middle + far) / 6.0)
    s = along = swing = 0.0
    if frame.body_texture.pattern != RINGS:
        one = math.atan2(near - body.forward, near * left - body.right)
        other = math.atan2(far - body.forward, far * right - body.right)
        turn = other - one
        turn -= 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
        along = body.turn * turn
        s = body.x + body.turn * (one + math.atan2(frame.sin, frame.cos)) + 0.5 * along
        swing = _swing_around(frame, body, strip, s, along)
    return Upright(s, along, swing, body.y + frame.eye_z, depth, far - near)
