"""Kernels that average patterns over what a row of a strip shows of a surface.

Checker, stripes and rings are averaged exactly where the footprint is a rectangle along
their axes; noise is looked up in a stack of filtered tiles. Input is assumed valid.
"""

import math
from typing import NamedTuple

import numpy as np

from envs.compiled import inlined, kernel
from envs.raycast.bodies import box_slab, depths
from envs.raycast.coverage import Layer, share_below
from envs.raycast.records import Canvas, Ends, Record
from envs.scene import BOX, CONE
from envs.scene.textures import LEVELS, NOISE, RINGS, STACK_TEXELS, STRIPES

TEXELS = STACK_TEXELS * STACK_TEXELS
MIN_WIDTH = 1e-6  # [periods] a footprint below this is a point
MIN_ROW = 1e-6  # [pixels] distance from the horizon up to which rows are told apart
MAX_LOOKUPS = 8  # of noise along the longer axis of a footprint, per sample
MIN_BLEND = 0.05  # weight below which a coarser level of noise is left out
MIN_SHOWN = 1e-9  # [pixels] weight below which a surface is not textured


class Footprint(NamedTuple):
    """The parallelogram of a surface that is averaged, by its two sides along s and q [m]."""

    one_s: float
    one_q: float
    other_s: float
    other_q: float


class Rows(NamedTuple):
    """From where to where a pattern is averaged, in rows of the image."""

    first: float
    last: float


class Quadric(NamedTuple):
    """What `meet` needs of a cone or an ellipsoid and of a slope.

    The surface is right^2 + forward^2 + ratio * up^2 = size around its middle, or its apex. The
    ray of `fall` per depth is there at the roots of
    (square + ratio * fall^2) * depth^2 - 2 * (middle + ratio * over * fall) * depth + rest.
    """

    square: float
    middle: float
    rest: float
    ratio: float
    over: float
    size: float


class Place(NamedTuple):
    """Right and forward of a curved body's axis, and above its middle or apex [m]."""

    right: float
    forward: float
    up: float


@kernel
def _wave(middle: float, wide: float) -> float:
    """Mean of a square wave of period 1, +1 first, over an interval [periods]; exact."""
    if wide < MIN_WIDTH:
        return 1.0 if middle - np.floor(middle) < 0.5 else -1.0
    start, end = middle - 0.5 * wide, middle + 0.5 * wide
    start, end = start - np.floor(start), end - np.floor(end)
    return min(1.0, max(-1.0, (min(end, 1.0 - end) - min(start, 1.0 - start)) / wide))


@inlined
def _look_up(stacks: np.ndarray, level: int, blend: float, s: float, q: float) -> float:
    """Periodic bilinear interpolation at (s, q) [tiles] in a level, and between it and the next one."""
    x, y = (s - np.floor(s)) * STACK_TEXELS, (q - np.floor(q)) * STACK_TEXELS
    i, j = int(x), int(y)
    x, y = x - i, y - j
    i, j = i & (STACK_TEXELS - 1), (j & (STACK_TEXELS - 1)) * STACK_TEXELS
    right, below = (i + 1) & (STACK_TEXELS - 1), (j + STACK_TEXELS) & (TEXELS - 1)
    here = level * TEXELS
    upper = stacks[here + j + i] * (1.0 - x) + stacks[here + j + right] * x
    lower = stacks[here + below + i] * (1.0 - x) + stacks[here + below + right] * x
    value = upper + y * (lower - upper)
    if blend > MIN_BLEND:
        here += TEXELS
        upper = stacks[here + j + i] * (1.0 - x) + stacks[here + j + right] * x
        lower = stacks[here + below + i] * (1.0 - x) + stacks[here + below + right] * x
        value += blend * (upper + y * (lower - upper) - value)
    return value


@kernel
def _noise(stacks: np.ndarray, stack: int, s: float, q: float, sides: Footprint, max_lookups: int) -> float:
    """Mean of noise over a parallelogram [tiles]: lookups along its longer side, each a filtered square."""
    along_s, along_q = sides.other_s, sides.other_q
    short = sides.one_s * sides.one_s + sides.one_q * sides.one_q
    long = along_s * along_s + along_q * along_q
    if short > long:
        short, long, along_s, along_q = long, short, sides.one_s, sides.one_q
    short, long = math.sqrt(short), math.sqrt(long)
    # A sixteenth of a tile is a quarter of the shortest period, which one lookup resolves.
    count = min(max_lookups, 1 + int(long / max(short, 0.0625)))
    level = min(LEVELS - 1.0, max(short, long / count) * 2.0 * (LEVELS - 1))
    low = min(int(level), LEVELS - 2)
    # Filtering weakens a wave by the square of its width, to first order.
    blend = (level * level - low * low) / (2.0 * low + 1.0)
    total = 0.0
    for j in range(count):
        along = (j + 0.5) / count - 0.5
        total += _look_up(stacks, stack * LEVELS + low, blend, s + along * along_s, q + along * along_q)
    return total / count


