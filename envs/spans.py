"""Kernels that paint one column: flat spans by exact coverage, textures by filtered patterns.

A column is a canvas with one number per pixel row in each of its layers: SPANS holds how much
brighter a row is than the one above, so that a flat span of any length costs four
additions; PAINT holds luminance added to a single row. The background, sky above the
horizon and plain ground below, is added once per column by `develop`, so a span is painted
as its difference from the background and what nothing hides costs nothing.
"""

import math

import numba
import numpy as np

from envs.textures import LEVELS, NOISE, RINGS, STACK_TEXELS, STRIPES

# Kernels allocate nothing, so that arrays need no counting of references: that, by atomic
# instructions at each call, took five times as long as the work.
kernel = numba.njit(cache=True, error_model="numpy", _nrt=False)
# What holds for a whole frame, in one array: row of the horizon, focal length [pixels], eye
# [m], heading, time [s], strips per pixel; of the scene: luminance of sky and ground, height
# of the tallest [m], walls (half width, top, ends [m], albedo), Lambert weights, the sun in
# the world and in the camera's frame, and the weight of albedo on level and upright faces.
HORIZON, FOCAL, EYE_X, EYE_Y, EYE_Z, COS, SIN, TIME, SAMPLES = range(9)
SKY, FLOOR, TALLEST, WALL_HALF, WALL_TOP, WALL_NEAR, WALL_FAR, WALL_ALBEDO = range(9, 17)
AMBIENT, DIFFUSE, SUN_X, SUN_Y, SUN_Z, SUN_RIGHT, SUN_FORWARD = range(17, 24)
LIT_UP, LIT_DOWN, LIT_EAST, LIT_WEST, LIT_NORTH, LIT_SOUTH = range(24, 30)
# The textures follow: where in the array each begins, and what it consists of.
GROUND, WALL, BODY, VIEW = 30, 36, 42, 48
PATTERN, FREQUENCY, CONTRAST, SPEED_S, SPEED_Q, STACK = range(6)
NARROW = 1e-6  # [periods] a footprint below this is a point
FINEST = 1e-6  # [pixels] distance from the horizon up to which rows are told apart
LOOKUPS = 8  # most lookups of noise along the longer axis of a footprint, per sample
SHARP = 1e-3  # [rows] an edge that slopes less is level
FAINT = 0.05  # weight below which a coarser level of noise is left out
UNSEEN = 1e-9  # [pixels] weight below which a surface is not textured
# Layers of the canvas, see above; the last three say, in two layers each, what shows in a row.
SPANS, PAINT, GROUND_SHOWN, RIGHT_SHOWN, LEFT_SHOWN = 0, 1, 2, 4, 6
LAYERS = 8


@kernel
def _step(canvas: np.ndarray, layer: int, row: float, change: float) -> None:
    """From `row` downwards all is greater by `change`; exact for a row cut by it."""
    r = int(row)
    below = change * (row - r)
    canvas[layer, r] += change - below
    canvas[layer, r + 1] += below


@kernel
def fill(view: np.ndarray, canvas: np.ndarray, top: float, bottom: float, luminance: float, weight: float):
    """Paint rows top .. bottom, which must lie in the image, with one luminance over the background."""
    horizon = view[HORIZON]
    if top >= bottom:
        return
    if top < horizon:
        _step(canvas, SPANS, top, weight * (luminance - view[SKY]))
        if bottom > horizon:
            _step(canvas, SPANS, horizon, weight * (view[SKY] - view[FLOOR]))
    else:
        _step(canvas, SPANS, top, weight * (luminance - view[FLOOR]))
    behind = view[FLOOR] if bottom > horizon else view[SKY]
    _step(canvas, SPANS, bottom, weight * (behind - luminance))


@kernel
def share_below(row: int, edge: float, spread: float) -> float:
    """Share of a row that lies below an edge which slopes evenly over `spread` rows around `edge`."""
    if spread < SHARP:
        return min(1.0, max(0.0, row + 1.0 - edge))
    above, below = edge - 0.5 * spread, edge + 0.5 * spread
    low, high = min(max(row, above), below), min(max(row + 1.0, above), below)
    share = 0.5 * (high - low) * (high + low - 2.0 * above) / spread
    return share + max(0.0, row + 1.0 - max(row, below))


