"""Kernels that average patterns over what a row of a strip shows of a surface.

Checker, stripes and rings are averaged exactly where the footprint is a rectangle along
their axes; noise is looked up in a stack of filtered tiles. Input is assumed valid.
"""

import math

import numpy as np

from envs.raycast import bodies as b
from envs.raycast.coverage import (
    BODY,
    CONTRAST,
    COS,
    EYE_X,
    EYE_Y,
    EYE_Z,
    FLOOR,
    FOCAL,
    FREQUENCY,
    GROUND,
    GROUND_SHOWN,
    HORIZON,
    LEFT_SHOWN,
    LIT_EAST,
    LIT_WEST,
    PAINT,
    PATTERN,
    RIGHT_SHOWN,
    SAMPLES,
    SIN,
    SPEED_Q,
    SPEED_S,
    STACK,
    TIME,
    WALL,
    WALL_ALBEDO,
    WALL_HALF,
    inlined,
    kernel,
    share_below,
)
from envs.scene import CONE
from envs.scene.textures import LEVELS, NOISE, RINGS, STACK_TEXELS, STRIPES

TEXELS = STACK_TEXELS * STACK_TEXELS
NARROW = 1e-6  # [periods] a footprint below this is a point
FINEST = 1e-6  # [pixels] distance from the horizon up to which rows are told apart
LOOKUPS = 8  # most lookups of noise along the longer axis of a footprint, per sample
FAINT = 0.05  # weight below which a coarser level of noise is left out
UNSEEN = 1e-9  # [pixels] weight below which a surface is not textured


@kernel
def _wave(middle: float, wide: float) -> float:
    """Mean of a square wave of period 1, +1 first, over an interval [periods]; exact."""
    if wide < NARROW:
        return 1.0 if middle - np.floor(middle) < 0.5 else -1.0
    a, b = middle - 0.5 * wide, middle + 0.5 * wide
    a, b = a - np.floor(a), b - np.floor(b)
    return min(1.0, max(-1.0, (min(b, 1.0 - b) - min(a, 1.0 - a)) / wide))


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
    if blend > FAINT:
        here += TEXELS
        upper = stacks[here + j + i] * (1.0 - x) + stacks[here + j + right] * x
        lower = stacks[here + below + i] * (1.0 - x) + stacks[here + below + right] * x
        value += blend * (upper + y * (lower - upper) - value)
    return value


@kernel
def _noise(stacks: np.ndarray, k: int, s: float, q: float, axes: tuple, most: int) -> float:
    """Mean of noise over a parallelogram [tiles]: lookups along its longer axis, each a filtered square."""
    es, eq, fs, fq = axes
    short, long = es * es + eq * eq, fs * fs + fq * fq
    if short > long:
        short, long, fs, fq = long, short, es, eq
    short, long = math.sqrt(short), math.sqrt(long)
    # A sixteenth of a tile is a quarter of the shortest period, which one lookup resolves.
    count = min(most, 1 + int(long / max(short, 0.0625)))
    level = min(LEVELS - 1.0, max(short, long / count) * 2.0 * (LEVELS - 1))
    low = min(int(level), LEVELS - 2)
    # Filtering weakens a wave by the square of its width, to first order.
    blend = (level * level - low * low) / (2.0 * low + 1.0)
    total = 0.0
    for j in range(count):
        along = (j + 0.5) / count - 0.5
        total += _look_up(stacks, k * LEVELS + low, blend, s + along * fs, q + along * fq)
    return total / count


@kernel
def pattern(view, stacks, k: int, s: float, q: float, axes: tuple, most: int) -> float:
    """Contrast times the mean of texture `k` over the parallelogram of `axes` around (s, q) [m].

    Exact for checker, stripes and rings if the footprint is a rectangle along s and q; else
    each coordinate is averaged on its own, over a width of the same variance. Noise takes at
    most `most` lookups.
    """
    scale = view[k + FREQUENCY]
    s = (s - view[k + SPEED_S] * view[TIME]) * scale
    q = (q - view[k + SPEED_Q] * view[TIME]) * scale
    es, eq, fs, fq = axes[0] * scale, axes[1] * scale, axes[2] * scale, axes[3] * scale
    kind, mean = int(view[k + PATTERN]), view[k + CONTRAST]
    if kind == NOISE:
        tiles = (0.25 * es, 0.25 * eq, 0.25 * fs, 0.25 * fq)
        return mean * _noise(stacks, int(view[k + STACK]), 0.25 * s, 0.25 * q, tiles, most)
    if kind != RINGS:
        mean *= _wave(s, math.sqrt(es * es + fs * fs))
    if kind != STRIPES:
        mean *= _wave(q, math.sqrt(eq * eq + fq * fq))
    return mean