@inlined
def _scaled(sides: Footprint, scale: float) -> Footprint:
    """A footprint in another unit."""
    return Footprint(sides.one_s * scale, sides.one_q * scale, sides.other_s * scale, sides.other_q * scale)


@kernel
def _pattern(
    frame: Record, stacks: np.ndarray, look: Record, s: float, q: float, sides: Footprint, max_lookups: int
) -> float:
    """Contrast times the mean of a texture over the parallelogram around (s, q) [m].

    Exact for checker, stripes and rings if the footprint is a rectangle along s and q; else
    each coordinate is averaged on its own, over a width of the same variance.
    """
    scale = look.frequency
    s = (s - look.speed_s * frame.time) * scale
    q = (q - look.speed_q * frame.time) * scale
    sides = _scaled(sides, scale)
    mean = look.contrast
    if look.pattern == NOISE:
        return mean * _noise(stacks, look.stack, 0.25 * s, 0.25 * q, _scaled(sides, 0.25), max_lookups)
    if look.pattern != RINGS:
        mean *= _wave(s, math.sqrt(sides.one_s * sides.one_s + sides.other_s * sides.other_s))
    if look.pattern != STRIPES:
        mean *= _wave(q, math.sqrt(sides.one_q * sides.one_q + sides.other_q * sides.other_q))
    return mean