@kernel
def _slope(view, canvas: np.ndarray, edge: float, spread: float, luminance: float, weight: float):
    """Paint all below a sloping edge with one luminance over the background."""
    sky, floor, horizon = luminance - view[SKY], luminance - view[FLOOR], view[HORIZON]
    rows = canvas.shape[1] - 2
    row, painted = max(0, math.floor(edge - 0.5 * spread)), 0.0
    last = edge + 0.5 * spread
    while row < rows and row <= last:
        # The row that holds the horizon has both behind it.
        over = min(1.0, max(0.0, horizon - row))
        value = share_below(row, edge, spread) * (over * sky + (1.0 - over) * floor)
        canvas[SPANS, row] += weight * (value - painted)
        row, painted = row + 1, value
    below = sky if row < horizon else floor
    canvas[SPANS, row] += weight * (below - painted)
    if row < horizon:
        _step(canvas, SPANS, horizon, weight * (view[SKY] - view[FLOOR]))


@kernel
def fill_sloping(view, canvas, rows: tuple, spreads: tuple, luminance: float, weight: float):
    """As `fill`, between edges that slope over `spreads` rows within the column."""
    if spreads[0] < SHARP and spreads[1] < SHARP:
        fill(view, canvas, rows[0], rows[1], luminance, weight)
    elif rows[0] < rows[1]:
        _slope(view, canvas, rows[0], spreads[0], luminance, weight)
        _slope(view, canvas, rows[1], spreads[1], luminance, -weight)


@kernel
def develop(view: np.ndarray, canvas: np.ndarray, image: np.ndarray, column: int) -> None:
    """Write the painted column over the background into the image, and clear the canvas."""
    _step(canvas, SPANS, view[HORIZON], view[FLOOR] - view[SKY])
    running = view[SKY]
    for row in range(image.shape[0]):
        running += canvas[SPANS, row]
        image[row, column] = running + canvas[PAINT, row]
    canvas[SPANS] = 0.0
    canvas[PAINT] = 0.0


@kernel
def _wave(middle: float, wide: float) -> float:
    """Mean of a square wave of period 1, +1 first, over an interval [periods]; exact."""
    if wide < NARROW:
        return 1.0 if middle - np.floor(middle) < 0.5 else -1.0
    a, b = middle - 0.5 * wide, middle + 0.5 * wide
    a, b = a - np.floor(a), b - np.floor(b)
    return min(1.0, max(-1.0, (min(b, 1.0 - b) - min(a, 1.0 - a)) / wide))


@kernel
def _look_up(stacks: np.ndarray, start: int, s: float, q: float) -> float:
    """Periodic bilinear interpolation at (s, q) [tiles] in the tile that begins at `start`."""
    x, y = (s - np.floor(s)) * STACK_TEXELS, (q - np.floor(q)) * STACK_TEXELS
    i, j = int(x), int(y)
    x, y = x - i, y - j
    i, j = i & (STACK_TEXELS - 1), j & (STACK_TEXELS - 1)
    right = ((i + 1) & (STACK_TEXELS - 1)) - i
    here = start + j * STACK_TEXELS + i
    below = start + ((j + 1) & (STACK_TEXELS - 1)) * STACK_TEXELS + i
    upper = stacks[here] + x * (stacks[here + right] - stacks[here])
    lower = stacks[below] + x * (stacks[below + right] - stacks[below])
    return upper + y * (lower - upper)


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
    finer = (k * LEVELS + low) * STACK_TEXELS * STACK_TEXELS
    coarser = finer + STACK_TEXELS * STACK_TEXELS
    # Filtering weakens a wave by the square of its width, to first order.
    blend = (level * level - low * low) / (2.0 * low + 1.0)
    total = 0.0
    for j in range(count):
        along = (j + 0.5) / count - 0.5
        x, y = s + along * fs, q + along * fq
        value = _look_up(stacks, finer, x, y)
        if blend > FAINT:
            value += blend * (_look_up(stacks, coarser, x, y) - value)
        total += value
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
def texture_level(view, stacks, canvas, top: float, bottom: float, height: float, ray: tuple) -> None:
    """Add the pattern of a body's level face at `height` [m] to rows top .. bottom.

    `ray` is slope, width of the strip in slopes, weighted luminance.
    """
    u, wide, weight = ray
    row = int(top)
    while row < bottom:
        low, high = max(top, row), min(bottom, row + 1.0)
        mean = level_row(view, stacks, BODY, low, high, height, u, wide)
        canvas[PAINT, row] += weight * (high - low) * mean
        row += 1