@kernel
def level_row(view, stacks, k: int, low: float, high: float, height: float, u: float, wide: float):
    """Contrast times the mean of texture `k` of a level face at `height` [m] over rows low .. high.

    `u` and `wide` are the slope of the strip's middle and its width in slopes. The footprint
    is cut into parts of equal rows where it is long and neither along s nor along q.
    """
    drop = view[FOCAL] * (view[EYE_Z] - height)
    along_s, along_q = u * view[COS] - view[SIN], u * view[SIN] + view[COS]
    low, high = low - view[HORIZON], high - view[HORIZON]
    if abs(low) < FINEST:
        low = math.copysign(FINEST, drop)
    if abs(high) < FINEST:
        high = math.copysign(FINEST, drop)
    long = abs(drop / low - drop / high) * view[k + FREQUENCY]
    if view[k + PATTERN] == NOISE:
        parts = 1 + int(min(3.0, 0.25 * long))
        most = max(1, int(LOOKUPS * view[SAMPLES]) // parts)
    else:
        slant = min(abs(along_s), abs(along_q))
        most, parts = 1, 1 + int(min(8.0 * view[SAMPLES] - 1.0, 4.0 * view[SAMPLES] * slant * long))
    part, total, first = (high - low) / parts, 0.0, drop / low
    for j in range(parts):
        last = drop / (low + (j + 1) * part)
        depth, long = 0.5 * (first + last), last - first
        across = depth * wide
        axes = (across * view[COS], across * view[SIN], long * along_s, long * along_q)
        s, q = view[EYE_X] + depth * along_s, view[EYE_Y] + depth * along_q
        total += pattern(view, stacks, k, s, q, axes, most)
        first = last
    return total / parts


@kernel
def texture_level(view, stacks, sheet, top: tuple, bottom: tuple, height: float, ray: tuple) -> None:
    """Add the pattern of a body's level face at `height` [m] between two edges.

    `ray` is slope, width of the strip in slopes, weighted luminance.
    """
    u, wide, weight = ray
    high, low = 0.5 * (top[0] + top[1]), 0.5 * (bottom[0] + bottom[1])
    for row in range(int(min(top[0], top[1])), int(max(bottom[0], bottom[1])) + 1):
        share = share_below(row, top[0], top[1]) - share_below(row, bottom[0], bottom[1])
        if share > 0.0:
            start, end = min(max(high, row), low), max(min(low, row + 1.0), high)
            mean = level_row(view, stacks, BODY, start, max(start, end), height, u, wide)
            sheet[PAINT, row] += weight * share * mean


@kernel
def texture_side(view, stacks, sheet, top: tuple, bottom: tuple, side: tuple) -> None:
    """Add the pattern of a body's upright face between two edges.

    `side` is s at both ends of the strip [m], depth [m], q at height 0 [m], weighted luminance.
    """
    s_left, s_right, depth, foot, weight = side
    tall = depth / view[FOCAL]
    middle, most = 0.5 * (s_left + s_right), int(LOOKUPS * view[SAMPLES])
    high, low = 0.5 * (top[0] + top[1]), 0.5 * (bottom[0] + bottom[1])
    for row in range(int(min(top[0], top[1])), int(max(bottom[0], bottom[1])) + 1):
        share = share_below(row, top[0], top[1]) - share_below(row, bottom[0], bottom[1])
        if share > 0.0:
            start, end = min(max(high, row), low), max(min(low, row + 1.0), high)
            q = foot + view[EYE_Z] - (0.5 * (start + end) - view[HORIZON]) * tall
            axes = (s_right - s_left, 0.0, 0.0, max(0.0, end - start) * tall)
            sheet[PAINT, row] += weight * share * pattern(view, stacks, BODY, middle, q, axes, most)


@kernel
def texture_cell(view, stacks, sheet, u: float) -> None:
    """Add the patterns of ground and walls to what the cell of slope `u` shows of them."""
    if view[GROUND + CONTRAST] > 0.0:
        _texture_layer(view, stacks, sheet, GROUND_SHOWN, u)
    if view[WALL + CONTRAST] > 0.0:
        _texture_layer(view, stacks, sheet, RIGHT_SHOWN, u)
        _texture_layer(view, stacks, sheet, LEFT_SHOWN, u)


@kernel
def _texture_layer(view, stacks, sheet, layer: int, u: float) -> None:
    """Add the pattern of the ground or a wall where the cell of slope `u` shows it; forget what it shows.

    What shows of a row is taken as a rectangle of its area around its middle.
    """
    shown, across, whole = 0.0, 0.0, 1.0 / (view[SAMPLES] * view[FOCAL])
    ground = layer == GROUND_SHOWN
    side = 1.0 if layer == RIGHT_SHOWN else -1.0
    facing = view[LIT_EAST] if side * view[WALL_HALF] < view[EYE_X] else view[LIT_WEST]
    base = view[FLOOR] if ground else view[WALL_ALBEDO] * facing
    for row in range(int(view[HORIZON]) if ground else 0, int(2.0 * view[HORIZON])):
        shown += sheet[layer, row]
        across += sheet[layer + 2, row]
        if shown > UNSEEN:
            down = sheet[layer + 1, row] / shown
            tall = 1.0 - 2.0 * abs(down)
            low = row + 0.5 + down - 0.5 * tall
            # Where nothing hides a part of the row, the cell itself: sums have rounding errors.
            part = min(1.0, shown * view[SAMPLES] / max(tall, UNSEEN))
            middle = u if part > 1.0 - UNSEEN else min(max(across / shown, u - 0.5 * whole), u + 0.5 * whole)
            wide = part * whole
            if ground:
                mean = level_row(view, stacks, GROUND, low, low + tall, 0.0, middle, wide)
            else:
                mean = wall_row(view, stacks, low, low + tall, side, middle, wide)
            sheet[PAINT, row] += shown * base * mean
    sheet[layer : layer + 3] = 0.0


@kernel
def wall_row(view, stacks, low: float, high: float, side: float, u: float, wide: float) -> float:
    """Contrast times the mean of the wall at x = side * half width over rows low .. high."""
    away = side * view[WALL_HALF] - view[EYE_X]
    left, right = u - 0.5 * wide, u + 0.5 * wide
    one = away / (left * view[COS] - view[SIN])
    other = away / (right * view[COS] - view[SIN])
    # A cell may reach past the slope that is parallel to the wall.
    one, other = min(abs(one), 1e9), min(abs(other), 1e9)
    one, other = one * (left * view[SIN] + view[COS]), other * (right * view[SIN] + view[COS])
    tall = away / (u * view[COS] - view[SIN]) / view[FOCAL]
    q = view[EYE_Z] - (0.5 * (low + high) - view[HORIZON]) * tall
    axes = (other - one, 0.0, 0.0, (high - low) * tall)
    s = view[EYE_Y] + 0.5 * (one + other)
    return pattern(view, stacks, WALL, s, q, axes, int(LOOKUPS * view[SAMPLES]))


@kernel
def along_face(view: np.ndarray, seen: np.ndarray, i: int, hit: np.ndarray) -> tuple[float, float]:
    """World y (x) where both ends of the strip meet the face of a box that looks along x (y) [m]."""
    cos, sin = view[COS], view[SIN]
    along_x, along_y = hit[b.SLOPE] * cos - sin, hit[b.SLOPE] * sin + cos
    near_x, near_y, _ = b.box_slab(seen, i, along_x, along_y)
    if near_x > near_y:
        away = seen[i, b.DX] - math.copysign(seen[i, b.RX], along_x)
        one = away / (hit[b.LEFT_END] * cos - sin) * (hit[b.LEFT_END] * sin + cos)
        other = away / (hit[b.RIGHT_END] * cos - sin) * (hit[b.RIGHT_END] * sin + cos)
        return view[EYE_Y] + one, view[EYE_Y] + other
    away = seen[i, b.DY] - math.copysign(seen[i, b.RY], along_y)
    one = away / (hit[b.LEFT_END] * sin + cos) * (hit[b.LEFT_END] * cos - sin)
    other = away / (hit[b.RIGHT_END] * sin + cos) * (hit[b.RIGHT_END] * cos - sin)
    return view[EYE_X] + one, view[EYE_X] + other


@kernel
def around_pole(view: np.ndarray, seen: np.ndarray, i: int, hit: np.ndarray) -> tuple[float, float]:
    """Surface coordinate s [m] where both ends of the strip meet a pole."""
    entry, _ = b.depths(seen, i, view, hit[b.LEFT_END])
    one = math.atan2(entry - seen[i, b.FORWARD], entry * hit[b.LEFT_END] - seen[i, b.RIGHT])
    entry, _ = b.depths(seen, i, view, hit[b.RIGHT_END])
    other = math.atan2(entry - seen[i, b.FORWARD], entry * hit[b.RIGHT_END] - seen[i, b.RIGHT])
    turn = other - one
    turn -= 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
    start = seen[i, b.X] + seen[i, b.TURN] * (one + math.atan2(view[SIN], view[COS]))
    return start, start + seen[i, b.TURN] * turn


@inlined
def quadric(seen: np.ndarray, i: int, view: np.ndarray, u: float) -> tuple:
    """What `meet` needs of a cone or an ellipsoid and of slope `u`.

    The surface is right^2 + forward^2 + ratio * up^2 = size around its middle, or its apex.
    """
    half, radius, z = 0.5 * (seen[i, b.TOP] - seen[i, b.BOTTOM]), seen[i, b.RX], view[EYE_Z]
    ratio, over, size = (radius / half) ** 2, z - seen[i, b.BOTTOM] - half, radius * radius
    if seen[i, b.KIND] == CONE:
        ratio, over, size = -0.25 * ratio, z - seen[i, b.TOP], 0.0
    away = seen[i, b.RIGHT] * seen[i, b.RIGHT] + seen[i, b.FORWARD] * seen[i, b.FORWARD]
    middle, rest = seen[i, b.RIGHT] * u + seen[i, b.FORWARD], away + ratio * over * over - size
    return 1.0 + u * u, middle, rest, ratio, over, size


@inlined
def meet(shape: tuple, fall: float, span: tuple) -> tuple[float, float]:
    """Depth within a span at which the ray of `fall` per depth meets a quadric, and its up there."""
    square, middle, rest, ratio, over, _ = shape
    a, b = square + ratio * fall * fall, middle + ratio * over * fall
    root = math.sqrt(max(0.0, b * b - a * rest))
    # Seen from inside the cone's continuation above its apex, the second crossing is the side.
    depth = rest / (b + root) if rest > 0.0 else (b - root) / (a if a != 0.0 else -1e-300)
    depth = min(max(depth, span[0]), span[1])
    return depth, over - fall * depth


@inlined
def _place(seen, i: int, u: float, fall: float, shape: tuple, span: tuple) -> tuple[float, float, float]:
    """Right and forward of a curved body's axis, and above its middle or apex, where a ray meets it [m]."""
    depth, up = meet(shape, fall, span)
    return depth * u - seen[i, b.RIGHT], depth - seen[i, b.FORWARD], up


@inlined
def _between(one: tuple, other: tuple) -> float:
    """Azimuth from one place around the axis to another, by the shorter way; to 1e-10."""
    sine, cosine = one[0] * other[1] - one[1] * other[0], one[0] * other[0] + one[1] * other[1]
    if abs(sine) > 0.1 * cosine:
        return math.atan2(sine, cosine)
    x = sine / max(cosine, 1e-300)
    return x * (1.0 - x * x * (1.0 / 3.0 - x * x * (0.2 - x * x / 7.0)))


@kernel
def curved_pattern(view, seen, i, hit, shapes: tuple, rows: tuple, stacks) -> float:
    """Contrast times the pattern's mean over some rows of a cone's side or an ellipsoid.

    `shapes` are `quadric` at the left end of the strip, at its right end and in its middle.
    """
    low, high = rows
    fall = (0.5 * (low + high) - view[HORIZON]) / view[FOCAL]
    tall = 0.5 * (high - low) / view[FOCAL]
    u, span = 0.5 * (hit[b.LEFT_END] + hit[b.RIGHT_END]), (hit[b.ENTRY], hit[b.EXIT])
    left = _place(seen, i, hit[b.LEFT_END], fall, shapes[0], span)
    right = _place(seen, i, hit[b.RIGHT_END], fall, shapes[1], span)
    upper = _place(seen, i, u, fall - tall, shapes[2], span)
    lower = _place(seen, i, u, fall + tall, shapes[2], span)
    across, down = _between(left, right), _between(upper, lower)
    turn = seen[i, b.TURN]
    azimuth = math.atan2(left[1], left[0]) + math.atan2(view[SIN], view[COS]) + 0.5 * across
    s = seen[i, b.X] + turn * azimuth
    q = seen[i, b.Y] + view[EYE_Z] - shapes[2][4] + 0.5 * (upper[2] + lower[2])
    axes = (turn * across, right[2] - left[2], turn * down, lower[2] - upper[2])
    return pattern(view, stacks, BODY, s, q, axes, int(LOOKUPS * view[SAMPLES]))