@kernel
def _level_row(
    frame: Record, stacks: np.ndarray, look: Record, rows: Rows, height: float, u: float, wide: float
) -> float:
    """Contrast times the mean of a texture of a level face at `height` [m] over some rows.

    `u` and `wide` are the slope of the strip's middle and its width in slopes. The footprint
    is cut into parts of equal rows where it is long and neither along s nor along q.
    """
    drop = frame.focal * (frame.eye_z - height)
    along_s, along_q = u * frame.cos - frame.sin, u * frame.sin + frame.cos
    low, high = rows.first - frame.horizon, rows.last - frame.horizon
    if abs(low) < MIN_ROW:
        low = math.copysign(MIN_ROW, drop)
    if abs(high) < MIN_ROW:
        high = math.copysign(MIN_ROW, drop)
    long = abs(drop / low - drop / high) * look.frequency
    if look.pattern == NOISE:
        parts = 1 + int(min(3.0, 0.25 * long))
        max_lookups = max(1, int(MAX_LOOKUPS * frame.samples) // parts)
    else:
        slant = min(abs(along_s), abs(along_q))
        max_lookups, parts = 1, 1 + int(min(8.0 * frame.samples - 1.0, 4.0 * frame.samples * slant * long))
    part, total, first = (high - low) / parts, 0.0, drop / low
    for j in range(parts):
        last = drop / (low + (j + 1) * part)
        depth, long = 0.5 * (first + last), last - first
        across = depth * wide
        sides = Footprint(across * frame.cos, across * frame.sin, long * along_s, long * along_q)
        s, q = frame.eye_x + depth * along_s, frame.eye_y + depth * along_q
        total += _pattern(frame, stacks, look, s, q, sides, max_lookups)
        first = last
    return total / parts


@inlined
def _rows_between(row: int, top: Ends, bottom: Ends) -> Rows:
    """First and last row of the part of a pixel that lies between the middles of two edges."""
    high, low = 0.5 * (top.left + top.right), 0.5 * (bottom.left + bottom.right)
    return Rows(min(max(high, row), low), max(min(low, row + 1.0), high))


@kernel
def texture_level(canvas: Canvas, top: Ends, bottom: Ends, height: float) -> None:
    """Add the pattern of a body's level face at `height` [m] between two edges."""
    frame, strip = canvas.frame, canvas.strip
    wide = strip.gap_slopes.right - strip.gap_slopes.left
    weight = strip.weight * strip.level_light
    for row in range(int(min(top.left, top.right)), int(max(bottom.left, bottom.right)) + 1):
        share = share_below(row, top) - share_below(row, bottom)
        if share > 0.0:
            start, end = _rows_between(row, top, bottom)
            rows = Rows(start, max(start, end))
            mean = _level_row(frame, canvas.stacks, frame.body_texture, rows, height, strip.slope, wide)
            canvas.accumulators[Layer.PAINT, row] += weight * share * mean


@kernel
def texture_side(canvas: Canvas, body: Record, top: Ends, bottom: Ends) -> None:
    """Add the pattern of the side of a box or a pole between two edges."""
    frame, strip = canvas.frame, canvas.strip
    if body.kind == BOX:
        left, right = _along_face(frame, body, strip)
        foot = 0.0
    else:
        left, right = _around_pole(frame, body, strip)
        foot = body.y
    tall, weight = strip.entry / frame.focal, strip.weight * strip.light
    middle, max_lookups = 0.5 * (left + right), int(MAX_LOOKUPS * frame.samples)
    for row in range(int(min(top.left, top.right)), int(max(bottom.left, bottom.right)) + 1):
        share = share_below(row, top) - share_below(row, bottom)
        if share > 0.0:
            start, end = _rows_between(row, top, bottom)
            q = foot + frame.eye_z - (0.5 * (start + end) - frame.horizon) * tall
            sides = Footprint(right - left, 0.0, 0.0, max(0.0, end - start) * tall)
            mean = _pattern(frame, canvas.stacks, frame.body_texture, middle, q, sides, max_lookups)
            canvas.accumulators[Layer.PAINT, row] += weight * share * mean


@kernel
def texture_cell(canvas: Canvas, u: float) -> None:
    """Add the patterns of ground and walls to what the cell of slope `u` shows of them."""
    if canvas.frame.ground_texture.contrast > 0.0:
        _texture_layer(canvas, Layer.GROUND, u)
    if canvas.frame.wall_texture.contrast > 0.0:
        _texture_layer(canvas, Layer.RIGHT_WALL, u)
        _texture_layer(canvas, Layer.LEFT_WALL, u)


@kernel
def _texture_layer(canvas: Canvas, layer: Layer, u: float) -> None:
    """Add the pattern of the ground or a wall where the cell of slope `u` shows it; forget what it shows.

    What shows of a row is taken as a rectangle of its area around its middle.
    """
    frame, stacks = canvas.frame, canvas.stacks
    layers, paint = canvas.accumulators[layer : layer + 3], canvas.accumulators[Layer.PAINT]
    shown, across, whole = 0.0, 0.0, 1.0 / (frame.samples * frame.focal)
    ground = layer == Layer.GROUND
    side = 1.0 if layer == Layer.RIGHT_WALL else -1.0
    facing = frame.lit_east if side * frame.wall_half < frame.eye_x else frame.lit_west
    base = frame.floor if ground else frame.wall_albedo * facing
    for row in range(int(frame.horizon) if ground else 0, int(2.0 * frame.horizon)):
        shown += layers[0, row]
        across += layers[2, row]
        if shown > MIN_SHOWN:
            down = layers[1, row] / shown
            tall = 1.0 - 2.0 * abs(down)
            low = row + 0.5 + down - 0.5 * tall
            # Where nothing hides a part of the row, the cell itself: sums have rounding errors.
            part = min(1.0, shown * frame.samples / max(tall, MIN_SHOWN))
            middle = (
                u if part > 1.0 - MIN_SHOWN else min(max(across / shown, u - 0.5 * whole), u + 0.5 * whole)
            )
            rows = Rows(low, low + tall)
            if ground:
                mean = _level_row(frame, stacks, frame.ground_texture, rows, 0.0, middle, part * whole)
            else:
                mean = _wall_row(frame, stacks, rows, side, middle, part * whole)
            paint[row] += shown * base * mean
    layers[:] = 0.0


@kernel
def _wall_row(frame: Record, stacks: np.ndarray, rows: Rows, side: float, u: float, wide: float) -> float:
    """Contrast times the mean of the wall at x = side * half width over some rows."""
    away = side * frame.wall_half - frame.eye_x
    left, right = u - 0.5 * wide, u + 0.5 * wide
    one = away / (left * frame.cos - frame.sin)
    other = away / (right * frame.cos - frame.sin)
    # A cell may reach past the slope that is parallel to the wall.
    one, other = min(abs(one), 1e9), min(abs(other), 1e9)
    one, other = one * (left * frame.sin + frame.cos), other * (right * frame.sin + frame.cos)
    tall = away / (u * frame.cos - frame.sin) / frame.focal
    q = frame.eye_z - (0.5 * (rows.first + rows.last) - frame.horizon) * tall
    sides = Footprint(other - one, 0.0, 0.0, (rows.last - rows.first) * tall)
    s = frame.eye_y + 0.5 * (one + other)
    return _pattern(frame, stacks, frame.wall_texture, s, q, sides, int(MAX_LOOKUPS * frame.samples))


@kernel
def _along_face(frame: Record, body: Record, strip: Record) -> Ends:
    """World y (x) where both ends of the gap meet the face of a box that looks along x (y) [m]."""
    cos, sin, left, right = frame.cos, frame.sin, strip.gap_slopes.left, strip.gap_slopes.right
    along_x, along_y = strip.slope * cos - sin, strip.slope * sin + cos
    near_x, near_y, _ = box_slab(body, along_x, along_y)
    if near_x > near_y:
        away = body.dx - math.copysign(body.rx, along_x)
        one = away / (left * cos - sin) * (left * sin + cos)
        other = away / (right * cos - sin) * (right * sin + cos)
        return Ends(frame.eye_y + one, frame.eye_y + other)
    away = body.dy - math.copysign(body.ry, along_y)
    one = away / (left * sin + cos) * (left * cos - sin)
    other = away / (right * sin + cos) * (right * cos - sin)
    return Ends(frame.eye_x + one, frame.eye_x + other)


@kernel
def _around_pole(frame: Record, body: Record, strip: Record) -> Ends:
    """Surface coordinate s [m] where both ends of the gap meet a pole."""
    one, other = _azimuth(frame, body, strip.gap_slopes.left), _azimuth(frame, body, strip.gap_slopes.right)
    turn = other - one
    turn -= 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
    start = body.x + body.turn * (one + math.atan2(frame.sin, frame.cos))
    return Ends(start, start + body.turn * turn)


@inlined
def _azimuth(frame: Record, body: Record, u: float) -> float:
    """Direction from a pole's axis to where slope `u` enters it, in the camera's frame [rad]."""
    entry, _ = depths(body, frame, u)
    return math.atan2(entry - body.forward, entry * u - body.right)


@inlined
def quadric(body: Record, frame: Record, u: float) -> Quadric:
    """A cone's side or an ellipsoid, as slope `u` sees it."""
    half, radius = 0.5 * (body.top - body.bottom), body.rx
    ratio, over, size = (radius / half) ** 2, frame.eye_z - body.bottom - half, radius * radius
    if body.kind == CONE:
        ratio, over, size = -0.25 * ratio, frame.eye_z - body.top, 0.0
    away = body.right * body.right + body.forward * body.forward
    middle, rest = body.right * u + body.forward, away + ratio * over * over - size
    return Quadric(1.0 + u * u, middle, rest, ratio, over, size)


@inlined
def meet(shape: Quadric, fall: float, nearest: float, farthest: float) -> tuple[float, float]:
    """Depth, within limits, at which the ray of `fall` per depth meets a quadric, and its up there."""
    a, b = shape.square + shape.ratio * fall * fall, shape.middle + shape.ratio * shape.over * fall
    root = math.sqrt(max(0.0, b * b - a * shape.rest))
    # Seen from inside the cone's continuation above its apex, the second crossing is the side.
    depth = shape.rest / (b + root) if shape.rest > 0.0 else (b - root) / (a if a != 0.0 else -1e-300)
    depth = min(max(depth, nearest), farthest)
    return depth, shape.over - fall * depth


@inlined
def _place(body: Record, strip: Record, u: float, fall: float, shape: Quadric) -> Place:
    """Where a ray meets a curved body."""
    depth, up = meet(shape, fall, strip.entry, strip.leave)
    return Place(depth * u - body.right, depth - body.forward, up)


@inlined
def _turn_between(one: Place, other: Place) -> float:
    """Azimuth from one place around the axis to another, by the shorter way; to 1e-10."""
    sine = one.right * other.forward - one.forward * other.right
    cosine = one.right * other.right + one.forward * other.forward
    if abs(sine) > 0.1 * cosine:
        return math.atan2(sine, cosine)
    x = sine / max(cosine, 1e-300)
    return x * (1.0 - x * x * (1.0 / 3.0 - x * x * (0.2 - x * x / 7.0)))


@kernel
def curved_pattern(
    canvas: Canvas, body: Record, shapes: tuple[Quadric, Quadric, Quadric], rows: Rows
) -> float:
    """Contrast times the pattern's mean over some rows of a cone's side or an ellipsoid.

    `shapes` are `quadric` at the left end of the gap, at its right end and in its middle.
    """
    frame, strip, slopes = canvas.frame, canvas.strip, canvas.strip.gap_slopes
    fall = (0.5 * (rows.first + rows.last) - frame.horizon) / frame.focal
    tall = 0.5 * (rows.last - rows.first) / frame.focal
    left = _place(body, strip, slopes.left, fall, shapes[0])
    right = _place(body, strip, slopes.right, fall, shapes[1])
    upper = _place(body, strip, strip.slope, fall - tall, shapes[2])
    lower = _place(body, strip, strip.slope, fall + tall, shapes[2])
    across, down = _turn_between(left, right), _turn_between(upper, lower)
    azimuth = math.atan2(left.forward, left.right) + math.atan2(frame.sin, frame.cos) + 0.5 * across
    s = body.x + body.turn * azimuth
    q = body.y + frame.eye_z - shapes[2].over + 0.5 * (upper.up + lower.up)
    sides = Footprint(body.turn * across, right.up - left.up, body.turn * down, lower.up - upper.up)
    return _pattern(frame, canvas.stacks, frame.body_texture, s, q, sides, int(MAX_LOOKUPS * frame.samples))