@kernel
def texture_side(view, stacks, canvas, top: float, bottom: float, side: tuple) -> None:
    """Add the pattern of a body's upright face to rows top .. bottom.

    `side` is s at both ends of the strip [m], depth [m], q at height 0 [m], weighted luminance.
    """
    s_left, s_right, depth, foot, weight = side
    tall = depth / view[FOCAL]
    middle, most = 0.5 * (s_left + s_right), int(LOOKUPS * view[SAMPLES])
    row = int(top)
    while row < bottom:
        low, high = max(top, row), min(bottom, row + 1.0)
        q = foot + view[EYE_Z] - (0.5 * (low + high) - view[HORIZON]) * tall
        axes = (s_right - s_left, 0.0, 0.0, (high - low) * tall)
        mean = pattern(view, stacks, BODY, middle, q, axes, most)
        canvas[PAINT, row] += weight * (high - low) * mean
        row += 1


@kernel
def cover(canvas: np.ndarray, layer: int, top: float, bottom: float, weight: float) -> None:
    """Note that rows top .. bottom show the surface of `layer`; its pattern follows once per cell.

    One more layer says where in its row the part that shows has its middle: the first moment.
    """
    _step(canvas, layer, top, weight)
    _step(canvas, layer, bottom, -weight)
    first, last = int(top), int(bottom)
    above, below = top - first, bottom - last
    canvas[layer + 1, first] += 0.5 * weight * above * (1.0 - above)
    canvas[layer + 1, last] -= 0.5 * weight * below * (1.0 - below)


@kernel
def cover_ground(view, canvas: np.ndarray, top: float, bottom: float, weight: float) -> None:
    """As `cover`, for what rows top .. bottom show of the ground."""
    top = max(top, view[HORIZON])
    if top < bottom:
        cover(canvas, GROUND_SHOWN, top, bottom, weight)


@kernel
def texture_cell(view, stacks, canvas, u: float) -> None:
    """Add the patterns of ground and walls to what the cell of slope `u` shows of them."""
    if view[GROUND + CONTRAST] > 0.0:
        _texture_layer(view, stacks, canvas, GROUND_SHOWN, u)
    if view[WALL + CONTRAST] > 0.0:
        _texture_layer(view, stacks, canvas, RIGHT_SHOWN, u)
        _texture_layer(view, stacks, canvas, LEFT_SHOWN, u)


@kernel
def _texture_layer(view, stacks, canvas, layer: int, u: float) -> None:
    """Add the pattern of the ground or a wall where the cell of slope `u` shows it; forget what it shows.

    What shows of a row is taken as an interval of rows around its middle, as wide as the
    cell: exact where the row is cut above or below, a texture's share of a pixel where it is
    cut at the side.
    """
    shown, wide = 0.0, 1.0 / (view[SAMPLES] * view[FOCAL])
    ground = layer == GROUND_SHOWN
    side = 1.0 if layer == RIGHT_SHOWN else -1.0
    facing = view[LIT_EAST] if side * view[WALL_HALF] < view[EYE_X] else view[LIT_WEST]
    base = view[FLOOR] if ground else view[WALL_ALBEDO] * facing
    for row in range(int(view[HORIZON]) if ground else 0, canvas.shape[1] - 2):
        shown += canvas[layer, row]
        if shown > UNSEEN:
            down = canvas[layer + 1, row] / shown
            tall = 1.0 - 2.0 * abs(down)
            low = row + 0.5 + down - 0.5 * tall
            if ground:
                mean = level_row(view, stacks, GROUND, low, low + tall, 0.0, u, wide)
            else:
                mean = wall_row(view, stacks, low, low + tall, side, u, wide)
            canvas[PAINT, row] += shown * base * mean
    canvas[layer : layer + 2] = 0.0


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
